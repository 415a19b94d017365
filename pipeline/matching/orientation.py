"""Which way the path position grows: the way the run moved over its first metres (DOMAIN section 2)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.geodesy import Floats, Ints


def grows_with(position_m: Floats, t_ns: Ints, odometer: pl.DataFrame | None, distance_m: float) -> bool:
    """Whether the run's first `distance_m` of net movement went with the given position.

    The odometer says when that distance was covered, and the positions say which way: so a jump of the
    GNSS at the start does not turn the run around. Without an odometer the positions say both.
    """
    known = np.flatnonzero(np.isfinite(position_m))
    if len(known) == 0:
        return True
    known = known[_from_moving(known, t_ns, odometer, distance_m)]
    moved = position_m[known] - position_m[known[0]]
    far = np.flatnonzero(np.abs(moved) >= distance_m)
    return bool(moved[far[0]] > 0) if len(far) else bool(moved[-1] >= 0)


def _from_moving(known: Ints, t_ns: Ints, odometer: pl.DataFrame | None, distance_m: float) -> Ints:
    """Which known epochs to judge: the first, and those after the odometer has covered the distance."""
    everything = np.arange(len(known))
    if odometer is None or odometer["distance_m"].null_count() == odometer.height or odometer.height < 2:
        return everything
    clean = odometer.drop_nulls("distance_m")
    at = np.interp(t_ns[known], clean["t"].to_physical().to_numpy(), clean["distance_m"].to_numpy())
    covered = np.flatnonzero(np.abs(at - at[0]) >= distance_m)
    if len(covered) == 0:
        return everything
    return np.concatenate([[0], everything[covered[0] :]])
