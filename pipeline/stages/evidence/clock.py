"""How the clock of reference or reads is taken against the odometer's, as measured over the run (DOMAIN 5.1)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.stages.evidence.carrying import Counter
from pipeline.stages.odometry.scale_lag import ScaleLag, possible_lags, scale_and_lag
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, HazardConfig
from schemas.frozen import frozen

# A lag of less than so many of its sigmas may be none.
_SHOWN_SIGMAS = 2.0
# Two lags of one recorder differ beyond so many.
_DIFFER_SIGMAS = 4.0
# Numerics: steps over possible lags [s].
_LAG_STEP_S = 1.0


@frozen
class RecorderClock:
    """How a recorder is put on the odometer's clock: its stamps less `shift_s`, +- `delta_s`.

    `assumed`: that could not be measured.
    """

    shift_s: float
    delta_s: float
    assumed: bool = False


@frozen
class Lags:
    """What the ways of a recorder say of its lag behind one odometer: `found`, and the least and largest `possible_s`.

    `found`: one of the run, or two where its halves disagree. `possible_s`: what the ways do not refute where none is
    measured and they refute that there is none; None where there may be none, or they say nothing of it.
    """

    found: tuple[ScaleLag, ...] = ()
    possible_s: tuple[float, float] | None = None

    def range_s(self, config: HazardConfig) -> tuple[float, float] | None:
        """Least and largest lag that the recorder may have; None where it is what is assumed of a clock."""
        measured = [lag for lag in self.found if _measured(lag, config)]
        if not measured:
            return self._unproved_s()
        noises_s = [config.evidence_factor * lag.lag_sigma_s for lag in measured]
        lows_s = [lag.lag_s - noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
        highs_s = [lag.lag_s + noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
        return min(lows_s), max(highs_s)

    def _unproved_s(self) -> tuple[float, float] | None:
        """About none, as far as it may reach: what is not measured moves nothing, it may be a slip."""
        if self.possible_s is None:
            return None
        low_s, high_s = self.possible_s
        reach_s = max(-low_s, high_s)
        return -reach_s, reach_s


def clock_of(lags: Sequence[Lags], independent: bool, config: HazardConfig) -> RecorderClock:
    """All lags that a recorder may have, by several odometers (DOMAIN section 5.1).

    By odometers that are not `independent` a lag may widen what is assumed of a clock, and never narrow it.
    """
    ranges_s = [range_s for of_one in lags if (range_s := of_one.range_s(config)) is not None]
    if not ranges_s:
        return RecorderClock(0.0, config.evidence_clock_s, assumed=True)
    low_s, high_s = min(low for low, _ in ranges_s), max(high for _, high in ranges_s)
    least_s = 0.0 if independent else config.evidence_clock_s
    if low_s <= 0.0 <= high_s:
        # There may be none.
        return RecorderClock(0.0, max(-low_s, high_s, least_s), assumed=not independent)
    return RecorderClock(0.5 * (low_s + high_s), max(0.5 * (high_s - low_s), least_s), assumed=not independent)


def clocks_of(
    lags: tuple[Sequence[Lags], Sequence[Lags]], independent: bool, config: HazardConfig
) -> tuple[RecorderClock, RecorderClock]:
    """Those of reference and reads. One that cannot be measured may have the odometer's clock or that of the other."""
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


def lags_of(
    begin_ns: Ints, end_ns: Ints, way_m: Floats, sigma_m: Floats, counter: Counter, config: Configuration
) -> Lags:
    """The lag of a recorder by the ways that it saw between its stamps, positive as the odometer counts up.

    A clock that changes in the middle of a run, at a stand or after a restart, has no lag of the run. `sigma_m`: of a
    way by the recorder's own noise.
    """
    order = begin_ns.argsort(kind="stable")
    begin_ns, end_ns = begin_ns[order], end_ns[order]
    way_m, sigma_m = way_m[order], sigma_m[order]
    begin_s, end_s = (counter.odometer.seconds(t_ns) for t_ns in (begin_ns, end_ns))
    half = begin_ns.size // 2
    halves = [
        scale_and_lag(begin_s[part], end_s[part], way_m[part], counter.rows)
        for part in (slice(half), slice(half, None))
    ]
    apart_sigma_s = float(np.hypot(halves[0].lag_sigma_s, halves[1].lag_sigma_s))
    if abs(halves[0].lag_s - halves[1].lag_s) > _DIFFER_SIGMAS * apart_sigma_s:
        return Lags(tuple(halves))
    found = scale_and_lag(begin_s, end_s, way_m, counter.rows)
    if _measured(found, config.hazards):
        return Lags((found,))
    # Ways that follow one another share the noise of the place between them: together as if each had twice its
    # variance.
    variance_m2 = 2.0 * sigma_m**2 + np.nan_to_num(counter.between(begin_ns, end_ns).variance_m2)
    factor = config.hazards.evidence_factor
    scale_off = factor * (counter.odometer.scale_sigma or 0.0) if counter.by_file else config.lds.odometer_share
    ways = (begin_s, end_s, way_m)
    low_s, high_s = possible_lags(ways, counter.rows, np.sqrt(variance_m2), scale_off, _SHOWN_SIGMAS) or (0.0, 0.0)
    if low_s <= 0.0 <= high_s:
        return Lags((found,))
    return Lags((found,), possible_lags(ways, counter.rows, np.sqrt(variance_m2), scale_off, factor))
