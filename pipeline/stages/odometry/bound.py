"""By how much an odometer's distance may be off, as braking and acceleration prove it (evidence)."""

from __future__ import annotations

import numpy as np

from pipeline.stages.odometry.odd_steps import LOST_M, weighed
from schemas.arrays import Bools, Floats
from schemas.config import AlignConfig
from schemas.frozen import frozen

# Each step of slip is in doubt by so much at least [m]: a locked wheel counts nothing.
LEAST_DOUBT_M = 1e-3


def is_lost(doubt_m: Floats) -> Bools:
    """Differences of a sum of doubt that hold a loss of the distance: nothing of it is left."""
    lost: Bools = np.abs(doubt_m) > 0.5 * LOST_M
    return lost


@frozen
class Bound:
    """Sums over runs of steps whose count may be off, per row at `t_s` [m].

    `begun_m`: of the runs that began before a row; `ended_m`: of those that ended by it. A way that touches a run has
    all of its bound, as its error may have arisen at any place in it.
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
        gone = np.concatenate([[0], np.cumsum(lost)])
        for run in weighed(t_s, distance_m, doubtful | lost, config):
            off_m = max(run.off_m, float(least_m[run.first : run.last].sum()))
            off_m = LOST_M if gone[run.last] > gone[run.first] else off_m
            begun_m[run.first + 1] += off_m
            ended_m[run.last] += off_m
        return cls(t_s, np.cumsum(begun_m), np.cumsum(ended_m))

    def between_m(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Of the ways between instants, in either order; lost outside the recording."""
        first_s, last_s = np.minimum(begin_s, end_s), np.maximum(begin_s, end_s)
        before = np.searchsorted(self.t_s, first_s, side="right") - 1
        after = np.searchsorted(self.t_s, last_s, side="left")
        inside = (before >= 0) & (after < self.t_s.size)
        size = self.t_s.size - 1
        between_m = self.begun_m[np.minimum(after, size)] - self.ended_m[np.maximum(before, 0)]
        # An instant at a row has neither of the steps beside it: no way.
        return np.where(inside, np.where(last_s > first_s, np.maximum(between_m, 0.0), 0.0), LOST_M)
