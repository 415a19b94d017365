"""Whether an alarm of the comparison of two solutions was due: one of them was wrong, or neither (DOMAIN section 5)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.failure_log import AlarmEpisode
from pipeline.judge.alarms import verdict_within
from pipeline.judge.judgement import margins_m
from schemas.arrays import NS_PER_S, floats
from schemas.config import HazardConfig
from schemas.enums import Verdict


@dataclass(frozen=True)
class Solution:
    """Tables of one solution of a run; `faults` one row per fault; `with_truth`: judged by a reference or reads."""

    epochs: pl.DataFrame
    faults: pl.DataFrame
    alarms: pl.DataFrame
    with_truth: bool


def verdict_of_both(alarm: AlarmEpisode, sides: tuple[Solution, Solution], config: HazardConfig) -> Verdict:
    """True where a solution was wrong, false where both were right all along, unknown where the evidence does not say.

    The rule of the `alarms` table (DOMAIN section 5.3), asked of both solutions.
    """
    found = {_of_side(alarm, side, config) for side in sides}
    return next(verdict for verdict in (Verdict.TRUE, Verdict.UNKNOWN, Verdict.FALSE) if verdict in found)


def _of_side(alarm: AlarmEpisode, side: Solution, config: HazardConfig) -> Verdict:
    since_ns = alarm.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    part = side.epochs.filter(pl.col("t").to_physical().is_between(since_ns, alarm.end_ns))
    known = part.filter(pl.col("path_m").is_not_null())
    low_m, high_m, sigma_m = (floats(known, name) for name in ("error_low_m", "error_high_m", "sigma_along_m"))
    if _known_wrong(alarm, side):
        return Verdict.TRUE
    return verdict_within(low_m, high_m, margins_m(sigma_m, config), np.full(known.height, side.with_truth))


def _known_wrong(alarm: AlarmEpisode, side: Solution) -> bool:
    """The replay found a fault at that time, or called an alarm then true."""
    fault = side.faults.select(begin=pl.col("begin").to_physical(), end=pl.col("t_end").to_physical())
    true = side.alarms.filter(pl.col("verdict").cast(pl.String) == Verdict.TRUE.value)
    spans = pl.concat([fault, true.select(begin=pl.col("t_start").to_physical(), end=pl.col("t_end").to_physical())])
    meets = (pl.col("begin") <= alarm.end_ns) & (pl.col("end").is_null() | (pl.col("end") >= alarm.start_ns))
    return spans.filter(meets).height > 0
