"""Which way the path position grows: the way the run moved over its first metres (DOMAIN section 2)."""

from __future__ import annotations

import numpy as np

from pipeline.matching.steps import Travelled
from schemas.arrays import Floats, Ints


def grows_with(position_m: Floats, epoch: Ints, way: Travelled, distance_m: float) -> bool:
    """Whether the run's first `distance_m` of net movement went with the given positions (NaN: not known).

    The odometer says between which epochs that distance was covered, the positions which way it went: the
    median over starts within twice the distance, so that a GNSS that jumps back at the start does not turn
    the run round. Without an odometer the positions say both.
    """
    known = np.flatnonzero(np.isfinite(position_m))
    if len(known) == 0:
        return True
    position, rows = position_m[known], epoch[known]
    moved = _moved_by_odometer(position, rows, way, distance_m)
    if moved is not None:
        return moved > 0
    away = position - position[0]
    far = np.flatnonzero(np.abs(away) >= distance_m)
    return bool(away[far[0]] > 0) if len(far) else bool(away[-1] >= 0)


def _moved_by_odometer(position_m: Floats, rows: Ints, way: Travelled, distance_m: float) -> float | None:
    """Median displacement while the odometer covered the distance, none where it did not or is not known."""
    known = np.isfinite(way.distance_m[rows])
    if not known.any():
        return None
    since = way.between(np.full(len(rows), rows[known][0]), rows)
    known = np.isfinite(since)
    position_m, rows, since = position_m[known], rows[known], since[known]
    covered = np.flatnonzero(np.abs(since) >= distance_m)
    if len(covered) == 0:
        return None
    sense = np.sign(since[covered[0]])
    forward = sense * since
    beyond = np.flatnonzero(forward >= 2.0 * distance_m)
    starts = np.arange(beyond[0] if len(beyond) else covered[0])
    later = np.searchsorted(np.maximum.accumulate(forward), forward[starts] + distance_m)
    within = later < len(rows)
    moved = position_m[later[within]] - position_m[starts[within]]
    return (float(np.median(moved)) or None) if len(moved) else None
