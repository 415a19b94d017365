"""What figures over runs are worth, and what they leave out: sentences as safety, claim and line write them.

The words stand in `schemas/words.toml`; here and in the rooms is decided which of them apply, with which figures.
"""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from schemas.enums import TRUTH, RunStatus
from schemas.words import say, say_of

_FAILED = pl.col("status").cast(pl.String) == RunStatus.FAILED.value


def reservation_sentences(section: str, said: Mapping[str, object]) -> list[str]:
    """The words of what there is: falsy means that there is nothing to say.

    A tuple holds several figures, a mapping holds them by name (`schemas.words.say_of`).
    """
    return [_sentence(section, name, value) for name, value in said.items() if value]


def _sentence(section: str, name: str, value: object) -> str:
    """The sentence of one reservation, from the texts of its section."""
    if isinstance(value, Mapping):
        return say_of(section, name, value)
    return say(section, name, *(value if isinstance(value, tuple) else (value,)))


def failed_runs(runs: pl.DataFrame) -> list[str]:
    """Runs that failed, with all their solutions or with one alone."""
    number = runs["run_id"].n_unique()
    whole = runs.filter(_FAILED.all().over("run_id"))["run_id"].n_unique()
    alone = runs.filter(_FAILED & ~_FAILED.all().over("run_id")).group_by("solution").agg(pl.col("run_id").n_unique())
    return [
        *reservation_sentences("studies", {"failed": whole and (whole, number)}),
        *(say("studies", "failed_alone", *row, number) for row in alone.sort("solution").iter_rows()),
    ]


def runs_without_truth(runs: pl.DataFrame, consequence: str) -> list[str]:
    """Runs that nothing but the odometer, or nothing at all, can judge."""
    blind = runs.filter(~pl.col("evidence").cast(pl.String).is_in(TRUTH).fill_null(value=False)).height
    return reservation_sentences("studies", {"without_truth": blind and (blind, runs.height, consequence)})


def several_settings(runs: pl.DataFrame, consequence: str) -> list[str]:
    """Runs of different configurations or vehicle files in one result."""
    kinds = runs.filter(~_FAILED)["config_digest"].n_unique()
    return reservation_sentences("studies", {"several_settings": kinds > 1 and (kinds, consequence)})
