"""Direction of the counter: its speed against its distance, and what it does where the train reverses."""

from __future__ import annotations

import numpy as np

from pipeline.plausibility.check import Check, State, correction, fits, not_checked
from pipeline.plausibility.course import Course, Places
from pipeline.plausibility.robust import LEAST, MOVES_MPS
from schemas.arrays import Floats, runs_of

_SIGNS = "sign of the odometer's speed against its distance"
_TURNS = "direction of the counter where the train reverses"
# The way before and after a stand that tells the heading, and how much of it the counter has to gain as well.
_HEADING_S, _SAME_WAY = 20.0, 0.3
_OPPOSITE = 0.7


def sign_check(distance: Course | None, speed: Course | None) -> list[Check]:
    """Speed and distance of one odometer; none where it has not both."""
    if distance is None or speed is None:
        return []
    begin_s, end_s = max(distance.t_s[0], speed.t_s[0]), min(distance.t_s[-1], speed.t_s[-1])
    starts = np.linspace(begin_s, max(end_s - 10.0, begin_s), 300)
    gained = np.array([course.gained(starts, starts + 10.0) for course in (distance, speed)])
    # By the median of what moves: a counter that is reset seems to run far, once.
    moves = np.all(np.nan_to_num(gained) != 0.0, axis=0)
    least = 0.2 * np.median(np.abs(gained[:, moves]), axis=1, keepdims=True) if moves.any() else 0.0
    moves &= np.all(np.abs(gained) > least, axis=0)
    if moves.sum() < LEAST:
        return [not_checked(_SIGNS, "hardly any movement with both")]
    falls, back = gained[:, moves] < 0
    against = float(np.mean(falls != back))
    if against > 0.9:
        # A train that runs backwards all the way is rarer than a counter of the wrong sign.
        column, name = ("distance_m", "distance") if falls.mean() > 0.5 else ("speed_mps", "speed")
        found = f"the distance {'falls' if falls.mean() > 0.5 else 'grows'} at the opposite speed"
        return [
            Check(
                _SIGNS, State.IMPOSSIBLE, found, f"the {name} counts backwards", correction("odometer", {column: -1.0})
            )
        ]
    if against > 0.1 and not back.any() and not falls.all():
        return [Check(_SIGNS, State.MISFIT, "the speed has no sign", "it stays positive where the distance falls")]
    return [fits(_SIGNS, "the same")]


def turn_check(gnss: Places, counter: Course, factor: float, lag_s: float) -> Check:
    """Whether the counter turns where the train does; stands beside a jump of the position tell nothing."""
    grid = np.arange(gnss.t_s[0], gnss.t_s[-1], 1.0)
    firsts, lasts = runs_of(gnss.speed(grid) < MOVES_MPS)
    ends = grid[firsts], grid[lasts]
    before, after = _moved(gnss, ends[0] - _HEADING_S, ends[0]), _moved(gnss, ends[1], ends[1] + _HEADING_S)
    sizes = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ij,ij->i", before, after) / (sizes[0] * sizes[1])
        gained = (
            counter.gained(ends[0] - _HEADING_S + lag_s, ends[0] + lag_s) / factor,
            counter.gained(ends[1] + lag_s, ends[1] + _HEADING_S + lag_s) / factor,
        )
        product = gained[0] * gained[1]
        told = np.isfinite(cosine) & (np.minimum(*sizes) > 2.0 * MOVES_MPS * _HEADING_S)
        for size, way in zip(sizes, gained, strict=True):
            told &= np.abs(np.abs(way) - size) < _SAME_WAY * size
        reversal, onward = told & (cosine < -_OPPOSITE), told & (cosine > _OPPOSITE)
    wrong = int((reversal & (product > 0)).sum()), int((onward & (product < 0)).sum())
    if wrong[0] and wrong[0] == reversal.sum():
        found = f"the train reverses {wrong[0]} times, the counter never does"
        advice = "Let the recorder write the distance falling, and the speed negative, while the train reverses."
        return Check(_TURNS, State.MISFIT, found, "a counter without sign", advice=advice)
    if wrong[1] and wrong[1] > 0.5 * onward.sum():
        found = f"the counter turns {wrong[1]} times where the train goes on"
        return Check(_TURNS, State.MISFIT, found, "the sign follows something else than the movement")
    if not (reversal | onward).any():
        return not_checked(_TURNS, "the train does not stop on the way")
    return fits(_TURNS, f"{reversal.sum()} reversals, {onward.sum()} stops")


def _moved(gnss: Places, begin_s: Floats, end_s: Floats) -> Floats:
    known = gnss.known(begin_s) & gnss.known(end_s)
    return np.where(known[:, None], gnss.at(end_s) - gnss.at(begin_s), np.nan)
