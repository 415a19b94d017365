"""Whether an odometer is made of the positions of a solution: its steps compared with theirs (DOMAIN section 5.0).

Of the rows as they were written, not of `Odometry`: what that bridges, interpolates or takes from another sensor is
predicted by its neighbours, and would be taken for a copy of the positions or hide one. So a break is any missing row
here, of either recorder, where `Odometry` asks whether the distance went on; and movement is what gives the positions a
direction, where `Odometry` asks whether the train left its place.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import curvature_radii_m
from schemas.arrays import Bools, Floats, Ints, floats, median, spans_of, times_ns, truths
from schemas.config import Configuration, EvidenceConfig
from schemas.enums import Fix
from schemas.frozen import frozen

# Slower, positions that scatter by metres show no direction [m/s]; speeds and directions are of so long around [s].
_MOVING_MPS = 1.0
_AROUND_S = 3.0
# A step longer than so many usual ones is a pause.
_PAUSE_PERIODS = 1.6
_FEWEST = 10


@frozen
class Steps:
    """From one stamp of the slower recorder to the next, `t_s` at their begins; all arrays of one length.

    `odometer_m` counts up where the train moves, `along_m`, `across_m` lie on the direction of the positions around,
    `up_m` is NaN where there is no height. `moving` by both; `unbroken`: neither recorder paused or leapt.
    `period_s`: usual length of a step.
    """

    t_s: Floats
    period_s: float
    odometer_m: Floats
    along_m: Floats
    across_m: Floats
    up_m: Floats
    moving: Bools
    unbroken: Bools


def common_steps(odometer: pl.DataFrame, fixes: pl.DataFrame, config: Configuration) -> Steps | None:
    """Steps of both recorders over the same times, along the direction of travel; None without times in common."""
    if not odometer.height or not fixes.height:
        return None
    epoch_ns = int(times_ns(fixes)[0])
    counted = _distances_of_sensor(odometer, epoch_ns)
    placed = _positions_in_metres(fixes, epoch_ns)
    if counted is None or placed is None:
        return None
    counter_s, counter_m = counted
    places_s, places_m = placed
    periods_s = median(np.diff(counter_s)), median(np.diff(places_s))
    slower_s = counter_s if periods_s[0] > 1.2 * periods_s[1] else places_s
    t_s = slower_s[(slower_s >= max(counter_s[0], places_s[0])) & (slower_s <= min(counter_s[-1], places_s[-1]))]
    if t_s.size < _FEWEST:
        return None
    period_s = max(periods_s)
    odometer_m = np.diff(np.interp(t_s, counter_s, counter_m))
    moved_m = np.diff(np.column_stack([np.interp(t_s, places_s, axis) for axis in places_m]), axis=0)
    dt_s = np.diff(t_s)
    unbroken = (dt_s <= _PAUSE_PERIODS * period_s) & (np.abs(odometer_m) <= config.align.fastest_mps * dt_s + 1.0)
    for recorded_s, own_s in ((counter_s, periods_s[0]), (places_s, periods_s[1])):
        unbroken &= _without_pause(t_s, recorded_s, _PAUSE_PERIODS * own_s)
    reach = max(1, round(_AROUND_S / period_s))
    chord_m = np.column_stack([sum_around(axis, reach) for axis in moved_m[:, :2].T])
    driven_m = sum_around(odometer_m, reach)
    length_m = np.hypot(*chord_m.T)
    least_m = _MOVING_MPS * sum_around(dt_s, reach)
    ahead = chord_m / np.maximum(length_m, 1e-9)[:, None]
    return Steps(
        t_s=t_s[:-1],
        period_s=period_s,
        odometer_m=odometer_m * np.where(driven_m < 0.0, -1.0, 1.0),
        along_m=moved_m[:, 0] * ahead[:, 0] + moved_m[:, 1] * ahead[:, 1],
        across_m=moved_m[:, 1] * ahead[:, 0] - moved_m[:, 0] * ahead[:, 1],
        up_m=moved_m[:, 2],
        moving=(length_m > least_m) & (np.abs(driven_m) > least_m),
        unbroken=unbroken,
    )


def _distances_of_sensor(odometer: pl.DataFrame, epoch_ns: int) -> tuple[Floats, Floats] | None:
    """Times [s] and distances [m] of a sensor: counted, or its speeds summed up where it hardly counts."""
    distance_m = floats(odometer, "distance_m")
    speed_mps = floats(odometer, "speed_mps")
    t_s = _seconds_since(odometer, epoch_ns)
    known = np.isfinite(distance_m)
    if 2 * np.count_nonzero(known) >= np.count_nonzero(np.isfinite(speed_mps)):
        return (t_s[known], distance_m[known]) if np.count_nonzero(known) >= _FEWEST else None
    known = np.isfinite(speed_mps)
    t_s, speed_mps = t_s[known], speed_mps[known]
    if t_s.size < _FEWEST:
        return None
    return t_s, np.concatenate([[0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(t_s))])


def _positions_in_metres(fixes: pl.DataFrame, epoch_ns: int) -> tuple[Floats, tuple[Floats, Floats, Floats]] | None:
    """Times [s] of valid positions, and east, north, up [m] from the first of them, for differences of near ones."""
    degrees = np.stack([floats(fixes, "latitude_deg"), floats(fixes, "longitude_deg")])
    rows = np.flatnonzero(np.isfinite(degrees).all(axis=0) & truths(fixes["fix"] != Fix.NONE.value))
    if rows.size < _FEWEST:
        return None
    latitude, longitude = np.radians(degrees[:, rows])
    meridian_m, normal_m = curvature_radii_m(latitude)
    north_m = _running_sum(np.diff(latitude) * meridian_m[1:])
    east_m = _running_sum(np.diff(longitude) * (normal_m * np.cos(latitude))[1:])
    return _seconds_since(fixes, epoch_ns)[rows], (east_m, north_m, floats(fixes, "height_m")[rows])


def _seconds_since(frame: pl.DataFrame, epoch_ns: int) -> Floats:
    """Times of a stream since the instant `epoch_ns` [s]."""
    return np.asarray((times_ns(frame) - epoch_ns) * 1e-9, dtype=np.float64)


def _without_pause(t_s: Floats, recorded_s: Floats, longest_s: float) -> Bools:
    """At each step of `t_s`, whether the recorder has a row at least each `longest_s` around its begin and end."""
    pauses = np.flatnonzero(np.diff(recorded_s) > longest_s)
    broken = np.zeros(t_s.size + 1, dtype=np.int64)
    first = np.searchsorted(t_s, recorded_s[pauses], side="right") - 1
    last = np.searchsorted(t_s, recorded_s[pauses + 1], side="left")
    # +1 where a pause begins and -1 where it ends: the running sum counts the pauses over each step.
    np.add.at(broken, np.clip(first, 0, t_s.size), 1)
    np.add.at(broken, np.clip(last, 0, t_s.size), -1)
    free: Bools = np.cumsum(broken)[: t_s.size - 1] == 0
    return free


def sum_around(steps: Floats, reach: int) -> Floats:
    """Sum of each step with the `reach` steps before and after it, fewer at the ends, shape (n,)."""
    sums = _running_sum(steps)
    at = np.arange(steps.size)
    total: Floats = sums[np.minimum(at + reach + 1, steps.size)] - sums[np.maximum(at - reach, 0)]
    return total


def _running_sum(steps: Floats) -> Floats:
    """Running sum of steps from 0 on, shape (n,) to (n + 1,)."""
    return np.concatenate([[0.0], np.cumsum(steps)])


# Steps of this length are compared; what lies so near to a movement is no stand [s].
_STEP_S = 1.0
_EDGE_S = 5.0


def correlated_at_stands(steps: Steps, config: EvidenceConfig) -> bool:
    """Whether steps of all stands together have r > `follows_correlation` and r sqrt(t / 2 s) > `follows_sigmas`.

    A step of a differenced position shares its middle with the next one: two seconds are one independent step.
    """
    pairs = [_movement_by_second(steps, first, last) for first, last in spans_of(_inside_stands(steps, config))]
    if not pairs:
        return False
    odometer_m, along_m, length_m = np.concatenate(pairs, axis=1)
    time_s = odometer_m.size * _STEP_S
    if time_s < config.follows_stand_s:
        return False
    return any(_correlates(odometer_m, other_m, time_s, config) for other_m in (along_m, length_m))


def _inside_stands(steps: Steps, config: EvidenceConfig) -> Bools:
    """At which steps the train stands, away from the stand's ends.

    By the positions: an odometer of their steps without sign never stands.
    """
    reach = max(1, round(_EDGE_S / steps.period_s))
    least_m = config.follows_stand_mps * 2.0 * _EDGE_S
    still = steps.unbroken & ~steps.moving
    for moved_m in (steps.along_m, steps.across_m):
        still &= np.abs(sum_around(moved_m, reach)) <= least_m
    inside: Bools = sum_around(still.astype(np.float64), reach) > 2 * reach + 0.5
    return inside


def _movement_by_second(steps: Steps, first: int, last: int) -> Floats:
    """Odometer, along, and length of the position's step, over each second of a stand, shape (3, seconds) [m]."""
    stride = max(1, round(_STEP_S / steps.period_s))
    count = (last + 1 - first) // stride
    part = slice(first, first + count * stride)
    odometer_m, along_m, across_m = (
        axis[part].reshape(count, stride).sum(axis=1) for axis in (steps.odometer_m, steps.along_m, steps.across_m)
    )
    return np.stack([odometer_m, along_m, np.hypot(along_m, across_m)])


def _correlates(odometer_m: Floats, other_m: Floats, time_s: float, config: EvidenceConfig) -> bool:
    """Whether two series of steps [m] over `time_s` of stands correlate beyond both limits.

    Steps beyond four usual ones count as four: a train that creeps moves both, and its wheel is no copy.
    """
    first, second = (_clip_outliers(steps_m) for steps_m in (odometer_m, other_m))
    if not (first.any() and second.any()):
        return False
    r = float(first @ second) / float(np.sqrt((first @ first) * (second @ second)))
    # Lengths have no sign, and a counter may fall.
    return abs(r) > config.follows_correlation and abs(r) * np.sqrt(0.5 * time_s) > config.follows_sigmas


def _clip_outliers(steps_m: Floats) -> Floats:
    """The steps less their median, clipped to four deviations (by the median), about their mean [m].

    All zero where most are alike.
    """
    apart_m = steps_m - median(steps_m)
    sigma_m = median(np.abs(apart_m)) / 0.674490
    clipped = np.clip(apart_m, -4.0 * sigma_m, 4.0 * sigma_m)
    return np.asarray(clipped - clipped.mean())


# Steps on either side that predict one: of the series itself, and of the positions.
_OWN = 4
_OTHERS = 32
# Absolute values of a standard normal variable lie below these in such a part of all cases. The lowest is ours: without
# it RTK positions on winding tracks, whose steps across are curves, not noise, accuse 2 of 500 odometers at 1 Hz.
_QUANTILES = ((0.2, 0.253347), (0.5, 0.674490), (0.9, 1.644854))
# Heights of GNSS are noisier than what lies across by about so much (DIAG Table 1: 1.5 in sigma).
_HEIGHT_OVER_CROSS = 1.5
# What is predicted to a tenth of a millimetre is predicted by rounding [m].
_LEAST_M = 1e-4


@frozen
class Follows:
    """`ratio`: V, None where too few steps could be looked at; `at_stands`: odometer and positions err as one there."""

    ratio: float | None = None
    at_stands: bool = False

    def found(self, config: EvidenceConfig) -> bool:
        """Whether the odometer is made of the positions."""
        return self.at_stands or (self.ratio is not None and self.ratio < config.follows_limit)


NOT_TESTED = Follows()


def follows_positions(odometer: pl.DataFrame, fixes: pl.DataFrame, config: Configuration) -> Follows:
    """Whether an odometer is made of these positions.

    At most `follows_steps_most` steps spread over the run are looked at, so that an hour at 10 Hz takes milliseconds.

    Args:
        odometer: the stream of one sensor, cleaned.
        fixes: the stream `gnss` of one solution, cleaned.
        config: the configuration; used are `evidence.follows_*` and `align.fastest_mps`.

    Returns:
        The ratio V and what was found at stands; `NOT_TESTED` where the two have hardly a time in common.

    Source:
        DOMAIN section 5.0.
    """
    steps = common_steps(odometer, fixes, config)
    if steps is None:
        return NOT_TESTED
    return Follows(_unexplained_ratio(steps, config.evidence), correlated_at_stands(steps, config.evidence))


def _unexplained_ratio(steps: Steps, config: EvidenceConfig) -> float | None:
    """V: what the positions leave unexplained of an odometer's step, over the least that a series leaves alone."""
    rows = _thin_evenly(_rows_in_motion(steps), config.follows_steps_most)
    if rows.size < config.follows_steps_least:
        return None
    own = _neighbours(steps.odometer_m, rows, _OWN)
    both = np.column_stack([own, _steps_around(steps.along_m, rows, _OTHERS)])
    left_m = _unexplained(steps.odometer_m[rows], both)
    alone_m = [_unexplained(steps.odometer_m[rows], own)]
    alone_m.append(_unexplained(steps.across_m[rows], _neighbours(steps.across_m, rows, _OWN)))
    if np.isfinite(steps.up_m[rows]).mean() > 0.5:
        up_m = np.nan_to_num(steps.up_m)
        if np.ptp(up_m[rows]) > _LEAST_M:
            alone_m.append(_unexplained(up_m[rows], _neighbours(up_m, rows, _OWN)) / _HEIGHT_OVER_CROSS)
    least_alone_m = np.min([_sigmas_by_quantile_m(residuals_m) for residuals_m in alone_m], axis=0)
    return float(np.max(np.maximum(_sigmas_by_quantile_m(left_m), _LEAST_M) / np.maximum(least_alone_m, 1e-9)))


def _rows_in_motion(steps: Steps) -> Ints:
    """Numbers of the steps around which, as far as predictors reach, the train moved and no recorder had a break."""
    good = steps.moving & steps.unbroken
    count = np.concatenate([[0], np.cumsum(good)])
    rows = np.arange(_OTHERS, good.size - _OTHERS)
    whole = count[rows + _OTHERS + 1] - count[rows - _OTHERS] == 2 * _OTHERS + 1
    return np.asarray(rows[whole])


def _thin_evenly(rows: Ints, most: int) -> Ints:
    """At most `most` of the rows, evenly spread."""
    return rows if rows.size <= most else rows[np.linspace(0, rows.size - 1, most).astype(np.int64)]


def _steps_around(steps_m: Floats, rows: Ints, reach: int) -> Floats:
    """The steps from `reach` before to `reach` after each row, shape (rows, 2 reach + 1)."""
    return np.asarray(steps_m[rows[:, None] + np.arange(-reach, reach + 1)])


def _neighbours(steps_m: Floats, rows: Ints, reach: int) -> Floats:
    """The steps from `reach` before to `reach` after each row without that of the row, shape (rows, 2 reach)."""
    return np.delete(_steps_around(steps_m, rows, reach), reach, axis=1)


def _unexplained(wanted_m: Floats, by_m: Floats) -> Floats:
    """Absolute residuals [m] of `wanted_m` (rows,) predicted from `by_m` (rows, predictors) by least squares.

    Scaled by sqrt(n / (n - k - 1)) for what fitting k numbers to n rows takes off.
    """
    columns = by_m - by_m.mean(axis=0)
    wanted = wanted_m - wanted_m.mean()
    count, fitted = columns.shape
    # Ridge of rounding: steps of one speed are all alike.
    normal = columns.T @ columns + count * _LEAST_M**2 * np.eye(fitted)
    weights = np.linalg.solve(normal, columns.T @ wanted)
    return np.asarray(np.abs(wanted - columns @ weights) * np.sqrt(count / (count - fitted - 1.0)))


def _sigmas_by_quantile_m(residuals_m: Floats) -> Floats:
    """Sigma [m] of a normal variable whose absolute value has these quantiles, by each of `_QUANTILES`."""
    parts, of_normal = zip(*_QUANTILES, strict=True)
    return np.asarray(np.quantile(residuals_m, parts) / np.array(of_normal))
