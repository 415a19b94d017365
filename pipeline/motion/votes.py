"""Whether the train moved while its odometer stood: each source of evidence has a vote, or nothing to say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.motion.position_rate import HOLE_S
from pipeline.motion.witness import Movement, Witness
from schemas.arrays import Floats

# A train does not come from this speed to a stand within a second, nor leave like that: no brake does a fifth of it.
_ABRUPT_MPS, _ABRUPT_S, _NEAR_S = 10.0, 2.0, 15.0
# Drifts of positions that the papers look at end at 5 m/s (DIAG); a train is faster, and for longer.
_TRAIN_MPS, _TRAIN_M = 8.0, 200.0
# From one second to the next but one no train changes its speed by so much, a position that begins to drift does.
_PULLS_MPS = 6.0
# Share of a movement that a witness has to have seen.
_HALF = 0.5
# Slips between two reads are one number up to rounding.
_SAME_DECIMALS = 3


def moved_by_votes(w: Witness, movement: Movement) -> bool | None:
    """Whether the train did: by the first that has an answer."""
    votes = (vote(w, movement) for vote in _VOTES)
    return next((vote for vote in votes if vote is not None), None)


def _by_reference(w: Witness, movement: Movement) -> bool | None:
    """The reference went along, or it stood."""
    return _agrees(w, movement, w.reference_m)


def _by_reads(w: Witness, movement: Movement) -> bool | None:
    """Balises were read in places that the odometer did not reach; beyond the last one they tell nothing.

    What is missing between two reads is known even where the odometer tells not when it was lost.
    """
    slips = w.slip_m[movement.first : movement.last + 2]
    missing_m = -float(np.unique(np.round(slips[np.isfinite(slips)], _SAME_DECIMALS)).sum()) * np.sign(movement.way_m)
    return True if _agrees(w, movement, w.reads_m) or missing_m > _HALF * abs(movement.way_m) else None


def _by_brakes(w: Witness, movement: Movement) -> bool | None:
    """The odometer came to its stand, or left it, as no train can."""
    a, b = movement.stand
    stopped = w.t_s[movement.first] - w.t_s[a] <= _NEAR_S and _speed_mps(w, w.t_s[a] - 1.0 - _ABRUPT_S) > _ABRUPT_MPS
    left = w.t_s[b] - w.t_s[movement.last] <= _NEAR_S and _speed_mps(w, w.t_s[b + 1] + 1.0) > _ABRUPT_MPS
    return True if stopped or left else None


def _speed_mps(w: Witness, begin_s: float) -> float:
    """Mean speed of the odometer over two seconds [m/s], 0 where it is not known throughout."""
    end_s = begin_s + _ABRUPT_S
    if begin_s < w.t_s[0] or end_s > w.t_s[-1]:
        return 0.0
    first, last = int(np.searchsorted(w.t_s, begin_s, side="right")) - 1, int(np.searchsorted(w.t_s, end_s))
    rows, span_s = slice(first, last + 1), w.t_s[last] - w.t_s[first]
    if not np.isfinite(w.odometer_m[rows]).all() or np.ptp(w.stretch[rows]) > 0 or span_s > 2.0 * _ABRUPT_S:
        return 0.0
    return float(abs(w.odometer_m[last] - w.odometer_m[first]) / span_s)


def _by_doppler(w: Witness, movement: Movement) -> bool | None:
    """The GNSS velocity went along, or it stood."""
    rows = slice(movement.first, movement.last + 2)
    velocity, dt_s = w.velocity_mps[rows], np.diff(w.t_s[rows])
    steps_m = 0.5 * (velocity[1:] + velocity[:-1]) * dt_s
    known = np.isfinite(steps_m) & (dt_s <= HOLE_S)
    share = float(dt_s[known].sum() / dt_s.sum())
    driven_m = float(steps_m[known].sum()) * np.sign(movement.way_m)
    return bool(driven_m > _HALF * abs(movement.way_m) * share) if share > _HALF else None


def _agrees(w: Witness, movement: Movement, place_m: Floats) -> bool | None:
    """Whether places of another source moved like the positions; None where they hardly reach."""
    rows = np.arange(movement.first, movement.last + 2)
    rows = rows[np.isfinite(place_m[rows])]
    length_s = w.t_s[movement.last + 1] - w.t_s[movement.first]
    if rows.size < 2 or w.t_s[rows[-1]] - w.t_s[rows[0]] < _HALF * length_s:
        return None
    way_m = (place_m[rows[-1]] - place_m[rows[0]]) * np.sign(movement.way_m)
    return bool(way_m > _HALF * abs(movement.way_m))


def _by_return(w: Witness, movement: Movement) -> bool | None:
    """The position leaped back to where the odometer has the train: it was wrong."""
    rows = np.flatnonzero(np.isfinite(w.path_m) & np.isfinite(w.odometer_m))
    rows = rows[(rows >= movement.last) & (w.stretch[rows] == w.stretch[movement.last])]
    if rows.size < 2:
        return None
    short = np.diff(w.t_s[rows]) <= max(1.0, 1.5 * float(np.median(np.diff(w.t_s))))
    back_m = -np.sign(movement.way_m) * np.diff(w.path_m[rows])
    past_m = back_m + np.sign(movement.way_m) * np.diff(w.odometer_m[rows])
    least_m, most_m = _HALF * abs(movement.way_m), (1.0 + _HALF) * abs(movement.way_m)
    returns = short & (back_m > least_m) & (past_m > least_m) & (past_m < most_m)
    return False if returns.any() else None


def _by_speed(w: Witness, movement: Movement) -> bool | None:
    """The positions moved on like a train, seen all along: no drift is so fast for so long and begins so slowly."""
    speed_mps = abs(movement.way_m) / (w.t_s[movement.last + 1] - w.t_s[movement.first])
    steady = speed_mps > _TRAIN_MPS and abs(movement.way_m) > _TRAIN_M and movement.seen > _HALF
    begin, end = max(movement.cells[0] - 2, 0), movement.cells[1] + 3
    rate = w.positions.rate_mps[begin:end]
    jerks = np.abs(rate[2:] - rate[:-2]) > _PULLS_MPS
    return True if steady and not jerks.any() else None


_VOTES: tuple[Callable[[Witness, Movement], bool | None], ...] = (
    _by_reference,
    _by_reads,
    _by_brakes,
    _by_doppler,
    _by_return,
    _by_speed,
)
