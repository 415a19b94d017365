"""How the clock of reference or reads is taken against the odometer's, as measured over the run (DOMAIN 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.stages.evidence.carrying import Counter
from pipeline.stages.odometry.scale_lag import ScaleLag, scale_and_lag
from schemas.arrays import Floats, Ints
from schemas.config import HazardConfig

# A lag of less than so many of its sigmas may be none.
_SHOWN_SIGMAS = 2.0
# Two lags of one recorder differ beyond so many.
_DIFFER_SIGMAS = 4.0
# Numerics: steps over possible lags [s].
_LAG_STEP_S = 1.0


@dataclass(frozen=True)
class RecorderClock:
    """How a recorder is put on the odometer's clock: its stamps less `shift_s`, +- `delta_s`.

    `assumed`: that could not be measured.
    """

    shift_s: float
    delta_s: float
    assumed: bool = False


def clock_of(lags: Sequence[ScaleLag], independent: bool, config: HazardConfig) -> RecorderClock:
    """The measured lags, each +- k sigma (DOMAIN section 5.1).

    By odometers that are not `independent` a lag may widen what is assumed of a clock, and never narrow it.
    """
    measured = [lag for lag in lags if _measured(lag, config)]
    if not measured:
        return RecorderClock(0.0, config.evidence_clock_s, assumed=True)
    low_s = min(lag.lag_s - config.evidence_factor * lag.lag_sigma_s for lag in measured)
    high_s = max(lag.lag_s + config.evidence_factor * lag.lag_sigma_s for lag in measured)
    least_s = 0.0 if independent else config.evidence_clock_s
    if low_s <= 0.0 <= high_s:
        # There may be none.
        return RecorderClock(0.0, max(-low_s, high_s, least_s), assumed=not independent)
    return RecorderClock(0.5 * (low_s + high_s), max(0.5 * (high_s - low_s), least_s), assumed=not independent)


def clocks_of(
    lags: tuple[Sequence[ScaleLag], Sequence[ScaleLag]], independent: bool, config: HazardConfig
) -> tuple[RecorderClock, RecorderClock]:
    """Those of two recorders. One that cannot be measured may have the odometer's clock or that of the other."""
    first, second = (clock_of(of_one, independent, config) for of_one in lags)
    return _beside(first, second, config), _beside(second, first, config)


def _beside(clock: RecorderClock, other: RecorderClock, config: HazardConfig) -> RecorderClock:
    if not clock.assumed or other.shift_s == 0.0:
        return clock
    middle_s = 0.5 * other.shift_s
    delta_s = abs(clock.shift_s - middle_s) + abs(middle_s) + config.evidence_clock_s
    return RecorderClock(middle_s, delta_s, assumed=True)


def true_clocks_s(clocks: Sequence[RecorderClock]) -> tuple[float, ...]:
    """By how much the odometer's stamps may be early, least to largest [s]: a measured lag belongs to nobody.

    If a recorder has it the odometer's own stamps are true, else odometer and GNSS share it, and what the odometer
    stamped one lag before is true: that of any recorder, and all between.
    """
    shifts_s = [0.0, *(clock.shift_s for clock in clocks)]
    low_s, high_s = min(shifts_s), max(shifts_s)
    if low_s == high_s:
        return (low_s,)
    return tuple(float(lag_s) for lag_s in np.linspace(low_s, high_s, 2 + int((high_s - low_s) / _LAG_STEP_S)))


def _measured(lag: ScaleLag, config: HazardConfig) -> bool:
    """Not where it may be none and is known to no better than what is assumed."""
    noise_s = config.evidence_factor * lag.lag_sigma_s
    return abs(lag.lag_s) >= _SHOWN_SIGMAS * lag.lag_sigma_s or noise_s <= config.evidence_clock_s


def lags_of(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter) -> list[ScaleLag]:
    """The lags of a recorder by the ways that it saw: one of the run, or two where its halves disagree.

    A clock that changes in the middle of a run, at a stand or after a restart, has no lag of the run.
    """
    order = begin_ns.argsort(kind="stable")
    begin_ns, end_ns, way_m = begin_ns[order], end_ns[order], way_m[order]
    half = begin_ns.size // 2
    halves = [lag_of(begin_ns[part], end_ns[part], way_m[part], counter) for part in (slice(half), slice(half, None))]
    sigma_s = float(np.hypot(halves[0].lag_sigma_s, halves[1].lag_sigma_s))
    if abs(halves[0].lag_s - halves[1].lag_s) > _DIFFER_SIGMAS * sigma_s:
        return halves
    return [lag_of(begin_ns, end_ns, way_m, counter)]


def lag_of(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter) -> ScaleLag:
    """The lag of a recorder by the ways that it saw between its stamps, positive as the odometer counts up."""
    order = begin_ns.argsort(kind="stable")
    begin_s, end_s = (counter.odometer.seconds(t_ns[order]) for t_ns in (begin_ns, end_ns))
    return scale_and_lag(begin_s, end_s, way_m[order], counter.rows)
