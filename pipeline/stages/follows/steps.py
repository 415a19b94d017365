"""Steps of an odometer and of positions from one common stamp to the next.

Of the rows as they were written, not of `Odometry`: what that bridges, interpolates or takes from another sensor is
predicted by its neighbours, and would be taken for a copy of the positions or hide one. So a break is any missing row
here, of either recorder, where `Odometry` asks whether the distance went on; and movement is what gives the positions a
direction, where `Odometry` asks whether the train left its place.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import curvature_radii_m
from schemas.arrays import Bools, Floats, floats, median, times_ns
from schemas.config import Configuration
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
    """None where the two have hardly a time in common."""
    if not odometer.height or not fixes.height:
        return None
    epoch_ns = int(times_ns(fixes)[0])
    counted = _counted(odometer, epoch_ns)
    placed = _placed(fixes, epoch_ns)
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
    chord_m = np.column_stack([around_sum(axis, reach) for axis in moved_m[:, :2].T])
    way_m = around_sum(odometer_m, reach)
    length_m = np.hypot(*chord_m.T)
    least_m = _MOVING_MPS * around_sum(dt_s, reach)
    ahead = chord_m / np.maximum(length_m, 1e-9)[:, None]
    return Steps(
        t_s=t_s[:-1],
        period_s=period_s,
        odometer_m=odometer_m * np.where(way_m < 0.0, -1.0, 1.0),
        along_m=moved_m[:, 0] * ahead[:, 0] + moved_m[:, 1] * ahead[:, 1],
        across_m=moved_m[:, 1] * ahead[:, 0] - moved_m[:, 0] * ahead[:, 1],
        up_m=moved_m[:, 2],
        moving=(length_m > least_m) & (np.abs(way_m) > least_m),
        unbroken=unbroken,
    )


def _counted(odometer: pl.DataFrame, epoch_ns: int) -> tuple[Floats, Floats] | None:
    """Times [s] and distances [m] of a sensor: counted, or its speeds summed up where it hardly counts."""
    distance_m = floats(odometer, "distance_m")
    speed_mps = floats(odometer, "speed_mps")
    t_s = _since_s(odometer, epoch_ns)
    known = np.isfinite(distance_m)
    if 2 * np.count_nonzero(known) >= np.count_nonzero(np.isfinite(speed_mps)):
        return (t_s[known], distance_m[known]) if np.count_nonzero(known) >= _FEWEST else None
    known = np.isfinite(speed_mps)
    t_s, speed_mps = t_s[known], speed_mps[known]
    if t_s.size < _FEWEST:
        return None
    return t_s, np.concatenate([[0.0], np.cumsum(0.5 * (speed_mps[1:] + speed_mps[:-1]) * np.diff(t_s))])


def _placed(fixes: pl.DataFrame, epoch_ns: int) -> tuple[Floats, tuple[Floats, Floats, Floats]] | None:
    """Times [s] of valid positions, and east, north, up [m] from the first of them, for differences of near ones."""
    valid = fixes["latitude_deg"].is_finite() & fixes["longitude_deg"].is_finite() & (fixes["fix"] != Fix.NONE.value)
    rows = np.flatnonzero(valid.fill_null(False).to_numpy())
    if rows.size < _FEWEST:
        return None
    latitude, longitude = (np.radians(floats(fixes, f"{axis}_deg")[rows]) for axis in ("latitude", "longitude"))
    meridian_m, normal_m = curvature_radii_m(latitude)
    north_m = _sums(np.diff(latitude) * meridian_m[1:])
    east_m = _sums(np.diff(longitude) * (normal_m * np.cos(latitude))[1:])
    return _since_s(fixes, epoch_ns)[rows], (east_m, north_m, floats(fixes, "height_m")[rows])


def _since_s(frame: pl.DataFrame, epoch_ns: int) -> Floats:
    return np.asarray((times_ns(frame) - epoch_ns) * 1e-9, dtype=np.float64)


def _without_pause(t_s: Floats, recorded_s: Floats, longest_s: float) -> Bools:
    """Per step of `t_s`: this recorder has a row at least each `longest_s` around its begin and end."""
    pauses = np.flatnonzero(np.diff(recorded_s) > longest_s)
    broken = np.zeros(t_s.size + 1, dtype=np.int64)
    first = np.searchsorted(t_s, recorded_s[pauses], side="right") - 1
    last = np.searchsorted(t_s, recorded_s[pauses + 1], side="left")
    np.add.at(broken, np.clip(first, 0, t_s.size), 1)
    np.add.at(broken, np.clip(last, 0, t_s.size), -1)
    free: Bools = np.cumsum(broken)[: t_s.size - 1] == 0
    return free


def around_sum(steps: Floats, reach: int) -> Floats:
    """Sum from `reach` steps before to `reach` after, fewer at the ends."""
    sums = _sums(steps)
    at = np.arange(steps.size)
    total: Floats = sums[np.minimum(at + reach + 1, steps.size)] - sums[np.maximum(at - reach, 0)]
    return total


def _sums(steps: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(steps)])
