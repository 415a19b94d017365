"""Estimates as columns of tables: a figure, its lower and its upper bound, with the unit at the end of their names."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

import polars as pl

from pipeline.figures.bounds import UNKNOWN, Estimate, poisson_rate

# The usual time of continuity of GNSS approaches, and part of the column names `continuity_15s`.
CONTINUITY_S = 15.0
"""Most critical phase of an APV-I/LPV-200 operation (LOC section VI)."""

Estimator = tuple[str, str, Callable[[int, float], Estimate] | Callable[[int, int], Estimate], str, str]
"""Name, ending with the unit, what estimates, and the columns of its events and of what they are held against."""


def columns_of(name: str, estimate: Estimate, unit: str = "") -> dict[str, object]:
    """An estimate as three columns `name`, `name_low`, `name_high`, with their unit at the end."""
    return {
        f"{name}{unit}": estimate.value,
        f"{name}_low{unit}": estimate.low,
        f"{name}_high{unit}": estimate.high,
    }


def with_estimates(frame: pl.DataFrame, *estimates: Estimator) -> pl.DataFrame:
    """The columns of estimates, row by row; not known where their events are not."""
    series = []
    for name, unit, estimate, events, against in estimates:
        pairs = zip(frame[events].to_list(), frame[against].to_list(), strict=True)
        rows = [columns_of(name, UNKNOWN if None in pair else estimate(*pair), unit) for pair in pairs]
        schema = dict.fromkeys(columns_of(name, UNKNOWN, unit), pl.Float64)
        series += pl.DataFrame(rows, schema=schema).get_columns()
    return frame.with_columns(series)


def bounds_of(names: Collection[str]) -> dict[str, tuple[str, str]]:
    """Per figure that has bounds the columns that hold them: `mtbf_low_h` and `mtbf_high_h` of `mtbf_h`."""
    parts = [(low.rpartition("_low"), low) for low in names if "_low" in low]
    pairs = {head + unit: (low, f"{head}_high{unit}") for (head, _, unit), low in parts}
    return {figure: pair for figure, pair in pairs.items() if {figure, *pair} <= set(names)}


def continuity(t_s: float, mtbf_h: float) -> float:
    """Probability of working through `t_s`, having worked at its beginning (LOC eq. 8)."""
    return math.exp(-t_s / 3600.0 / mtbf_h)


def mtbf(losses: int, up_h: float) -> Estimate:
    """MTBF [h] from the losses counted. Without a loss the value is not known, but it has a lower bound."""
    rate = poisson_rate(losses, up_h)
    return Estimate(*(1.0 / per_h if per_h else None for per_h in (rate.value, rate.high, rate.low)))


def continuity_15s(losses: int, up_h: float) -> Estimate:
    """Continuity over 15 s at the MTBF of so many losses."""
    found = mtbf(losses, up_h)
    parts = (found.value, found.low, found.high)
    return Estimate(*(None if part is None else continuity(CONTINUITY_S, part) for part in parts))
