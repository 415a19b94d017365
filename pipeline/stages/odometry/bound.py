"""Steps of a counter that no train drives: where the distance leaps, stalls, or was set to another value.

A step is odd where its speed differs from that of the neighbouring step by more than a train brakes or accelerates and
rows scatter. A run is consecutive odd steps; the mean speed around it says how far the train drove meanwhile, within
G(T), for a run of T seconds: b T^2 / 4 by the speeds at its ends, and b T w / 2 as the mean over w on either side
stands for them, where the acceleration changes from +b to -b just there.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np
import polars as pl

from schemas.arrays import Bools, Floats, Ints, spans_of
from schemas.config import AlignConfig, Configuration
from schemas.frozen import frozen

# A normal distribution's median of |x|, in sigmas; variances of the second and third difference of equal rows.
_MEDIAN_SIGMAS = 0.6745
_SECOND, _THIRD = 6.0, 20.0
# Numerics of running medians: rows of noise, and of periods; the first rows share the estimate of so many.
_NOISE_ROWS, _FIRST_ROWS, _FEWEST_ROWS, _PERIOD_ROWS, _SPEED_ROWS = 255, 32, 12, 31, 7


# Added to a sum of doubt where the distance is lost [m]: not infinity, of which differences are no numbers, nor so much
# that sums lose small doubts. More than half of it is lost.
LOST_M = 1e6


class OddRun(NamedTuple):
    """Rows `first` to `last`; counted distance [m]; mean speed around it [m/s], NaN where one side has none.

    `off_m`: by how much the train may have driven another distance than was counted.
    """

    first: int
    last: int
    counted_m: float
    mean_mps: float
    off_m: float
    kept: bool
    """The count over the whole run stands: single rows were wrong, or it is only nearly odd."""


class OddRuns(NamedTuple):
    """`odd`: replaced or interpolated; `near`: counted as it is, though a small leap may hide in it."""

    odd: list[OddRun]
    near: list[OddRun]


class _CounterRows(NamedTuple):
    """Rows of a counter without gaps, its step as known before each, and what second differences scatter by [m].

    `period_s`: mean period of the rows before each step.
    """

    t_s: Floats
    distance_m: Floats
    counts_m: Floats
    scatter_m: Floats  # of interior rows
    period_s: Floats


def driven_within_m(time_s: float, config: AlignConfig, about_s: float | None = None) -> float:
    """G(T) [m]: how far the distance run in `time_s` may be from the mean speed over `about_s` around it."""
    about_s = window_around_s(time_s, config) if about_s is None else about_s
    return 0.25 * config.braking_mps2 * time_s**2 + 0.5 * config.braking_mps2 * time_s * about_s


def window_around_s(time_s: float, config: AlignConfig) -> float:
    """Time over which the mean speed on either side is taken, w [s]; rounded stamps take in the row at its edge."""
    return config.speed_window_s + 0.5 * time_s


def odd_runs(t_s: Floats, distance_m: Floats, counts_m: Floats | float, config: AlignConfig) -> OddRuns:
    """Runs of rows in which the counter leapt, stalled or was set, by how it counts elsewhere.

    Args:
        t_s: times of the rows [s], shape (n,).
        distance_m: what the counter shows [m], NaN where not recorded, shape (n,).
        counts_m: step of the counter as known at each row [m], 0 where none is, shape (n,) or one for all.
        config: the section `align` of the configuration.

    Returns:
        Runs of rows that are odd, and those near enough to odd that a small leap may hide in them.
    """
    rows = np.flatnonzero(np.isfinite(distance_m))
    if rows.size < 3:
        return OddRuns([], [])
    counts_m = np.broadcast_to(counts_m, t_s.shape)[rows]
    t_s, distance_m = t_s[rows], distance_m[rows]
    before_m = np.concatenate([counts_m[:1], counts_m[:-1]])
    period_s = _periods_s(t_s, config)
    scatter_m = _scatter_m(t_s, distance_m, before_m)
    # Rows farther apart differ by how the train drives.
    scatter_m = np.where(period_s[1:] > config.straight_s, 0.0, scatter_m)
    counted = _CounterRows(t_s, distance_m, before_m, scatter_m, period_s)
    leaps, _ = _places(counted, config)
    # Near ones are for evidence, which may look back: a counter whose step is not yet known is healthy all the same.
    _, near = _places(counted._replace(counts_m=np.maximum(before_m, counts_m[-1])), config)
    stalls, near_stalls = _stalls(counted, config)
    odd = _between_places(leaps, t_s.size, config) | stalls | _too_far(t_s, distance_m, config)
    odd |= _set_in_a_hole(counted, stalls, config)
    close = _between_places(leaps | near, t_s.size, config) | _around_lone(leaps | near, t_s.size, config)
    close = (close | near_stalls) & ~odd
    found = _runs(counted, odd, odd, config)
    small = _runs(counted, close, odd, config)
    return OddRuns([_in_all_rows(run, rows) for run in found], [_in_all_rows(run, rows) for run in small])


def _in_all_rows(run: OddRun, rows: Ints) -> OddRun:
    """The run with its rows counted among all rows, not only those with a distance."""
    return run._replace(first=int(rows[run.first]), last=int(rows[run.last]))


def _scatter_m(t_s: Floats, distance_m: Floats, counts_m: Floats) -> Floats:
    """Sigma of the second difference at each interior row, from the rows before; a counter's own step left out.

    By third differences: constant braking has none.
    """
    third_m = np.abs(np.diff(distance_m, 3))
    if third_m.size < _FEWEST_ROWS:
        return np.zeros(t_s.size - 2)
    median_m = _running_median(third_m, _NOISE_ROWS)
    median_m[:_FIRST_ROWS] = median_m[min(_FIRST_ROWS, median_m.size) - 1]
    variance_m2 = _SECOND / _THIRD * (median_m / _MEDIAN_SIGMAS) ** 2
    variance_m2 = np.concatenate([variance_m2[:1], variance_m2]) - counts_m[1:-1] ** 2
    return np.sqrt(np.maximum(variance_m2, 0.0) + _by_stamps_m(t_s, distance_m) ** 2)


def _by_stamps_m(t_s: Floats, distance_m: Floats) -> Floats:
    """The same by stamps that scatter, at the speed before: a train that departs shows it in no row before."""
    third_s = _running_median(np.abs(np.diff(t_s, 3)), _NOISE_ROWS)
    third_s[:_FIRST_ROWS] = third_s[min(_FIRST_ROWS, third_s.size) - 1]
    speed_mps = _running_median(np.abs(np.diff(distance_m) / np.diff(t_s)), _SPEED_ROWS)[:-1]
    scatter_s = np.sqrt(_SECOND / _THIRD) * third_s / _MEDIAN_SIGMAS
    scatter_m: Floats = speed_mps * np.concatenate([scatter_s[:1], scatter_s])
    return scatter_m


def _running_median(values: Floats, window: int) -> Floats:
    """Median of the values up to each."""
    return pl.Series(values).rolling_median(window, min_samples=1).to_numpy().copy()


def _periods_s(t_s: Floats, config: AlignConfig) -> Floats:
    """Mean period of the rows before each step [s], pauses cut short.

    A median would be the period within a bunch of rows that arrive together.
    """
    means = pl.Series(np.minimum(np.diff(t_s), config.odometer_gap_s)).rolling_mean(_PERIOD_ROWS, min_samples=1)
    means_s = means.to_numpy()
    return np.concatenate([means_s[:1], means_s[:-1]])


def _places(counted: _CounterRows, config: AlignConfig) -> tuple[Bools, Bools]:
    """Rows between steps that differ more than a train and the tolerance, and than a train and the rows' scatter."""
    dt_s = np.diff(counted.t_s)
    speed_mps = np.diff(counted.distance_m) / dt_s
    least_s = np.minimum(dt_s[1:], dt_s[:-1])
    # Beyond what braking explains: |dv| T - b (T1 + T2) / 2 T, T the shorter of both steps.
    apart_m = np.abs(np.diff(speed_mps)) * least_s - 0.5 * config.braking_mps2 * (dt_s[1:] + dt_s[:-1]) * least_s
    bunched = least_s < 0.5 * counted.period_s[1:]
    rows_m = 2.0 * counted.counts_m[1:-1] + config.sure_sigmas * counted.scatter_m
    leap = apart_m > rows_m + np.where(bunched, config.bunched_stamps_m, config.leap_m)
    near = (apart_m > rows_m + config.near_leap_m) & ~bunched
    leaps, nears = np.zeros((2, counted.t_s.size), dtype=np.bool_)
    leaps[1:-1], nears[1:-1] = leap, near
    return leaps, nears


def _between_places(places: Bools, size: int, config: AlignConfig) -> Bools:
    """Steps between two places with fewer than `leap_steps` between them.

    From a lone place so near an end of the recording, the steps to that end.
    """
    odd = np.zeros(size - 1, dtype=np.bool_)
    rows = np.flatnonzero(places)
    for begin, end in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        odd[begin:end] = end - begin < config.leap_steps
    for row in rows[~(odd[rows - 1] | odd[rows])].tolist():
        to_end = size - 1 - row
        if min(row, to_end) < config.leap_steps:
            odd[slice(row, None) if to_end <= row else slice(0, row)] = True
    return odd


def _around_lone(places: Bools, size: int, config: AlignConfig) -> Bools:
    """Both steps next to places that have no other one near."""
    odd = np.zeros(size - 1, dtype=np.bool_)
    rows = np.flatnonzero(places)
    away = np.diff(rows, prepend=-config.leap_steps, append=size + config.leap_steps) >= config.leap_steps
    for row in rows[away[1:] & away[:-1]].tolist():
        odd[row - 1 : row + 1] = True
    return odd


def _too_far(t_s: Floats, distance_m: Floats, config: AlignConfig) -> Bools:
    """Farther than any train drives."""
    far: Bools = np.abs(np.diff(distance_m)) > config.fastest_mps * np.diff(t_s) + config.bunched_stamps_m
    return far


def _stalls(counted: _CounterRows, config: AlignConfig) -> tuple[Bools, Bools]:
    """Repeated rows while the train drove on, with the step after them; and those where it may have stood but for
    `near_leap_m`.
    """
    t_s, distance_m = counted.t_s, counted.distance_m
    stalls, nears = np.zeros((2, t_s.size - 1), dtype=np.bool_)
    repeats = np.diff(distance_m) == 0.0
    sums = _Sums.of(t_s, distance_m, np.zeros_like(repeats))
    last_counts_m = float(counted.counts_m[-1])  # as for near leaps: evidence may look back
    for begin, last in spans_of(repeats):
        end = last + 1
        time_s = float(t_s[end] - t_s[begin])
        about_s = window_around_s(time_s, config)
        # Less around it may be a single count.
        if t_s[begin] - about_s < t_s[0] or t_s[end] + about_s > t_s[-1]:
            continue
        around = sums.speeds_around(t_s, begin, end, config)
        missing_m = abs(around.mean_mps) * time_s - driven_within_m(time_s, config, around.about_s)
        counts_m = float(counted.counts_m[begin])
        scatter_m = config.sure_sigmas * float(counted.scatter_m[end - 1])
        stalls[begin : end + 1] = missing_m > config.leap_m + 2.0 * counts_m + scatter_m
        nears[begin : end + 1] = missing_m > config.near_leap_m + 2.0 * max(counts_m, last_counts_m) + scatter_m
    return stalls, nears


def _set_in_a_hole(counted: _CounterRows, odd: Bools, config: AlignConfig) -> Bools:
    """Steps over missing rows: the short step next to one shows little of a leap in it."""
    t_s, distance_m, period_s = counted.t_s, counted.distance_m, counted.period_s
    dt_s = np.diff(t_s)
    bunched = dt_s < 0.5 * period_s
    next_to_bunched = bunched | np.append(bunched[1:], False) | np.append([False], bunched[:-1])
    hole = (dt_s > config.odometer_gap_periods * period_s) & (dt_s <= config.odometer_gap_s) & ~(odd | next_to_bunched)
    sums = _Sums.of(t_s, distance_m, odd | hole)
    found = np.zeros(dt_s.size, dtype=np.bool_)
    for step in np.flatnonzero(hole).tolist():
        time_s = float(dt_s[step])
        around = sums.speeds_around(t_s, step, step + 1, config)
        off_m = abs(distance_m[step + 1] - distance_m[step] - around.mean_mps * time_s)
        scatter_m = config.sure_sigmas * float(counted.scatter_m[min(step, counted.scatter_m.size - 1)])
        within_m = driven_within_m(time_s, config, around.about_s)
        found[step] = off_m > config.leap_m + 2.0 * float(counted.counts_m[step]) + scatter_m + within_m
    return found


class _SpeedsAround(NamedTuple):
    """Mean speeds before and after [m/s], NaN where no step counts there; over how long [s]."""

    before_mps: float
    after_mps: float
    about_s: float

    @property
    def mean_mps(self) -> float:
        """Both sides equal."""
        return 0.5 * (self.before_mps + self.after_mps)


class _Sums(NamedTuple):
    """Distance [m] and time [s] up to each row of the steps that count."""

    distance_m: Floats
    time_s: Floats

    @classmethod
    def of(cls, t_s: Floats, distance_m: Floats, left_out: Bools) -> _Sums:
        """The bound over all steps but those left out."""
        distances, times = (
            np.concatenate([[0.0], np.cumsum(np.where(left_out, 0.0, np.diff(values)))]) for values in (distance_m, t_s)
        )
        return cls(distances, times)

    def speeds_around(self, t_s: Floats, first: int, last: int, config: AlignConfig) -> _SpeedsAround:
        """What the train drove before `first` and after `last`."""
        about_s = window_around_s(float(t_s[last] - t_s[first]), config)
        begin = max(min(int(np.searchsorted(t_s, t_s[first] - about_s)), first - 1), 0)
        end = min(max(int(np.searchsorted(t_s, t_s[last] + about_s, side="right")) - 1, last + 1), t_s.size - 1)
        about_s = max(about_s, 0.5 * float(t_s[first] - t_s[begin] + t_s[end] - t_s[last]))
        return _SpeedsAround(self._mean_mps(begin, first), self._mean_mps(last, end), about_s)

    def _mean_mps(self, begin: int, end: int) -> float:
        """Mean speed over the steps that count between two rows; NaN without any."""
        time_s = float(self.time_s[end] - self.time_s[begin])
        return float(self.distance_m[end] - self.distance_m[begin]) / time_s if time_s > 0.0 else float("nan")


def weighed(t_s: Floats, distance_m: Floats, steps: Bools, config: AlignConfig) -> list[OddRun]:
    """Each run of these steps (pauses, slip) by the mean speed around it."""
    scatter_m = np.zeros(max(t_s.size - 2, 1))
    counted = _CounterRows(t_s, distance_m, np.zeros(t_s.size), scatter_m, _periods_s(t_s, config))
    return _runs(counted, steps, steps, config)


def _runs(counted: _CounterRows, steps: Bools, left_out: Bools, config: AlignConfig) -> list[OddRun]:
    """Runs of `steps`; speeds around them are taken of steps that are neither in `steps` nor in `left_out`."""
    if not steps.any():
        return []
    t_s, distance_m = counted.t_s, counted.distance_m
    sums = _Sums.of(t_s, distance_m, steps | left_out)
    runs = []
    for first, last_step in spans_of(steps):
        last = last_step + 1
        time_s = float(t_s[last] - t_s[first])
        counted_m = float(distance_m[last] - distance_m[first])
        before_mps, after_mps, about_s = around = sums.speeds_around(t_s, first, last, config)
        mean_mps = around.mean_mps
        one_sided = np.isnan(mean_mps)
        # At an end of the recording one side alone gives the distance: b T^2 / 4 more.
        within_m = driven_within_m(time_s, config, about_s)
        within_m += 0.25 * config.braking_mps2 * time_s**2 if one_sided else 0.0
        about_mps = float(np.fmin(before_mps, after_mps)) if one_sided else mean_mps
        off_m = abs(counted_m - about_mps * time_s)
        scatter_m = config.sure_sigmas * float(counted.scatter_m[min(first, counted.scatter_m.size - 1)])
        kept = off_m <= config.leap_m + 2.0 * float(counted.counts_m[first]) + scatter_m + within_m
        doubt_m = off_m + within_m if np.isfinite(off_m) else LOST_M
        runs.append(OddRun(first, last, counted_m, mean_mps, doubt_m, bool(kept)))
    return runs


# Each step of slip is in doubt by so much at least [m]: a locked wheel counts nothing.
LEAST_DOUBT_M = 1e-3


def is_lost(doubt_m: Floats) -> Bools:
    """Differences of a sum of doubt that hold a loss of the distance: nothing of it is left."""
    lost: Bools = np.abs(doubt_m) > 0.5 * LOST_M
    return lost


@frozen
class Bound:
    """Sums over runs of steps whose count may be off, per row at `t_s` [m].

    `begun_m`: of the runs that began before a row; `ended_m`: of those that ended by it. A movement that touches a run
    has all of its bound, as its error may have arisen at any place in it.
    """

    t_s: Floats
    begun_m: Floats
    ended_m: Floats

    @classmethod
    def of(
        cls, t_s: Floats, distance_m: Floats, doubtful: Bools, lost: Bools, least_m: Floats, config: AlignConfig
    ) -> Bound:
        """All per step: `doubtful` by leaps, stalls, pauses, slip, speeds; `lost`, not known at all; by `least_m`."""
        begun_m, ended_m = np.zeros((2, t_s.size))
        # Number of losses before each step.
        gone = np.concatenate([[0], np.cumsum(lost)])
        for run in weighed(t_s, distance_m, doubtful | lost, config):
            off_m = max(run.off_m, float(least_m[run.first : run.last].sum()))
            off_m = LOST_M if gone[run.last] > gone[run.first] else off_m
            begun_m[run.first + 1] += off_m
            ended_m[run.last] += off_m
        return cls(t_s, np.cumsum(begun_m), np.cumsum(ended_m))

    def between_m(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Bound of the movements between instants [m], in either order; lost outside the recording."""
        first_s, last_s = np.minimum(begin_s, end_s), np.maximum(begin_s, end_s)
        before = np.searchsorted(self.t_s, first_s, side="right") - 1
        after = np.searchsorted(self.t_s, last_s, side="left")
        inside = (before >= 0) & (after < self.t_s.size)
        size = self.t_s.size - 1
        between_m = self.begun_m[np.minimum(after, size)] - self.ended_m[np.maximum(before, 0)]
        # An instant at a row has neither of the steps next to it: no movement.
        return np.where(inside, np.where(last_s > first_s, np.maximum(between_m, 0.0), 0.0), LOST_M)


Number = TypeVar("Number", float, Floats)


@frozen
class RecoveryRule:
    """`recovery_s` without a fast failure, and GNSS minus odometer what it was at the anchor, within the bound."""

    config: Configuration

    @property
    def most_m(self) -> float:
        """Half of the failure limit [m]: no bound is wider, and no more may be in doubt."""
        return self.config.hazards.limits.relink_m

    def recovery_is_over(self, since_failure_s: float | Floats) -> Bools:
        """Whether no fast monitor failed for `lds.recovery_s`; `since_failure_s`: time since the last one [s]."""
        return np.asarray(since_failure_s) >= self.config.lds.recovery_s

    def variance_m2(self, positions_m2: Number, elapsed_s: Number, distance_m: Number, sigma_scale: float) -> Number:
        """What GNSS minus odometer moves by without a fault.

        Args:
            positions_m2: sum of the variances of both positions [m^2].
            elapsed_s: time between them [s].
            distance_m: distance run between them [m].
            sigma_scale: standard deviation of the odometer scale [1].

        Returns:
            Variance [m^2], of the shape of the arguments.
        """
        return positions_m2 + self.config.monitors.odometer_sigma_mps**2 * elapsed_s + (sigma_scale * distance_m) ** 2

    def bound_m(self, variance_m2: float | Floats) -> Floats:
        """min(failure limit / 2, k_T sqrt(variance)) [m]."""
        factor = self.config.monitors.threshold_factor
        return np.minimum(self.most_m, factor * np.sqrt(variance_m2))
