"""The odometer as a function of time: distance along growing path, speed, and where it is not known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.odometry.reading import ReadingNoise, count_step_m, reading_noise
from schemas.arrays import Bools, Floats, Ints

Number = TypeVar("Number", np.float64, np.int64)

_NS = 1e-9
_GAP_IN_PERIODS = 2.5
_SPEED_WINDOW_S = 1.0
_POLARITY_STARTS = 40
# No train is faster: a counter that gains more was reset, ran over or lied. Stamps that come in bunches take so much.
_FASTEST_MPS = 200.0
_BUNCHED_M = 20.0
# Between rows no farther apart a straight line is within 0.5 m of a train that brakes; the finer step is within 0.1 m.
STRAIGHT_S = 1.5
_FINE_S = 0.5
_BRAKES_MPS2 = 1.8
# By which part of all that was driven a speed may differ from the distance and yet tell of a way that the latter lost.
_AGREE = 0.2


@dataclass(frozen=True)
class CountedRows:
    """Rows as recorded: times [s], distance [m], and which ways to the next row are by the recorded distance."""

    t_s: Floats
    distance_m: Floats
    whole: Bools


@dataclass(frozen=True)
class OdometerTrack:
    """Uncorrected odometer distance [m] over time [s since `epoch_ns`].

    `stretch` counts, sample by sample, how often the distance was lost before: two times can be compared only
    where the count is the same. `pause[i]` marks a pause of the recording between samples i and i+1, inside which
    nothing is interpolated. `white_rate_m2_per_s` is the variance that distance gathers in a second, `period_s` the
    time between recorded rows, `counted` those rows before others were filled in.
    """

    epoch_ns: int
    t_s: Floats
    distance_m: Floats
    stretch: npt.NDArray[np.int64]
    pause: Bools
    slip: Bools
    white_rate_m2_per_s: float
    period_s: float = 0.0
    counted: CountedRows | None = None

    @cached_property
    def reading(self) -> ReadingNoise:
        """Noise of single recorded rows; none where the way is by speeds alone."""
        rows = self.counted
        if rows is None:
            return ReadingNoise()
        return reading_noise(rows.t_s, rows.distance_m, rows.whole, self.white_rate_m2_per_s)

    @cached_property
    def count_step_m(self) -> float:
        """The step of a counter [m], 0 where there is none worth a word."""
        rows = self.counted
        return 0.0 if rows is None else count_step_m(rows.distance_m, rows.whole)

    def oriented(self, sign: int) -> OdometerTrack:
        """The same odometer, growing with the path."""
        return replace(self, distance_m=sign * self.distance_m)

    def seconds(self, t_ns: Ints) -> Floats:
        """Times on the odometer's own scale [s]."""
        return ((t_ns - self.epoch_ns) * _NS).astype(np.float64)

    def distance_at(self, t_s: Floats) -> Floats:
        """Distance at these times [m]; outside the span the end value (see `known_at`)."""
        return np.interp(t_s, self.t_s, self.distance_m)

    def known_at(self, t_s: Floats) -> Bools:
        """True where both neighbouring samples exist, without a pause between them, and report no slip."""
        after = np.searchsorted(self.t_s, t_s, side="left").clip(0, self.t_s.size - 1)
        exact = self.t_s[after] == t_s
        before = np.where(exact, after, np.maximum(after - 1, 0))
        inside = (t_s >= self.t_s[0]) & (t_s <= self.t_s[-1])
        paused = ~exact & self.pause[np.minimum(before, self.pause.size - 1)]
        known: Bools = inside & ~paused & ~self.slip[before] & ~self.slip[after]
        return known

    def stretch_at(self, t_s: Floats) -> npt.NDArray[np.int64]:
        """Number of the stretch of unbroken distance that each time lies in."""
        index = np.searchsorted(self.t_s, t_s, side="right") - 1
        stretch: npt.NDArray[np.int64] = self.stretch[index.clip(0, self.t_s.size - 1)]
        return stretch

    def speed_at(self, t_s: Floats) -> Floats:
        """Mean speed over the second before [m/s]: causal, and free of the noise of single samples."""
        start = np.maximum(t_s - _SPEED_WINDOW_S, self.t_s[0])
        span = np.maximum(np.minimum(t_s, self.t_s[-1]) - start, _NS)
        speed: Floats = (self.distance_at(t_s) - self.distance_at(start)) / span
        return speed


def odometer_track(odometer: pl.DataFrame, gap_s: float, sigma_mps: float) -> OdometerTrack:
    """Distance from the recorded distance where there is one, else from speed (trapezoids).

    Where rows hold the one or the other by turns (two sensors in one stream), each is carried between its own rows.
    A pause longer than `gap_s` (and than 2.5 periods) loses the way of speed-only odometry: the speeds before and after
    it give the best guess, good for an expectation window, but a new `stretch` begins. A cumulative distance carries
    over it, also where rows are by turns. Slip that the odometer itself reports loses the way too, and so does a leap
    of the distance (`leaps`) where no speed that agrees with it elsewhere tells the way. Rows far apart are filled in
    by what the speeds at both tell. `sigma_mps` is the white noise at 1 Hz; a larger declared `sigma_speed_mps`, taken
    as independent from sample to sample, replaces it.
    """
    t_ns = odometer["t"].dt.timestamp("ns").to_numpy()
    epoch_ns = int(t_ns[0])
    t_s = (t_ns - epoch_ns) * _NS
    dt = np.diff(t_s)
    period = float(np.median(dt))
    limit_s = max(gap_s, _GAP_IN_PERIODS * period)
    distance, speed = (odometer[name].cast(pl.Float64).to_numpy() for name in ("distance_m", "speed_mps"))
    step, counted = _ways(t_s, dt, distance, speed, limit_s)
    unknown = np.isnan(step)
    pause = unknown | (dt > limit_s)
    slip = odometer["slip"].fill_null(False).to_numpy()
    lost = (pause & ~counted) | slip[1:]
    step[unknown] = 0.0
    declared = odometer["sigma_speed_mps"].median()
    declared_rate = float(declared) ** 2 * period if isinstance(declared, float) else 0.0
    distance_m = _sums(step)
    track = OdometerTrack(
        epoch_ns=epoch_ns,
        t_s=t_s,
        distance_m=distance_m,
        stretch=_sums(lost.astype(np.int64)),
        pause=pause,
        slip=slip,
        white_rate_m2_per_s=max(sigma_mps**2, declared_rate),
        period_s=period,
        counted=CountedRows(t_s, distance_m, counted & ~lost & ~pause) if counted.any() else None,
    )
    apart = (dt > STRAIGHT_S) & ~pause & ~lost & ~slip[:-1]
    return _filled_in(track, speed, np.flatnonzero(apart)) if apart.any() else track


def leaps(way_m: Floats, dt_s: Floats) -> Bools:
    """Ways between rows, in these times, that are longer than any train can drive."""
    leap: Bools = np.abs(way_m) > _FASTEST_MPS * dt_s + _BUNCHED_M
    return leap


def _without_spikes(t_s: Floats, distance_m: Floats) -> Floats:
    """The distance without single rows from which it leaps back to where it was."""
    leap = leaps(np.diff(distance_m), np.diff(t_s))
    if not leap.any():
        return distance_m
    over = leap[1:] & leap[:-1] & ~leaps(distance_m[2:] - distance_m[:-2], t_s[2:] - t_s[:-2])
    cleaned = distance_m.copy()
    cleaned[1:-1][over] = np.nan
    return cleaned


def _filled_in(track: OdometerTrack, speed_mps: Floats, rows: npt.NDArray[np.int64]) -> OdometerTrack:
    """The track with samples between these rows and the next, on cubic curves.

    Their slopes at the rows are the speeds where these make about the way between (a unit, a sign or a sensor may be
    wrong), else those of a curve through the distances that keeps its direction (PCHIP), and never so steep that the
    train would turn back in between.
    """
    from scipy.interpolate import PchipInterpolator  # hardly a log needs it, and it takes long to load

    t_s, distance = track.t_s, track.distance_m
    smooth = PchipInterpolator(t_s, distance).derivative()(t_s)
    slopes = np.where(np.isfinite(speed_mps), speed_mps, smooth)
    span, way = t_s[rows + 1] - t_s[rows], distance[rows + 1] - distance[rows]
    # Whatever a train does that gathers speed or brakes no harder, the mean of two speeds is no farther from its way.
    true = np.abs(0.5 * (slopes[rows] + slopes[rows + 1]) * span - way) <= 0.25 * _BRAKES_MPS2 * span**2
    low, high = np.minimum(0.0, 3.0 * way), np.maximum(0.0, 3.0 * way)
    start, end = (np.clip(np.where(true, slopes[at], smooth[at]) * span, low, high) for at in (rows, rows + 1))
    fine = np.ceil(span / _FINE_S).astype(np.int64)
    which = np.repeat(np.arange(rows.size), fine - 1)
    part = np.concatenate([np.arange(1, count) / count for count in fine.tolist()])
    rest = 1.0 - part
    curve = part**2 * (3.0 - 2.0 * part) * way[which] + part * rest * (rest * start[which] - part * end[which])
    at_s = np.concatenate([t_s, t_s[rows][which] + part * span[which]])
    order = np.argsort(at_s, kind="stable")
    source = np.concatenate([np.arange(t_s.size), rows[which]])[order]
    return replace(
        track,
        t_s=at_s[order],
        distance_m=np.concatenate([distance, distance[rows][which] + curve])[order],
        stretch=track.stretch[source],
        pause=track.pause[source[:-1]],
        slip=track.slip[source],
    )


def _sums(steps: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Sums of the steps before each row; 0 at the first."""
    sums = np.zeros(steps.size + 1, steps.dtype)
    np.cumsum(steps, out=sums[1:])
    return sums


def _ways(t_s: Floats, dt_s: Floats, distance_m: Floats, speed_mps: Floats, limit_s: float) -> tuple[Floats, Bools]:
    """Way from each row to the next [m], NaN where not known, and whether it is by the recorded distance."""
    distance_m = _without_spikes(t_s, distance_m)
    way_m = np.diff(distance_m)
    recorded = _drivable(way_m, dt_s)
    driven = _trusted(_driven(speed_mps, dt_s), recorded, leaps(way_m, dt_s))
    counted = ~np.isnan(recorded)
    step = np.where(counted, recorded, driven)
    unknown = np.isnan(step)
    if not unknown.any():
        return step, counted
    way_m = np.diff(_carried(t_s, distance_m, limit_s))
    recorded = np.where(unknown, _drivable(way_m, dt_s), recorded)
    driven = _trusted(_driven(_carried(t_s, speed_mps, limit_s), dt_s), recorded, leaps(way_m, dt_s))
    recorded = _over_pauses(t_s, distance_m, recorded, driven, dt_s > limit_s)
    counted = ~np.isnan(recorded)
    return np.where(counted, recorded, driven), counted


def _trusted(driven_m: Floats, recorded_m: Floats, leap: Bools) -> Floats:
    """Ways by the speeds; none over leaps where they do not agree with what the counter tells elsewhere.

    A unit, a sign or the sensor may be wrong.
    """
    both = np.isfinite(recorded_m) & np.isfinite(driven_m)
    if not leap.any() or not both.any():
        return driven_m
    recorded, driven = recorded_m[both], driven_m[both]
    apart_m, most_m = abs(recorded.sum() - driven.sum()), _AGREE * np.abs(recorded).sum()
    return driven_m if apart_m <= most_m else np.where(leap, np.nan, driven_m)


def _drivable(way_m: Floats, dt_s: Floats) -> Floats:
    """Ways that a train can drive, NaN for others."""
    return np.where(leaps(way_m, dt_s), np.nan, way_m)


def _driven(speed_mps: Floats, dt_s: Floats) -> Floats:
    steps: Floats = 0.5 * (speed_mps[1:] + speed_mps[:-1]) * dt_s
    return steps


def _carried(t_s: Floats, values: Floats, limit_s: float) -> Floats:
    """Values between known rows no further apart than the limit by straight lines; NaN elsewhere."""
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2:
        return values
    after = np.searchsorted(known, np.arange(values.size)).clip(1, known.size - 1)
    near = t_s[known[after]] - t_s[known[after - 1]] <= limit_s
    inside = (t_s >= t_s[known[0]]) & (t_s <= t_s[known[-1]])
    return np.where(
        np.isfinite(values), values, np.where(near & inside, np.interp(t_s, t_s[known], values[known]), np.nan)
    )


def _over_pauses(t_s: Floats, distance_m: Floats, recorded_m: Floats, driven_m: Floats, pause: Bools) -> Floats:
    """Recorded steps, and over a pause between rows without a distance what the counter gained around it.

    The counter's last row before the pause and its first after it tell, less the steps to and from the pause. A
    missing distance beside a speed is no pause: there the counter may have been set to zero. Nor does it tell where it
    was reset in the pause itself.
    """
    known = np.flatnonzero(np.isfinite(distance_m))
    steps = np.where(np.isnan(recorded_m), driven_m, recorded_m)
    result = recorded_m.copy()
    for gap in np.flatnonzero(pause & np.isnan(recorded_m)).tolist():
        after = int(np.searchsorted(known, gap, side="right"))
        if 0 < after < known.size:
            begin, end = int(known[after - 1]), int(known[after])
            beside, gained = np.delete(steps[begin:end], gap - begin), distance_m[end] - distance_m[begin]
            result[gap] = _drivable(gained, t_s[end] - t_s[begin]) - beside.sum()
    return result


def polarity(track: OdometerTrack, t_s: Floats, path_m: Floats, distance_m: float) -> int:
    """+1 or -1: the odometer's sign against growing path, from the first `distance_m` of net movement.

    `path_m` grows in the direction of that same movement (DOMAIN section 2), so GNSS decides once, over these
    metres only: starts every metre have a vote each, so that a leap of the
    position in between does not turn the odometer round. A run that never moves so far is judged by its largest
    movement.
    """
    usable = np.flatnonzero(np.isfinite(path_m) & track.known_at(t_s))
    if usable.size < 2:
        return 1
    odometer, path = track.distance_at(t_s[usable]), path_m[usable]
    way = np.maximum.accumulate(np.abs(odometer - odometer[0]))
    window = int(np.searchsorted(way, 4.0 * distance_m)) + 1
    # Starts a fixed way apart: a long stand before the departure has one vote, not thousands.
    starts = np.unique(np.searchsorted(way, np.linspace(0.0, 2.0 * distance_m, _POLARITY_STARTS)))
    starts = starts[starts < min(window, way.size)]
    votes = [_side(odometer[start:window], path[start:window], distance_m) for start in starts]
    return -1 if sum(votes) < 0 else 1


def _side(odometer: Floats, path: Floats, distance_m: float) -> int:
    """Whether path and odometer go the same way (1), opposite ways (-1) or nowhere (0) over these metres."""
    moved = odometer - odometer[0]
    far = np.flatnonzero(np.abs(moved) >= distance_m)
    end = int(far[0]) if far.size else int(np.argmax(np.abs(moved)))
    return int(np.sign(moved[end] * (path[end] - path[0])))
