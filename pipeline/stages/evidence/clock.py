"""How the clock of reference or reads is taken, as measured over the run against the odometer's (DOMAIN 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.stages.evidence.carrying import Counter
from pipeline.stages.odometry.scale_lag import ScaleLag, scale_and_lag
from schemas.arrays import Floats, Ints
from schemas.config import HazardConfig

# A lag of less than so many of its sigmas may be none.
_SHOWN_SIGMAS = 2.0


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


def clock_of(lag: ScaleLag, independent: bool, config: HazardConfig) -> RecorderClock:
    """DOMAIN section 5.1: the hull of no lag and the measured one, each +- k sigma.

    A measured lag belongs to nobody: odometer and GNSS may share it, or the recorder has it. By an odometer that is not
    `independent` it may widen what is assumed, and never narrow it.
    """
    noise_s = config.evidence_factor * lag.lag_sigma_s
    if abs(lag.lag_s) < _SHOWN_SIGMAS * lag.lag_sigma_s and noise_s > config.evidence_clock_s:
        return RecorderClock(0.0, config.evidence_clock_s, assumed=True)
    least_s = 0.0 if independent else config.evidence_clock_s
    low_s = min(min(lag.lag_s, 0.0) - noise_s, -least_s)
    high_s = max(max(lag.lag_s, 0.0) + noise_s, least_s)
    return RecorderClock(0.5 * (low_s + high_s), 0.5 * (high_s - low_s), assumed=not independent)


def lag_of(begin_ns: Ints, end_ns: Ints, way_m: Floats, counter: Counter) -> ScaleLag:
    """The lag of a recorder by the ways that it saw between its stamps, positive as the odometer counts up."""
    order = begin_ns.argsort(kind="stable")
    begin_s, end_s = (counter.odometer.seconds(t_ns[order]) for t_ns in (begin_ns, end_ns))
    return scale_and_lag(begin_s, end_s, way_m[order], counter.rows)
