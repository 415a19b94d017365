"""Whether an alarm of the comparison of two solutions was due: one of them was wrong, or neither (DOMAIN section 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from pipeline.epochs.failure_log import AlarmEpisode
from schemas.arrays import NS_PER_S
from schemas.config import HazardConfig
from schemas.enums import Verdict


@dataclass(frozen=True)
class Side:
    """One of the two solutions: epochs, faults (`begin, end` [ns]), alarms; `with_truth`: by reference or reads."""

    epochs: pl.DataFrame
    faults: pl.DataFrame
    alarms: pl.DataFrame
    with_truth: bool


def verdicts_of(alarms: Sequence[AlarmEpisode], sides: tuple[Side, Side], config: HazardConfig) -> list[Verdict]:
    """True where a solution was wrong, false where both were right all along, unknown where the evidence does not say.

    The rule of the `alarms` table (DOMAIN section 5.3), asked of both solutions.
    """
    return [_verdict(alarm, sides, config) for alarm in alarms]


def _verdict(alarm: AlarmEpisode, sides: tuple[Side, Side], config: HazardConfig) -> Verdict:
    found = [_of_side(alarm, side, config) for side in sides]
    if Verdict.TRUE in found:
        return Verdict.TRUE
    return Verdict.UNKNOWN if Verdict.UNKNOWN in found else Verdict.FALSE


def _of_side(alarm: AlarmEpisode, side: Side, config: HazardConfig) -> Verdict:
    if _known_wrong(alarm, side):
        return Verdict.TRUE
    since_ns = alarm.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    part = side.epochs.filter(pl.col("t").to_physical().is_between(since_ns, alarm.end_ns))
    found = part.filter(pl.col("path_m").is_not_null()).select(beyond=_beyond(config), below=_below(config))
    if found["beyond"].any():
        return Verdict.TRUE
    silent = side.with_truth and found.height and found["below"].fill_null(value=False).all()
    return Verdict.FALSE if silent else Verdict.UNKNOWN


def _margin_m(config: HazardConfig) -> pl.Expr:
    """Error that makes an alarm true [m] (DOMAIN section 5.3)."""
    sigmas = (config.evidence_factor * pl.col("sigma_along_m").fill_null(0.0)).clip(upper_bound=config.failure_limit_m)
    return pl.max_horizontal(pl.lit(config.false_alarm_margin_m), sigmas)


def _beyond(config: HazardConfig) -> pl.Expr:
    """The whole interval is beyond the margin on one side."""
    return (pl.col("error_low_m") > _margin_m(config)) | (pl.col("error_high_m") < -_margin_m(config))


def _below(config: HazardConfig) -> pl.Expr:
    """The whole interval is within the margin."""
    return (pl.col("error_low_m") >= -_margin_m(config)) & (pl.col("error_high_m") <= _margin_m(config))


def _known_wrong(alarm: AlarmEpisode, side: Side) -> bool:
    """The replay found a fault at that time, or called an alarm then true."""
    fault = (pl.col("begin") <= alarm.end_ns) & (pl.col("end").is_null() | (pl.col("end") >= alarm.start_ns))
    meets = (pl.col("t_start").to_physical() <= alarm.end_ns) & (pl.col("t_end").to_physical() >= alarm.start_ns)
    true = side.alarms.filter(pl.col("verdict").cast(pl.String) == Verdict.TRUE.value).filter(meets)
    return side.faults.filter(fault).height > 0 or true.height > 0
