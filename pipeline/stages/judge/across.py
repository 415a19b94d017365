"""Errors across the track and of height, by the reference."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import points_of
from schemas.arrays import NS_PER_S, Floats, Ints, floats, times_ns


def errors_across(
    fixes: pl.DataFrame,
    heading_deg: Floats,
    at_ns: Ints,
    reference: pl.DataFrame | None,
    gap_s: float,
    along_limit_m: float,
) -> tuple[Floats, Floats]:
    """Position minus reference, left of growing path and upwards [m]; NaN where the reference is silent.

    `fixes`: those of the solution; `at_ns`: the instants that they are judged at. NaN too where the position is more
    than `along_limit_m` ahead or behind: a curve goes aside by metres over such a way, and a slope up.
    """
    nothing = np.full(at_ns.size, np.nan)
    if reference is None or reference.height < 2:
        return nothing, nothing
    stamps = times_ns(reference)
    x, at = (stamps - stamps[0]) / NS_PER_S, (at_ns - stamps[0]) / NS_PER_S
    after = np.searchsorted(x, at).clip(1, x.size - 1)
    silent = (at < x[0]) | (at > x[-1]) | (x[after] - x[after - 1] > gap_s)
    latitude, longitude, height = (
        np.where(silent, np.nan, np.interp(at, x, floats(reference, name)))
        for name in ("latitude_deg", "longitude_deg", "height_m")
    )
    known = np.flatnonzero(~silent & np.isfinite(floats(fixes, "latitude_deg")))
    own = points_of(floats(fixes, "latitude_deg")[known], floats(fixes, "longitude_deg")[known])
    there = points_of(latitude[known], longitude[known])
    away = own.surface - there.surface
    east, north = np.einsum("ij,ij->i", away, own.east), np.einsum("ij,ij->i", away, own.north)
    heading = np.radians(heading_deg[known])
    comparable = np.abs(east * np.sin(heading) + north * np.cos(heading)) <= along_limit_m
    across, up = nothing.copy(), nothing.copy()
    across[known] = np.where(comparable, north * np.sin(heading) - east * np.cos(heading), np.nan)
    up[known] = np.where(comparable, (floats(fixes, "height_m") - height)[known], np.nan)
    return across, up
