"""Positions that are none: 0/0, a default place, what a receiver writes before its first fix."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import points_of
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, floats, times_ns
from schemas.config import IngestConfig
from schemas.enums import Fix


def without_placeholders(fixes: pl.DataFrame, config: IngestConfig, fastest_mps: float) -> tuple[pl.DataFrame, int]:
    """One solution in order of time, placeholders without a fix, and how many they are.

    0/0; places repeated to the last digit and farther than `placeholder_far_m` from the rest; and what comes before the
    first fix, where the run goes on so far away that no train can have gone there.
    """
    latitude = floats(fixes, "latitude_deg")
    longitude = floats(fixes, "longitude_deg")
    valid = np.isfinite(latitude) & np.isfinite(longitude)
    valid &= (fixes["fix"].cast(pl.String) != Fix.NONE.value).fill_null(False).to_numpy()
    origin = valid & (np.maximum(np.abs(latitude), np.abs(longitude)) < config.placeholder_origin_deg)
    rows = np.flatnonzero(valid & ~origin)
    placeholder = origin
    if rows.size > 2:
        places = points_of(latitude[rows], longitude[rows]).surface
        placeholder = origin.copy()
        placeholder[rows] = _far(times_ns(fixes)[rows], places, config, fastest_mps)
    count = int(placeholder.sum())
    if not count:
        return fixes, 0
    none = pl.lit(Fix.NONE.value).cast(fixes["fix"].dtype)
    marked = pl.when(pl.Series(placeholder)).then(none).otherwise(pl.col("fix")).alias("fix")
    return fixes.with_columns(marked), count


def _far(t_ns: Ints, places: Floats, config: IngestConfig, fastest_mps: float) -> Bools:
    """Placeholders among valid positions: far pieces of the run, between leaps that no train can make.

    A far piece counts if it is one place repeated exactly, or the brief begin of the run (search for a first fix).
    """
    step_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    step_s = np.diff(t_ns) / NS_PER_S
    leap = step_m > config.placeholder_far_m + fastest_mps * step_s
    piece = np.concatenate([[0], np.cumsum(leap)])
    placeholder = np.zeros(t_ns.size, dtype=np.bool_)
    if not leap.any():
        return placeholder
    sizes = np.bincount(piece)
    main = int(np.argmax(sizes))
    home = np.median(places[piece == main], axis=0)
    for number in range(sizes.size):
        if number == main:
            continue
        rows = np.flatnonzero(piece == number)
        # Several epochs of exactly one place are a default: a fix never repeats to the last digit far away.
        same = rows.size > 1 and np.ptp(places[rows], axis=0).max() == 0.0
        first = rows[0] == 0 and number < main and _is_brief(t_ns, rows[-1] + 1, config)
        far = np.linalg.norm(np.median(places[rows], axis=0) - home) > config.placeholder_far_m
        placeholder[rows] = far and (same or first)
    return placeholder


def _is_brief(t_ns: Ints, until: int, config: IngestConfig) -> bool:
    spent_s = (t_ns[until - 1] - t_ns[0]) / NS_PER_S
    whole_s = (t_ns[-1] - t_ns[0]) / NS_PER_S
    return bool(
        spent_s <= config.first_fix_share * whole_s or (spent_s <= config.first_fix_s and spent_s < 0.5 * whole_s)
    )
