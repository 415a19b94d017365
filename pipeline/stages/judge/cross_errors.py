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
    at_ns = case.instants_of_epochs()
    errors_m = np.full((2, at_ns.size), np.nan)
    reference = case.reference
    if reference is not None and reference.height >= 2:
        stamps = times_ns(reference)
        since_s = (stamps - stamps[0]) / NS_PER_S
        at_s = (at_ns - stamps[0]) / NS_PER_S
        after = np.searchsorted(since_s, at_s).clip(1, since_s.size - 1)
        covered = (at_s >= since_s[0]) & (at_s <= since_s[-1])
        covered &= since_s[after] - since_s[after - 1] <= case.config.hazards.reference_gap_s
        columns = ("latitude_deg", "longitude_deg", "height_m")
        latitude, longitude, height_m = (floats(case.solution.fixes, name) for name in columns)
        rows = np.flatnonzero(covered & np.isfinite(latitude))
        there = [np.interp(at_s[rows], since_s, floats(reference, name)) for name in columns]
        points = points_of(latitude[rows], longitude[rows])
        away = points.surface - points_of(there[0], there[1]).surface
        east = np.einsum("ij,ij->i", away, points.east)
        north = np.einsum("ij,ij->i", away, points.north)
        heading = np.radians(heading_deg[rows])
        # The vector from reference to position, turned from east and north to along and left of the heading.
        along_m = east * np.sin(heading) + north * np.cos(heading)
        left_m = north * np.sin(heading) - east * np.cos(heading)
        near = np.abs(along_m) <= case.config.hazards.limits.abreast_m
        errors_m[:, rows] = np.where(near, [left_m, height_m[rows] - there[2]], np.nan)
    names = ("error_cross_m", "error_up_m")
    return [pl.Series(name, error_m, nan_to_null=True) for name, error_m in zip(names, errors_m, strict=True)]
