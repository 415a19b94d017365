"""Whether an alarm of the comparison of two solutions was due: one of them was wrong, or neither (DOMAIN section 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import polars as pl

from pipeline.epochs.failure_log import AlarmSpan
from pipeline.epochs.timeline import nominal_period_s
from schemas.arrays import NS_PER_S
from schemas.config import HazardConfig
from schemas.enums import Verdict

# Streams rarely begin and end with the same epoch: so little without truth says nothing against it.
_BLIND_S = 1.0


@dataclass(frozen=True)
class Side:
    """One of the two solutions: epochs, faults (`begin, end` [ns]), alarms, and whether a reference gives the truth."""

    epochs: pl.DataFrame
    faults: pl.DataFrame
    alarms: pl.DataFrame
    by_reference: bool


def verdicts_of(spans: Sequence[AlarmSpan], sides: tuple[Side, Side], config: HazardConfig) -> list[Verdict]:
    """True where a solution was wrong, false where both were right all along, unknown where the truth does not say."""
    return [_verdict(span, sides, config) for span in spans]


def _verdict(span: AlarmSpan, sides: tuple[Side, Side], config: HazardConfig) -> Verdict:
    found = [_of_side(span, side, config) for side in sides]
    if Verdict.TRUE in found:
        return Verdict.TRUE
    return Verdict.UNKNOWN if Verdict.UNKNOWN in found else Verdict.FALSE


def _of_side(span: AlarmSpan, side: Side, config: HazardConfig) -> Verdict:
    if _known_wrong(span, side):
        return Verdict.TRUE
    since_ns = span.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    part = side.epochs.filter(pl.col("t").to_physical().is_between(since_ns, span.end_ns))
    positioned = part.filter(pl.col("path_m").is_not_null())
    error, sigma = pl.col("error_along_m").abs(), pl.col("sigma_along_m").fill_null(0.0)
    beyond = positioned.filter(error >= pl.max_horizontal(pl.lit(config.false_alarm_margin_m), 3.0 * sigma)).height
    if beyond:
        # What the odometer or balise reads carry has a doubt of its own, which the tables do not hold.
        return Verdict.TRUE if side.by_reference else Verdict.UNKNOWN
    period_s = nominal_period_s(side.epochs["t"].to_physical().to_numpy()) or 0.0
    blind = positioned["error_along_m"].null_count() * period_s > _BLIND_S
    return Verdict.UNKNOWN if blind or not positioned["error_along_m"].count() else Verdict.FALSE


def _known_wrong(span: AlarmSpan, side: Side) -> bool:
    """The replay found a fault at that time, or called an alarm then true."""
    fault = (pl.col("begin") <= span.end_ns) & (pl.col("end").is_null() | (pl.col("end") >= span.start_ns))
    alarm = (pl.col("t_start").to_physical() <= span.end_ns) & (pl.col("t_end").to_physical() >= span.start_ns)
    true = side.alarms.filter(pl.col("verdict").cast(pl.String) == Verdict.TRUE.value).filter(alarm)
    return side.faults.filter(fault).height > 0 or true.height > 0
