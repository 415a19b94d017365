"""Which way the path position grows: the way the run moved over its first metres (DOMAIN section 2)."""

from __future__ import annotations

import numpy as np

from pipeline.odometry import Odometry
from pipeline.odometry.polarity import polarity
from schemas.arrays import Floats, Ints


def grows_with(position_m: Floats, t_ns: Ints, odometry: Odometry | None, distance_m: float) -> bool:
    """Whether the run's first `distance_m` of net movement went with the given positions (NaN: not known).

    The odometer says when that distance was covered and in which sense, and its `polarity` against the positions which
    way they went. Without an odometer the positions say both.
    """
    known = np.isfinite(position_m)
    if not known.any():
        return True
    position, at_ns = position_m[known], t_ns[known]
    if odometry is not None:
        recorded = odometry.distance_at(at_ns)
        moved = recorded[np.isfinite(recorded)] - recorded[np.isfinite(recorded)][:1]
        covered = np.flatnonzero(np.abs(moved) >= distance_m)
        if covered.size:
            return bool(polarity(odometry, at_ns, position, distance_m) * moved[covered[0]] > 0)
    away = position - position[0]
    far = np.flatnonzero(np.abs(away) >= distance_m)
    return bool(away[far[0]] > 0) if len(far) else bool(away[-1] >= 0)
