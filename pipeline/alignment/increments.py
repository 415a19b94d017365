"""Along-track increments of GNSS minus odometer between epochs, with the scale and latency in use at each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.alignment.odometer_filter import Estimate, error_model
from pipeline.figures.bounds import threshold_factor
from pipeline.monitors.axis import AlongSteps, AxisSeries, Reading, along_axis
from pipeline.odometry.odometer import OdometerTrack
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration

_REGULAR_PERIODS = 3


@dataclass(frozen=True)
class EpochArrays:
    """What alignment reads of the matched epochs: times [s] on the odometer's scale, positions, usability.

    `jitter_s`: by how much the stamps scatter about the receiver's regular times (see `stamp_jitter_s`); `digits_m`:
    how coarsely the positions are written down.
    """

    t_s: Floats
    path_m: Floats
    sigma_m: Floats
    usable: Bools
    jitter_s: float
    digits_m: Floats


def stamp_jitter_s(t_s: Floats) -> float:
    """Standard deviation of the stamps about a regular clock [s].

    A receiver measures at regular times; a recorder that stamps on receipt scatters them, and at 40 m/s ten
    milliseconds are 0.4 m from one epoch to the next. Only the stamps are looked at, never a position.
    """
    dt = np.diff(t_s)
    period = float(np.median(dt))
    periods = np.round(dt / period)
    regular = (periods >= 1) & (periods <= _REGULAR_PERIODS)
    away = (dt - periods * period)[regular]
    return float(np.sqrt(np.mean(away**2) / 2.0)) if away.size else 0.0


@dataclass(frozen=True)
class Learned:
    """Estimates in use at each epoch; shapes (n,)."""

    scale: Floats
    scale_sigma: Floats
    latency_s: Floats
    latency_sigma_s: Floats

    @classmethod
    def constant(cls, estimate: Estimate, n: int) -> Learned:
        values = (estimate.scale, estimate.scale_sigma, estimate.latency_s, estimate.latency_sigma_s)
        return cls(*(np.full(n, value) for value in values))

    def put(self, begins: Ints, estimates: Floats) -> None:
        """Set estimates (changes, 4): each change holds from its epoch to the next, the last for good."""
        lengths = np.diff(begins, append=self.scale.size)
        columns = (self.scale, self.scale_sigma, self.latency_s, self.latency_sigma_s)
        for column, value in zip(columns, estimates.T, strict=True):
            column[begins[0] :] = np.repeat(value, lengths)


@dataclass(frozen=True)
class OdometerSteps:
    """Corrected odometer distance and speed change from the row before; the first row has none (zero)."""

    distance_m: Floats
    speed_mps: Floats


def odometer_steps(rows: Ints, t_s: Floats, track: OdometerTrack, learned: Learned) -> OdometerSteps:
    """Steps between consecutive rows, both ends with the estimates in use at the later one."""
    latency, scale = learned.latency_s[rows], learned.scale[rows]
    now = t_s[rows] - latency
    before = np.concatenate([now[:1], t_s[rows][:-1] - latency[1:]])
    distance = scale * (track.distance_at(now) - track.distance_at(before))
    speed = scale * (track.speed_at(now) - track.speed_at(before))
    return OdometerSteps(distance, speed)


def most_scatter_m(config: Configuration) -> float:
    """The largest deviation of an odometer's row, or of digits, that the thresholds allow for [m].

    With more, a position that leaves its place by the failure limit would be no more than rows of the odometer, or the
    digits, make of it. Alarms of a record that scatters by more are its own, but no failure passes.
    """
    factor = threshold_factor(config.monitors.false_alarm_probability)
    return config.hazards.failure_limit_m / (factor * float(np.sqrt(2.0)))


def reading_of(track: OdometerTrack, at_s: Floats, config: Configuration) -> Reading | None:
    """Noise of the odometer's rows at these times, as far as thresholds allow for it; none where they have none."""
    if not track.reading:
        return None
    sigma_m = np.sqrt(track.reading.variance_m2(track.speed_at(at_s)))
    return Reading(np.minimum(sigma_m, most_scatter_m(config)), track.period_s)


def along_series(
    rows: Ints, arrays: EpochArrays, track: OdometerTrack, learned: Learned, config: Configuration
) -> AxisSeries:
    """Increments of GNSS minus odometer between consecutive rows (DIAG eq. 1-3)."""
    steps = odometer_steps(rows, arrays.t_s, track, learned)
    t, x = arrays.t_s[rows], arrays.path_m[rows]
    dt = np.diff(t, prepend=t[0] - 1.0)
    stretch = track.stretch_at(t - learned.latency_s[rows])
    fresh = (dt > config.align.gap_reset_s) | (np.diff(stretch, prepend=stretch[0]) != 0)
    fresh[0] = True
    along = AlongSteps(
        dt_s=dt,
        path_m=np.diff(x, prepend=x[0]),
        odometer_m=steps.distance_m,
        speed_mps=steps.speed_mps,
        sigma_m=arrays.sigma_m[rows],
        jitter_s=arrays.jitter_s,
        white_m2_per_s=track.white_rate_m2_per_s,
        scale_sigma=learned.scale_sigma[rows],
        latency_sigma_s=learned.latency_sigma_s[rows],
        digits_m=arrays.digits_m[rows],
        reading=reading_of(track, t - learned.latency_s[rows], config),
    )
    return along_axis(rows, fresh, along, *error_model(config.monitors))
