"""The distance over slip as another odometer of the train counted it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.stages.odometry.bound import LEAST_DOUBT_M
from pipeline.stages.odometry.odometry import Odometry
from schemas.arrays import Floats, Ints
from schemas.config import AlignConfig


def counted_over_slip(
    odometry: Odometry, others: Sequence[Odometry], orientation_m: float, config: AlignConfig
) -> Odometry:
    """The distance over each step of slip by the first other odometer that counted it.

    Slip stays reported, but only `other_way_share` of the step is in doubt. Others may count with the other sign, as
    the first `orientation_m` show.

    Args:
        odometry: the odometer of the LDS.
        others: the other independent odometers, in order of preference.
        orientation_m: distance over which the sign of another one is found [m].
        config: the section `align` of the configuration.

    Returns:
        The odometer, with the distances over slip replaced.
    """
    if not others or not odometry.slip.any():
        return odometry
    t_ns: Ints = odometry.epoch_ns + np.round(odometry.t_s * 1e9).astype(np.int64)
    step_m, doubt_m = np.diff(odometry.distance_m), np.diff(odometry.doubt_m)
    own_m = step_m.copy()
    open_steps = odometry.slip[1:] | odometry.slip[:-1]
    for odometer in others:
        counted_m = np.diff(odometer.distance_at(t_ns))
        counts = (
            open_steps & np.isfinite(counted_m) & (np.diff(odometer.cumulative_doubt_m(odometer.seconds(t_ns))) == 0.0)
        )
        sense = relative_sense(own_m, counted_m, orientation_m)
        step_m[counts] = sense * counted_m[counts] / (odometry.scale or 1.0)
        doubt_m[counts] = np.maximum(config.other_way_share * np.abs(step_m[counts]), LEAST_DOUBT_M)
        open_steps &= ~counts
    return replace(odometry, distance_m=odometry.distance_m[0] + _sums(step_m), doubt_m=_sums(doubt_m))


def _sums(steps: Floats) -> Floats:
    """Running sum of steps from 0 on, shape (n,) to (n + 1,)."""
    return np.concatenate([[0.0], np.cumsum(steps)])


def polarity(odometry: Odometry, t_ns: Ints, path_m: Floats, distance_m: float) -> int:
    """+1 or -1: the odometer's sign against growing path, from the first `distance_m` of net movement, or the largest.

    Starts a metre apart have a vote each, so that a leap of the position does not turn the odometer round.
    """
    recorded_m = odometry.distance_at(t_ns)
    usable = np.flatnonzero(np.isfinite(path_m) & np.isfinite(recorded_m))
    if usable.size < 2:
        return 1
    odometer = recorded_m[usable]
    path = path_m[usable]
    travelled_m = np.maximum.accumulate(np.abs(odometer - odometer[0]))
    window = int(np.searchsorted(travelled_m, 4.0 * distance_m)) + 1
    # By metres, not by rows: a long stand before the departure has one vote, not thousands.
    starts = np.unique(np.searchsorted(travelled_m, np.arange(0.0, 2.0 * distance_m)))
    starts = starts[starts < min(window, travelled_m.size)]
    votes = [_side(odometer[start:window], path[start:window], distance_m) for start in starts]
    return -1 if sum(votes) < 0 else 1


def shared_movement_m(counted_m: Floats, other_m: Floats) -> Floats:
    """What two recorders both moved over the same times [m], negative where in opposite senses.

    The noise of one that stands has no direction to give to a movement that the other counts.
    """
    shared: Floats = np.sign(counted_m * other_m) * np.minimum(np.abs(counted_m), np.abs(other_m))
    return np.nan_to_num(shared)


def relative_sense(counted_m: Floats, other_m: Floats, distance_m: float) -> int:
    """+1 or -1: the sign of one counter against the other, by the first `distance_m` that both moved, or by all."""
    moved_m = np.cumsum(shared_movement_m(counted_m, other_m))
    if not moved_m.size:
        return 1
    first = np.flatnonzero(np.abs(moved_m) >= distance_m)
    return -1 if moved_m[first[0] if first.size else -1] < 0.0 else 1


def grows_with(position_m: Floats, t_ns: Ints, odometry: Odometry | None, distance_m: float) -> bool:
    """Whether these positions grew over the first `distance_m` of net movement: in which direction the path is to grow.

    By the odometer where there is one, as votes: its sign against them (`polarity`) and its own movement. A question
    about the path, not about the counter; without an odometer the positions alone answer it.
    """
    known = np.isfinite(position_m)
    if not known.any():
        return True
    position = position_m[known]
    at_ns = t_ns[known]
    if odometry is not None:
        recorded = odometry.distance_at(at_ns)
        moved = recorded[np.isfinite(recorded)] - recorded[np.isfinite(recorded)][:1]
        covered = np.flatnonzero(np.abs(moved) >= distance_m)
        if covered.size:
            return bool(polarity(odometry, at_ns, position, distance_m) * moved[covered[0]] > 0)
    away = position - position[0]
    far = np.flatnonzero(np.abs(away) >= distance_m)
    return bool(away[far[0]] > 0) if len(far) else bool(away[-1] >= 0)


def _side(odometer: Floats, path: Floats, distance_m: float) -> int:
    """Whether path and odometer grow in the same direction (1), in opposite ones (-1) or nowhere (0)."""
    moved = odometer - odometer[0]
    far = np.flatnonzero(np.abs(moved) >= distance_m)
    end = int(far[0]) if far.size else int(np.argmax(np.abs(moved)))
    return int(np.sign(moved[end] * (path[end] - path[0])))
