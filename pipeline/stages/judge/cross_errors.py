"""Errors across the track and of height, by the reference."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.judge.case import Case
from pipeline.stages.track.geodesy import points_of
from schemas.arrays import NS_PER_S, Floats, floats, times_ns


def cross_errors(case: Case, heading_deg: Floats) -> list[pl.Series]:
    """`error_cross_m`, `error_up_m`: position minus reference, left of growing path and upwards.

    Null where the reference is silent, and where the position is farther ahead or behind than the failure limit: over
    such a distance a curve alone is metres aside, and a slope metres up.
    """
    fixes = case.solution.fixes
    reference = case.reference
    at_ns = case.instants_of_epochs()
    across = np.full(at_ns.size, np.nan)
    up = np.full(at_ns.size, np.nan)
    if reference is not None and reference.height >= 2:
        stamps = times_ns(reference)
        since_s = (stamps - stamps[0]) / NS_PER_S
        at_s = (at_ns - stamps[0]) / NS_PER_S
        after = np.searchsorted(since_s, at_s).clip(1, since_s.size - 1)
        covered = (at_s >= since_s[0]) & (at_s <= since_s[-1])
        covered &= since_s[after] - since_s[after - 1] <= case.config.hazards.reference_gap_s
        latitude, longitude, height = (
            np.interp(at_s, since_s, floats(reference, name)) for name in ("latitude_deg", "longitude_deg", "height_m")
        )
        rows = np.flatnonzero(covered & np.isfinite(floats(fixes, "latitude_deg")))
        points = points_of(floats(fixes, "latitude_deg")[rows], floats(fixes, "longitude_deg")[rows])
        away = points.surface - points_of(latitude[rows], longitude[rows]).surface
        east = np.einsum("ij,ij->i", away, points.east)
        north = np.einsum("ij,ij->i", away, points.north)
        heading = np.radians(heading_deg[rows])
        # The vector from reference to position, turned from east and north to along and left of the heading.
        along_m = east * np.sin(heading) + north * np.cos(heading)
        left_m = north * np.sin(heading) - east * np.cos(heading)
        near = np.abs(along_m) <= case.config.hazards.failure_limit_m
        across[rows] = np.where(near, left_m, np.nan)
        up[rows] = np.where(near, (floats(fixes, "height_m") - height)[rows], np.nan)
    names = ("error_cross_m", "error_up_m")
    return [pl.Series(name, values, nan_to_null=True) for name, values in zip(names, (across, up), strict=True)]
