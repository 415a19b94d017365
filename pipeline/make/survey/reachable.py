"""Which samples of a recorded line a train can have come to."""

from __future__ import annotations

import numpy as np

from pipeline.stages.matching.epochs import Fixes
from schemas.arrays import Bools, Floats, Ints

# No train is faster, and none brakes, speeds up or turns harder: 3 m/s2 is already much.
_FASTEST_MPS = 100.0
_HARDEST_MPS2 = 5.0
# A sample lies off by no more than this and so many of its sigmas: reflections that are not yet a jump.
_MARGIN_M = 10.0
_SIGMAS = 5.0
# A velocity is of samples at least and at most so far apart: over less it is mostly noise, over more it has changed.
_LEAST_S = 1.0
_MOST_S = 5.0
# After so long any sample is believed: the train may have been carried, or the first of them was wrong.
_HOLD_S = 30.0


def reachable_rows(fixes: Fixes) -> Ints:
    """Rows with a position to which the train can have come from the last one believed.

    Causal: a sample is judged by those before it.
    """
    rows = np.flatnonzero(fixes.valid)
    believed = np.ones(len(rows), dtype=bool)
    t_s = fixes.t_s[rows]
    since = np.searchsorted(t_s, t_s - _LEAST_S, side="right") - 1

    def is_reachable(before: Ints, after: Ints) -> Bools:
        """Whether each position `after` can be come to from the one `before`, or is too late to be judged by it."""
        velocity = _velocity_mps(fixes, rows, since[before], before)
        held = t_s[after] - t_s[before] <= _HOLD_S
        return ~held | _within_reach(fixes, rows[before], rows[after], velocity)

    number = np.arange(len(rows))
    doubtful = np.flatnonzero(~is_reachable(number[:-1], number[1:]))
    while len(doubtful):
        # Follow the first doubtful sample until one is believed again; from there the pairs above hold.
        last = int(doubtful[0])
        held = int(np.searchsorted(t_s, t_s[last] + _HOLD_S, side="right"))
        later = number[last + 1 : held + 1]
        back = np.flatnonzero(is_reachable(np.full(len(later), last), later))
        again = int(later[back[0]]) if len(back) else len(rows)
        believed[last + 1 : again] = False
        # Velocities of later samples must not start at one that is not believed.
        near = number[again : int(np.searchsorted(since, again))]
        since[near] = np.minimum(since[near], last)
        pairs = near[near < len(rows) - 1]
        doubt = pairs[~is_reachable(pairs, pairs + 1)]
        doubtful = np.concatenate([doubt, doubtful[doubtful >= again + len(near)]])
    return rows[believed]


def _velocity_mps(fixes: Fixes, rows: Ints, since: Ints, until: Ints) -> Floats:
    """Mean velocity between numbers of `rows`, one vector each, NaN where they are too far apart to say."""
    begin = rows[np.maximum(since, 0)]
    end = rows[until]
    elapsed = np.where(since >= 0, fixes.t_s[end] - fixes.t_s[begin], np.nan)
    elapsed[elapsed > _MOST_S] = np.nan
    return np.asarray((fixes.points.surface[end] - fixes.points.surface[begin]) / elapsed[:, None])


def _within_reach(fixes: Fixes, earlier: Ints, later: Ints, velocity_mps: Floats) -> Bools:
    """Whether the train can have been at both places, by its velocity.

    A place is as suspect behind the one where the train was heading as ahead of it.
    """
    moved = fixes.points.surface[later] - fixes.points.surface[earlier]
    elapsed = fixes.t_s[later] - fixes.t_s[earlier]
    apart = np.linalg.norm(moved, axis=1)
    aside = np.linalg.norm(moved - velocity_mps * elapsed[:, None], axis=1)
    variance = 0.5 * (fixes.cov_ee_m2 + fixes.cov_nn_m2)
    margin = _MARGIN_M + _SIGMAS * (np.sqrt(variance[earlier]) + np.sqrt(variance[later]))
    turned = aside > _HARDEST_MPS2 * elapsed**2 + margin
    return np.asarray((apart <= elapsed * _FASTEST_MPS + margin) & ~turned)
