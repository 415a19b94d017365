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


@dataclass(frozen=True)
class RecorderClock:
    """How a recorder's clock is taken: its stamps less `shift_s`, +- `delta_s`; `assumed`: it could not be measured."""

    shift_s: float
    delta_s: float
    assumed: bool = False

    @property
    def lags_s(self) -> tuple[float, float]:
        """Least and largest lag that it leaves possible."""
        return self.shift_s - self.delta_s, self.shift_s + self.delta_s


def clock_of(lags: Sequence[ScaleLag], independent: bool, config: HazardConfig) -> RecorderClock:
    """DOMAIN section 5.1: the hull of no lag and the measured ones, each +- k sigma.

    A measured lag belongs to nobody: odometer and GNSS may share it, or the recorder has it. By odometers that are not
    `independent` it may widen what is assumed, and never narrow it.
    """
    measured = [lag for lag in lags if _measured(lag, config)]
    noises_s = [config.evidence_factor * lag.lag_sigma_s for lag in measured]
    least_s = 0.0 if measured and independent else config.evidence_clock_s
    lows = [min(lag.lag_s, 0.0) - noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
    highs = [max(lag.lag_s, 0.0) + noise_s for lag, noise_s in zip(measured, noises_s, strict=True)]
    low_s, high_s = min([-least_s, *lows]), max([least_s, *highs])
    return RecorderClock(0.5 * (low_s + high_s), 0.5 * (high_s - low_s), assumed=not (measured and independent))


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
