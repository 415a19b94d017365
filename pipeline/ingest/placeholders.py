"""Positions that are none: 0/0, a default place, what a receiver writes before its first fix."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.track.geodesy import points_of
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, times_ns
from schemas.config import IngestConfig
from schemas.enums import Fix

# Nobody runs trains within this of 0/0, in the Gulf of Guinea [deg].
_ORIGIN_DEG = 0.01
# A receiver that looks for its first fix does so over this share of the run at most, or this long.
_FIRST_SHARE, _FIRST_S = 0.2, 900.0
# No train is faster; the same limit as for odometers.
_FASTEST_MPS = 200.0


def without_placeholders(fixes: pl.DataFrame, config: IngestConfig) -> tuple[pl.DataFrame, int]:
    """One solution in order of time, placeholders without a fix, and how many they are.

    They are 0/0; places repeated to the last digit and farther than `placeholder_far_m` from the rest; and what comes
    before the first fix, where the run goes on so far away that no train can have gone there.
    """
    latitude, longitude = floats(fixes, "latitude_deg"), floats(fixes, "longitude_deg")
    valid = np.isfinite(latitude) & np.isfinite(longitude)
    valid &= (fixes["fix"].cast(pl.String) != Fix.NONE.value).fill_null(False).to_numpy()
    origin = valid & (np.abs(latitude) < _ORIGIN_DEG) & (np.abs(longitude) < _ORIGIN_DEG)
    rows = np.flatnonzero(valid & ~origin)
    found = origin
    if rows.size > 2:
        places = points_of(latitude[rows], longitude[rows]).surface
        centre = np.median(places, axis=0)
        # Cheap first: a run without any far place, which is nearly every run, is done here.
        if np.max(np.abs(places - centre)) > config.placeholder_far_m / np.sqrt(3.0):
            found = origin.copy()
            found[rows] = _far(times_ns(fixes)[rows], places, config.placeholder_far_m)
    count = int(found.sum())
    if not count:
        return fixes, 0
    none = pl.lit(Fix.NONE.value).cast(fixes["fix"].dtype)
    marked = pl.when(pl.Series(found)).then(none).otherwise(pl.col("fix")).alias("fix")
    return fixes.with_columns(marked), count


def _far(t_ns: Ints, places: Floats, far_m: float) -> Bools:
    """Placeholders among valid positions: pieces of the run between leaps that no train can make."""
    step_m, step_s = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(t_ns) / NS_PER_S
    leap = step_m > far_m + _FASTEST_MPS * step_s
    piece = np.concatenate([[0], np.cumsum(leap)])
    found = np.zeros(t_ns.size, dtype=np.bool_)
    if not leap.any():
        return found
    sizes = np.bincount(piece)
    main = int(np.argmax(sizes))
    home = np.median(places[piece == main], axis=0)
    for number in range(sizes.size):
        if number == main:
            continue
        rows = np.flatnonzero(piece == number)
        # Several epochs of exactly one place are a default: a fix never repeats to the last digit far away.
        same = rows.size > 1 and np.ptp(places[rows], axis=0).max() == 0.0
        first = rows[0] == 0 and number < main and _is_brief(t_ns, rows[-1] + 1)
        far = np.linalg.norm(np.median(places[rows], axis=0) - home) > far_m
        found[rows] = far and (same or first)
    return found


def _is_brief(t_ns: Ints, until: int) -> bool:
    """Whether the run up to this row is short enough to be the search for a first fix."""
    spent_s, whole_s = (t_ns[until - 1] - t_ns[0]) / NS_PER_S, (t_ns[-1] - t_ns[0]) / NS_PER_S
    return bool(spent_s <= _FIRST_SHARE * whole_s or (spent_s <= _FIRST_S and spent_s < 0.5 * whole_s))
