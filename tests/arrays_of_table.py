"""Epochs in arrays from a table that holds some of their columns: what it lacks is not known."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import Verdicts, no_verdicts
from pipeline.stages.evidence import TruePlaces
from pipeline.stages.judge.judged import Judgements
from schemas.arrays import flags, floats, ints, times_ns, truths
from schemas.config import HazardConfig
from schemas.enums import Evidence, Judgement, LdsMode, LdsState, LostTo, NotEvaluated, SigmaSource
from schemas.monitors import MONITORS
from schemas.stages import MatchedEpochs

Epochs = TypeVar("Epochs", bound=MatchedEpochs)
_WORDS: Mapping[str, type[StrEnum]] = {
    "sigma_source": SigmaSource,
    "odometer_reason": NotEvaluated,
    "lds_mode": LdsMode,
    "withheld_for": LostTo,
    "lds_state": LdsState,
}


def arrays_of_table(cls: type[Epochs], table: pl.DataFrame) -> Epochs:
    """Epochs of this class with the columns that the table has."""
    return cls(**{one.name: _values(one.name, str(one.type), table) for one in fields(cls)})


def judgements_of_table(table: pl.DataFrame) -> Judgements:
    """From the columns `judgement`, `error_low_m`, `error_high_m`, `evidence` and the flags."""
    return Judgements(
        code=_numbers(table, "judgement", list(Judgement)),
        low_m=_floats(table, "error_low_m"),
        high_m=_floats(table, "error_high_m"),
        kind=_numbers(table, "evidence", list(Evidence)),
        wrong_track=_flags(table, "wrong_track"),
        track_assumed=_flags(table, "track_assumed"),
        limit_m=np.full(table.height, HazardConfig().limits.failure_m),
    )


_OWN: Mapping[str, Callable[[pl.DataFrame], Any]] = {
    "solution": lambda table: str(table["solution"][0]) if "solution" in table.columns and table.height else "primary",
    "elements": lambda table: _names(table, "netelement_id"),
    "lrvb_ids": lambda table: _names(table, "lrvb_id"),
    "element": lambda table: _numbers(table, "netelement_id", _names(table, "netelement_id")),
    "lrvb": lambda table: _numbers(table, "lrvb_id", _names(table, "lrvb_id")),
    "verdicts": lambda table: {monitor: _verdicts(table, monitor) for monitor in MONITORS},
    "judgements": judgements_of_table,
    "true_places": lambda table: TruePlaces(
        pl.Series([None] * table.height, dtype=pl.List(pl.String)), *np.full((2, table.height), np.nan)
    ),
    "t_ns": times_ns,
    "at_ns": lambda table: times_ns(table, "at" if "at" in table.columns else "t"),
    "epoch": lambda table: ints(table["epoch"]) if "epoch" in table.columns else np.arange(table.height),
    "moves": lambda table: truths(_moving(table)),
    "may_move": lambda table: truths(_moving(table).fill_null(value=True)),
}
"""Columns that are no plain array of the column of their name."""


def _moving(table: pl.DataFrame) -> pl.Series:
    return table["moving"] if "moving" in table.columns else pl.Series([None] * table.height, dtype=pl.Boolean)


def _values(name: str, kind: str, table: pl.DataFrame) -> Any:
    if name in _OWN:
        return _OWN[name](table)
    if name in _WORDS:
        return _numbers(table, name, list(_WORDS[name]))
    if kind == "Bools":
        return _flags(table, name)
    if kind == "Floats":
        return _floats(table, name)
    return ints(table[name]) if name in table.columns else np.full(table.height, {"leg": 0, "direction": 1}[name])


def _names(table: pl.DataFrame, column: str) -> list[str]:
    return table[column].drop_nulls().unique(maintain_order=True).to_list() if column in table.columns else []


def _numbers(table: pl.DataFrame, column: str, words: Sequence[str]) -> Any:
    if column not in table.columns:
        return np.full(table.height, -1)
    numbers = {str(word): number for number, word in enumerate(words)}
    return ints(table[column].cast(pl.String).replace_strict(numbers, default=None, return_dtype=pl.Int64))


def _floats(table: pl.DataFrame, column: str) -> Any:
    return floats(table, column) if column in table.columns else np.full(table.height, np.nan)


def _flags(table: pl.DataFrame, column: str) -> Any:
    return flags(table, column) if column in table.columns else np.zeros(table.height, dtype=np.bool_)


def _verdicts(table: pl.DataFrame, monitor: str) -> Verdicts:
    known = f"{monitor}_state" in table.columns
    return Verdicts.of_table(table, monitor) if known else no_verdicts(table.height, NotEvaluated.DISABLED)
