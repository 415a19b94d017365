"""The odometer of a run, made once and handed to everyone who asks how far, how fast and whether the train moved."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.odometry.bound import LEAST_DOUBT_M, LOST_M, Bound, is_lost
from pipeline.stages.odometry.driven import driven_or_left_m, evenly_driven, moving_steps, travelled_m
from pipeline.stages.odometry.quantisation import KnownNoise, Noise, noise_of_rows, row_periods_s
from pipeline.stages.odometry.reading import OdometerReading, StepTimes
from pipeline.stages.odometry.rows import (
    Contradiction,
    StepDistances,
    contradicted_by_speeds,
    count_step,
    declared_mps,
    declared_origin,
    filled_in,
    slips_of,
    step_distances,
)
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, median, times_ns
from schemas.config import AlignConfig, Configuration, Vehicle
from schemas.enums import Origin
from schemas.frozen import frozen


class OdometerDistance(NamedTuple):
    """True distance between two instants, signed [m], and its variance [m^2]; NaN where it is not known.

    `bound_m`: by how much it may be off besides, as braking and acceleration prove it.
    """

    distance_m: Floats
    variance_m2: Floats
    bound_m: Floats


class Increments(NamedTuple):
    """Corrected distance [m] and change of speed [m/s] from the instant before."""

    distance_m: Floats
    speed_mps: Floats


@frozen
class Odometry:
    """Distance over time with its noise and two sums of doubt.

    Instants are int64 nanoseconds; `t_s` (rows, and what was filled in) and all `_s` arguments are seconds since
    `epoch_ns`. Distances are as recorded, but for those between instants and `increments`. `doubt_m`: by how much the
    distance may be off as the train itself believes it, a sum, `LOST_M` more where it was lost. `pause[i]`: between
    samples i and i+1 nothing is interpolated. `scale`: true over recorded distance, None without its sigma.
    `leaps_ns`: rows to which the counter leaps; `bridged_m2`: variance over bridged ones, a sum. `bound`: by how much
    the distance may be off as braking proves it. `period_s`: usual time between rows of the run, for words about it.
    `origin`: as declared; `follows_gnss`: found to be made of the positions all the same.
    """

    epoch_ns: int
    t_s: Floats
    distance_m: Floats
    pause: Bools
    slip: Bools
    doubt_m: Floats
    noise: Noise
    known_noise: KnownNoise
    deadband_mps: float
    config: AlignConfig
    period_s: float = 0.0
    scale: float | None = None
    scale_sigma: float | None = None
    leaps_ns: tuple[int, ...] = ()
    bridged_m2: Floats | None = None
    bound: Bound | None = None
    origin: Origin = Origin.UNKNOWN
    follows_gnss: bool = False

    @property
    def independent(self) -> bool:
        """Declared to be free of the GNSS, and not found to be made of its positions (DOMAIN section 5.0)."""
        return self.origin.independent and not self.follows_gnss

    @property
    def of_gnss(self) -> bool:
        """Made of what it should check, by its declaration or by what was found."""
        return self.follows_gnss or self.origin in (Origin.GNSS, Origin.FUSED)

    @property
    def begin_ns(self) -> int:
        """The first row."""
        return self.epoch_ns

    @property
    def end_ns(self) -> int:
        """The last row, rounded up."""
        return self.epoch_ns + int(np.ceil(self.t_s[-1] * 1e9))

    def growing_along_path(self, sign: int) -> Odometry:
        """The odometer, its distance growing with the path; `sign`: +1 where the recorded one does, -1 if it falls."""
        return self if sign > 0 else replace(self, distance_m=-self.distance_m)

    def seconds(self, t_ns: Ints) -> Floats:
        """Instants [ns] as seconds since `epoch_ns`."""
        return np.asarray((t_ns - self.epoch_ns) * 1e-9, dtype=np.float64)

    def known_at(self, t_ns: Ints) -> Bools:
        """Whether the distance is known at instants [ns], as `known_at_s`."""
        return self.known_at_s(self.seconds(t_ns))

    def slips_at_s(self, t_s: Floats) -> Bools:
        """Whether the sample before or after each instant reports slip."""
        return self.read(t_s).slips

    def cumulative_doubt_m(self, t_s: Floats) -> Floats:
        """`doubt_m` at each instant [m]: distances at instants of the same doubt compare, across a loss never."""
        return self.read(t_s).doubt_m

    def distance_at(self, t_ns: Ints) -> Floats:
        """Distance as recorded at instants [m]; NaN where it is not known."""
        at = self.read(self.seconds(t_ns))
        return np.where(at.known, at.distance_m, np.nan)

    def travelled_at(self, t_ns: Ints) -> Floats:
        """Distance driven since the first row [m], to and fro; interpolated over gaps."""
        return self._travelled_at_s(self.seconds(t_ns))

    def _travelled_at_s(self, t_s: Floats) -> Floats:
        """`travelled_at` by instants in seconds since `epoch_ns` [m]."""
        return np.interp(t_s, self.t_s, self._travelled_m)

    def moving_s_at(self, t_ns: Ints) -> Floats:
        """Time for which the train moved since the first row [s]."""
        return np.interp(self.seconds(t_ns), *self._moving_s)

    def moved(self, t_ns: Ints) -> Bools:
        """Whether the train moved for more than half of each step (DOMAIN section 2), shape (n - 1,)."""
        return np.diff(self.moving_s_at(t_ns)) > 0.5 * np.diff(t_ns) / NS_PER_S

    def drove(self, begin_ns: Ints | int, end_ns: Ints, noise_m: Floats | float = 0.0) -> Bools:
        """Whether the train is farther from its place at `begin_ns` than dead band and `noise_m`; False in doubt."""
        return (
            np.abs(np.nan_to_num(self.proved_distance_between(begin_ns, end_ns)))
            > self._still_m(begin_ns, end_ns) + noise_m
        )

    def was_at_standstill(self, begin_ns: Ints | int, end_ns: Ints) -> Bools:
        """Whether it is no farther from its place at `begin_ns` than the dead band; not where that is in doubt."""
        still: Bools = np.abs(self.proved_distance_between(begin_ns, end_ns)) <= self._still_m(begin_ns, end_ns)
        return still

    def _still_m(self, begin_ns: Ints | int, end_ns: Ints) -> Floats:
        """What a wheel may move unnoticed in a time, below the speed that counts as standstill [m]."""
        return np.asarray(self.deadband_mps * np.abs(end_ns - begin_ns) / NS_PER_S)

    def distance_and_variance(self, begin_ns: Ints | int, end_ns: Ints) -> OdometerDistance:
        """True distance between instants, and its variance.

        s D, and s^2 (white noise over the time in which the train moved, quantisation noise of both rows) + (sigma_s
        D)^2 (DOMAIN section 5.1). NaN outside the recording and where the distance was lost in between; else off by
        `bound_m` besides.

        Args:
            begin_ns: instants from which, one or as many as `end_ns` [ns].
            end_ns: instants to which [ns], shape (n,).

        Returns:
            Signed distances, variances and bounds, shape (n,).
        """
        scale = self.scale or 1.0
        scale_sigma = self.scale_sigma or 0.0
        begin_ns = np.broadcast_to(begin_ns, end_ns.shape)
        begin_s, end_s = self.seconds(begin_ns), self.seconds(end_ns)
        inside = (np.minimum(begin_s, end_s) >= self.t_s[0]) & (np.maximum(begin_s, end_s) <= self.t_s[-1])
        bound_m = self.bound_between_m(begin_ns, end_ns)
        inside &= ~is_lost(bound_m)
        recorded = np.where(inside, self.distance_at_s(end_s) - self.distance_at_s(begin_s), np.nan)
        moving_s = np.abs(self.moving_s_at(end_ns) - self.moving_s_at(begin_ns))
        rows_m2 = self.row_sigma_m(begin_s) ** 2 + self.row_sigma_m(end_s) ** 2
        variance = scale**2 * (self.noise.white_m2_per_s * moving_s + rows_m2) + (scale_sigma * recorded) ** 2
        return OdometerDistance(scale * recorded, variance, bound_m)

    def bound_between_m(self, begin_ns: Ints | int, end_ns: Ints) -> Floats:
        """How much the distance between instants [ns] may be off, as braking and acceleration prove it [m]."""
        begin_ns = np.broadcast_to(begin_ns, end_ns.shape)
        if self.bound is None:
            return np.zeros(end_ns.size)
        return (self.scale or 1.0) * self.bound.between_m(self.seconds(begin_ns), self.seconds(end_ns))

    def distance_between(self, begin_ns: Ints | int, end_ns: Ints) -> Floats:
        """Signed distance between instants [ns] as the train believes it [m]; NaN where any of it is in doubt."""
        begin_ns = np.broadcast_to(begin_ns, end_ns.shape)
        same = self.cumulative_doubt_m(self.seconds(begin_ns)) == self.cumulative_doubt_m(self.seconds(end_ns))
        return self._counted_between(begin_ns, end_ns, same)

    def proved_distance_between(self, begin_ns: Ints | int, end_ns: Ints) -> Floats:
        """Signed distance between instants [ns] [m]; NaN where braking and acceleration leave any of it in doubt."""
        begin_ns = np.broadcast_to(begin_ns, end_ns.shape)
        return self._counted_between(begin_ns, end_ns, self.bound_between_m(begin_ns, end_ns) == 0.0)

    def steps_m(self, t_ns: Ints) -> Floats:
        """`proved_distance_between` each instant [ns] and the next [m], shape (n - 1,)."""
        return self._where_sure(np.diff(self.distance_at(t_ns)), self.bound_between_m(t_ns[:-1], t_ns[1:]) == 0.0)

    def _counted_between(self, begin_ns: Ints, end_ns: Ints, sure: Bools) -> Floats:
        """Recorded distance between instants, scaled [m]; NaN where not `sure`."""
        return self._where_sure(self.distance_at(end_ns) - self.distance_at(begin_ns), sure)

    def _where_sure(self, moved_m: Floats, sure: Bools) -> Floats:
        """Recorded distances, scaled [m]; NaN where not `sure`."""
        return np.asarray((self.scale or 1.0) * np.where(sure, moved_m, np.nan))

    def increments(
        self, t_ns: Ints, scale: Floats, latency_s: Floats, now: OdometerReading | None = None
    ) -> Increments:
        """Corrected distance and change of speed of the step to each instant, 0 at the first.

        Both ends of a step are read with the scale and latency in use at the later one. `now`: the reading at the later
        ends, if it was made already.
        """
        steps = self._steps_s(t_ns, latency_s)
        now = now or self.read(steps.end_s)
        distance = scale * (now.distance_m - steps.at_begins(now.distance_m, self.distance_at_s))
        return Increments(distance, scale * (now.speed_mps - steps.at_begins(now.speed_mps, self.speed_at_s)))

    def driven(self, t_ns: Ints, scale: Floats, latency_s: Floats) -> Floats:
        """Distance driven between consecutive instants, to and fro [m]."""
        steps = self._steps_s(t_ns, latency_s)
        end_m = self._travelled_at_s(steps.end_s)
        return np.asarray(scale * (end_m - steps.at_begins(end_m, self._travelled_at_s)))

    def _steps_s(self, t_ns: Ints, latency_s: Floats) -> StepTimes:
        """Begin and end of the step to each instant, less the latency in use at its end; none at the first."""
        t_s = self.seconds(t_ns)
        now = t_s - latency_s
        return StepTimes(np.concatenate([now[:1], t_s[:-1] - latency_s[1:]]), now)

    def bridged_m2_at(self, t_s: Floats) -> Floats:
        """Sum of the variances over bridged resets up to each instant [m^2]."""
        return np.zeros(t_s.size) if self.bridged_m2 is None else np.interp(t_s, self.t_s, self.bridged_m2)

    def read(self, t_s: Floats) -> OdometerReading:
        """What the odometer reads at these instants [s]: distance, speed, doubt and noise, each made when asked for."""
        return OdometerReading(self, t_s)

    def known_at_s(self, t_s: Floats) -> Bools:
        """Whether each instant lies between two samples without a pause, none of which reports slip."""
        return self.read(t_s).known

    def distance_at_s(self, t_s: Floats) -> Floats:
        """Distance as recorded, interpolated also where it is not known, the end value outside the recording [m]."""
        return np.interp(t_s, self.t_s, self.distance_m)

    def speed_at_s(self, t_s: Floats) -> Floats:
        """Mean speed as recorded over the second before each instant [m/s]."""
        return self.read(t_s).speed_mps

    def speed_about(self, t_ns: Ints) -> Floats:
        """True speed over as much of the second about each instant as was recorded [m/s]; a best guess over a pause."""
        half_s = 0.5 * self.config.speed_window_s
        begin_s, end_s = (np.clip(self.seconds(t_ns) + off_s, self.t_s[0], self.t_s[-1]) for off_s in (-half_s, half_s))
        moved_m = self.distance_at_s(end_s) - self.distance_at_s(begin_s)
        return np.asarray((self.scale or 1.0) * moved_m / np.maximum(end_s - begin_s, 1e-9))

    def noise_at_s(self, t_s: Floats) -> KnownNoise:
        """The noise as the rows up to each instant show it."""
        return self.read(t_s).noise

    def row_sigma_m(self, t_s: Floats) -> Floats:
        """Sigma of the rows' noise, as the run shows it [m]."""
        if not self.noise.quantisation:
            return np.zeros(t_s.size)
        return np.sqrt(self.noise.quantisation.variance_m2(self.speed_at_s(t_s)))

    @cached_property
    def has_pauses(self) -> bool:
        """Whether there are two samples between which nothing is interpolated."""
        return bool(self.pause.any())

    @cached_property
    def has_slips(self) -> bool:
        """Whether any sample reports slip."""
        return bool(self.slip.any())

    @cached_property
    def _moving_s(self) -> tuple[Floats, Floats]:
        """Times, and for how long the train has moved up to each [s]."""
        at_s = self.t_s
        if not self.noise.quantisation:
            return at_s, _sums(np.where(self._moving_by_rows, np.diff(at_s), 0.0))
        row_sigma_m = self.row_sigma_m(at_s)
        at_s, at_m = evenly_driven(at_s, self.distance_m, row_sigma_m, self.deadband_mps, self.config)
        moving = moving_steps(at_s, at_m, self.deadband_mps, self.config.speed_window_s)
        return at_s, _sums(np.where(moving, np.diff(at_s), 0.0))

    @cached_property
    def _moving_by_rows(self) -> Bools:
        """Whether the train moves in each step, by the distance as it is."""
        return moving_steps(self.t_s, self.distance_m, self.deadband_mps, self.config.speed_window_s)

    @cached_property
    def _travelled_m(self) -> Floats:
        """Distance travelled at each row, whichever way the train went [m]."""
        width_m = self.read(self.t_s).hysteresis_m
        if not width_m.any():
            return np.asarray(np.maximum.accumulate(driven_or_left_m(self.distance_m, self._moving_by_rows)))
        return travelled_m(self.t_s, self.distance_m, width_m, self.deadband_mps, self.config.speed_window_s)


def odometry_of(stream: pl.DataFrame | None, vehicle: Vehicle, config: Configuration) -> Odometry | None:
    """The odometer of a cleaned stream, as recorded.

    In doubt are pauses beyond `odometer_gap_s` without a counter and slip that the odometer reports; lost is the
    distance over a leap or pause that nothing bridges. White noise is `odometer_sigma_mps`, or a larger declared
    `sigma_speed_mps`, taken as independent from row to row.

    Args:
        stream: the stream `odometer` of one sensor, cleaned, shape (n,); or None.
        vehicle: odometer scale and origin, as far as the file gives them.
        config: the configuration; used are `align`, `matching.deadband_mps` and `monitors.odometer_sigma_mps`.

    Returns:
        The odometer; None without at least two rows.

    Source:
        DOMAIN sections 3 (noise) and 5.1 (bounds).
    """
    if stream is None or stream.height < 2:
        return None
    align = config.align
    t_ns = times_ns(stream)
    speed = floats(stream, "speed_mps")
    t_s: Floats = ((t_ns - int(t_ns[0])) * 1e-9).astype(np.float64)
    dt_s = np.diff(t_s)
    distance_m = floats(stream, "distance_m")
    period_s = row_periods_s(t_ns)
    limit_s = np.maximum(align.odometer_gap_s, align.odometer_gap_periods * period_s[1:])
    counts = count_step(distance_m, align)
    distances = step_distances(t_s, distance_m, speed, counts.step_m, limit_s, align)
    moved_m, counted, bridged_m = distances.moved_m, distances.counted, distances.bridged_m
    unknown = np.isnan(moved_m)
    pause = unknown | (dt_s > limit_s)
    slip = slips_of(stream, align)
    uncounted_pause = pause & ~counted
    lost = uncounted_pause | slip[1:]
    guessed = uncounted_pause & ~unknown
    moved_m, guess_doubt_m = _guessed_distances(guessed, moved_m, dt_s, speed, period_s[1:], config)
    distance_m = _sums(np.where(unknown, 0.0, moved_m))
    whole = counted & ~lost & ~pause
    noise, known_noise = noise_of_rows(t_s, distance_m, whole, counts, period_s, declared_mps(stream), config)
    parts = _contradicted(t_s, distance_m, distances, known_noise, config)
    doubt_m = _slip_doubt_m(np.diff(distance_m), dt_s, slip, floats(stream, "sigma_speed_mps"), align)
    doubt_m += np.where(guessed, guess_doubt_m, parts.doubt_m)
    doubt_m = _sums(np.where(uncounted_pause & unknown, LOST_M, doubt_m))
    doubtful = distances.odd | pause | slip[:-1] | slip[1:] | parts.steps
    bound = (
        Bound.of(t_s, distance_m, doubtful, uncounted_pause & unknown, parts.off_m, align) if doubtful.any() else None
    )
    apart = np.flatnonzero((dt_s > align.straight_s) & ~pause & ~lost & ~slip[:-1])
    row_s = t_s
    if apart.size:
        t_s, distance_m, row = filled_in(t_s, distance_m, speed, apart, align)
        pause = pause[row[:-1]]
        slip = slip[row]
        doubt_m = np.interp(t_s, row_s, doubt_m)
        known_noise = known_noise.at(row)
    in_file = vehicle.odometer_scale is not None and vehicle.odometer_scale_sigma is not None
    return Odometry(
        epoch_ns=int(t_ns[0]),
        t_s=t_s,
        distance_m=distance_m,
        pause=pause,
        slip=slip,
        doubt_m=doubt_m,
        noise=noise,
        known_noise=known_noise,
        deadband_mps=config.matching.deadband_mps,
        period_s=median(dt_s),
        scale=vehicle.odometer_scale if in_file else None,
        scale_sigma=vehicle.odometer_scale_sigma if in_file else None,
        leaps_ns=tuple(t_ns[list(distances.resets)].tolist()),
        bridged_m2=np.interp(t_s, row_s, _sums(bridged_m**2)) if bridged_m.any() else None,
        bound=bound,
        config=align,
        origin=declared_origin(stream, vehicle),
    )


def _contradicted(
    t_s: Floats, distance_m: Floats, distances: StepDistances, noise: KnownNoise, config: Configuration
) -> Contradiction:
    """Whether the speeds contradict the counted distance beyond the noise of its rows."""
    align = config.align
    rows_m = np.zeros(t_s.size)
    if noise.scatters:
        begin_s = np.maximum(t_s - align.speed_window_s, t_s[0])
        speed_mps = (distance_m - np.interp(begin_s, t_s, distance_m)) / np.maximum(t_s - begin_s, 1e-9)
        rows_m = align.sure_sigmas * np.sqrt(2.0 * noise.row_m2(speed_mps))
    recorded_m = np.where(distances.counted & ~distances.odd, distances.moved_m, np.nan)
    return contradicted_by_speeds(t_s, recorded_m, distances.driven_m, rows_m, config.matching.deadband_mps, align)


def _guessed_distances(
    guessed: Bools, moved_m: Floats, dt_s: Floats, speed_mps: Floats, period_s: Floats, config: Configuration
) -> tuple[Floats, Floats]:
    """Distances with those over the pauses that are to be guessed by speeds, and by how much these may be off [m].

    Mean speed x dt (`moved_m`), with acceleration and braking up to b. But some loggers write nothing at a stand: where
    the train stands at one row and at the other is no faster than it gets in a period, it drove for a period before and
    after at most. Half of that is the distance; it may have stood then, or gone on at the slower speed.
    """
    doubt_m = np.zeros(moved_m.size)
    steps = np.flatnonzero(guessed)
    if not steps.size:
        return moved_m, doubt_m
    deadband_mps = config.matching.deadband_mps
    braking_mps2 = config.align.braking_mps2
    begin_mps, end_mps, steps_s, periods_s = speed_mps[steps], speed_mps[steps + 1], dt_s[steps], period_s[steps]
    slower_mps, faster_mps = np.sort(np.abs([begin_mps, end_mps]), axis=0)
    at_standstill = (slower_mps <= deadband_mps) & (faster_mps <= deadband_mps + braking_mps2 * periods_s)
    stand_m = 0.5 * periods_s * (begin_mps + end_mps)
    stand_doubt_m = 0.5 * periods_s * (slower_mps + faster_mps) + slower_mps * steps_s
    moved_m = moved_m.copy()
    moved_m[steps] = np.where(at_standstill, stand_m, moved_m[steps])
    doubt_m[steps] = np.where(at_standstill, stand_doubt_m, 0.25 * braking_mps2 * steps_s**2)
    return moved_m, doubt_m


def _slip_doubt_m(moved_m: Floats, dt_s: Floats, slip: Bools, sigma_mps: Floats, config: AlignConfig) -> Floats:
    """How much the count of each step into, in or out of slip may be off [m].

    A share of the step, or its reported sigma times dt: the error lasts while it slips. A locked wheel counts nothing.
    """
    if not slip.any():
        return np.zeros(moved_m.size)
    sigma_mps = np.nan_to_num(np.fmax(sigma_mps[1:], sigma_mps[:-1]))
    doubt_m = np.maximum(np.maximum(config.slip_way_share * np.abs(moved_m), sigma_mps * dt_s), LEAST_DOUBT_M)
    return np.where(slip[1:] | slip[:-1], doubt_m, 0.0)


def _sums(steps: Floats) -> Floats:
    """Running sum of steps from 0 on, shape (n,) to (n + 1,)."""
    return np.concatenate([[0.0], np.cumsum(steps)])
