"""Epochs and offers as the judge has judged them, on a handful of rows: what a test does not say is in good order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.judge.failures import ErrorHistory, Jump, history_of_positions
from pipeline.stages.judge.judged import JudgedEpochs, JudgedOffers
from schemas.config import Configuration
from schemas.enums import Evidence, Judgement
from tests.arrays_of_table import arrays_of_table, judgements_of_table

NS = 1_000_000_000
CONFIG = Configuration()


def positions(
    t_s: Sequence[float], error_m: Sequence[float] | float = 0.0, half_m: float = 1.0, **columns: Any
) -> JudgedEpochs:
    """Positions of a train at 10 m/s, all in use; wrong where the whole interval is beyond 20 m, else right."""
    size = len(t_s)
    error = np.broadcast_to(np.array(error_m, dtype=np.float64), size)
    wrong = np.abs(error) - half_m > 20.0
    within = np.abs(error) + half_m <= 20.0
    judgement = np.where(wrong, "wrong", np.where(within, "right", "unknown")).tolist()
    step_s = np.diff(np.array(t_s), prepend=t_s[0] - (t_s[1] - t_s[0]))
    nanoseconds = [round(t * NS) for t in t_s]
    values: dict[str, Any] = {
        "epoch": list(range(size)), "t": nanoseconds, "at": nanoseconds, "direction": 1, "judgement": judgement,
        "error_low_m": error - half_m, "error_high_m": error + half_m, "evidence": "reference",
        "wrong_track": False, "track_assumed": False,
        "path_m": 10.0 * np.array(t_s) + error, "sigma_along_m": 1.0, "leg": 0, "used_s": step_s,
    } | columns  # fmt: skip
    values.setdefault("wrong_s", np.where([word == "wrong" for word in values["judgement"]], values["used_s"], 0.0))
    values.setdefault("natural_s", values["wrong_s"])
    for name in ("train_m", "reference_m"):
        values.setdefault(name, 10.0 * np.array(t_s))
    return arrays_of_table(JudgedEpochs, _frame(size, values))


def offers(epochs: Sequence[int], **columns: Any) -> JudgedOffers:
    """Virtual balises offered at these epochs and accepted, right unless said otherwise."""
    size = len(epochs)
    values: dict[str, Any] = {
        "crossing_id": list(range(size)), "balise_id": [f"V{k}" for k in range(size)], "epoch": list(epochs),
        "t": [k * NS for k in epochs], "path_m": [10.0 * k for k in epochs], "virtual": True, "offered": True,
        "accepted": True, "beyond_window": False, "judgement": "right", "error_low_m": -1.0, "error_high_m": 1.0,
        "evidence": "reference", "wrong_track": False, "track_assumed": False,
    } | columns  # fmt: skip
    table = _frame(size, values)
    flags = {name: table[name].to_numpy() for name in ("virtual", "offered", "accepted", "beyond_window")}
    numbers = {name: table[name].cast(pl.Int64).to_numpy() for name in ("crossing_id", "epoch")}
    nothing = np.full(size, np.nan)
    return JudgedOffers(
        balise_id=table["balise_id"].to_list(),
        t_ns=table["t"].to_physical().to_numpy(),
        path_m=table["path_m"].to_numpy(),
        judged=judgements_of_table(table),
        location_error_m=nothing,
        proof_margin_m=nothing,
        **flags,
        **numbers,
    )


def history(positioned: JudgedEpochs, *jumps: Jump, offered: JudgedOffers | None = None) -> ErrorHistory:
    return history_of_positions(positioned, offers([]) if offered is None else offered, jumps, CONFIG)


_KINDS: dict[str, pl.DataType] = {
    "t": pl.Datetime("ns", "UTC"),
    "at": pl.Datetime("ns", "UTC"),
    "judgement": pl.Enum(Judgement),
    "evidence": pl.Enum(Evidence),
    "balise_id": pl.String(),
    **{name: pl.Boolean() for name in ("wrong_track", "track_assumed", "virtual", "offered", "accepted")},
    **{name: pl.Boolean() for name in ("beyond_window", "odometer_standing", "odometer_wrong")},
    **{name: pl.Int64() for name in ("epoch", "crossing_id", "direction", "leg")},
}


def _frame(size: int, values: dict[str, Any]) -> pl.DataFrame:
    columns = [
        pl.Series(name, value if isinstance(value, list | np.ndarray) else [value] * size, nan_to_null=True).cast(
            _KINDS.get(name, pl.Float64())
        )
        for name, value in values.items()
    ]
    return pl.DataFrame(columns)
