"""Positions against the surveyed track: how far away, and by which constant shift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.plausibility.records import Places
from pipeline.plausibility.robust import Shift, regressed, sampled
from pipeline.track.geodesy import points_of
from pipeline.track.survey import track_of
from schemas.arrays import Floats

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Points of the track lie so far apart [m]; each round finds the nearest of them anew.
_SPACING_M, _ROUNDS = 20.0, 8


@dataclass(frozen=True)
class Line:
    """The survey as points close together, with the direction of the track at each, in earth-centred metres."""

    places_m: Floats
    along: Floats
    height_m: Floats
    tree: cKDTree

    def far_m(self, latitude_deg: Floats, longitude_deg: Floats) -> float:
        """Usual distance of some positions from the track."""
        if np.any(np.abs(latitude_deg) > 90.0):
            return float("inf")
        rows = slice(None, None, max(1, len(latitude_deg) // 100))
        return float(np.median(self.tree.query(points_of(latitude_deg[rows], longitude_deg[rows]).surface)[0]))


@dataclass(frozen=True)
class SurveyFit(Shift):
    """How positions lie to the track; the shift is the survey's place minus the positions'.

    `aside_m`: usual distance beside the track as recorded; `constant`: one shift explains most of it, in both halves of
    the run: a drift of the positions is no shift. `one_heading`: the shift along the track is not known. `up_m`: the
    survey's height minus the positions', one by one.
    """

    aside_m: float
    constant: bool
    one_heading: bool
    height_m: Floats
    up_m: Floats


def line_of(frame: pl.DataFrame) -> Line:
    """The points of a site's track."""
    from scipy.spatial import cKDTree

    track = track_of(frame)
    surface = points_of(track.latitude_deg, track.longitude_deg).surface
    parts: list[tuple[Floats, Floats, Floats]] = []
    for _, _, part in track.elements():
        step = np.diff(surface[part], axis=0)
        length = np.linalg.norm(step, axis=1)
        way = np.concatenate([[0.0], np.cumsum(length)])
        if way[-1] <= 0.0:
            continue
        at = np.linspace(0.0, way[-1], int(way[-1] / _SPACING_M) + 2)
        segment = np.searchsorted(way, at, side="right").clip(1, way.size - 1) - 1
        places = np.column_stack([np.interp(at, way, axis) for axis in surface[part].T])
        along = step[segment] / np.maximum(length[segment], 1e-9)[:, None]
        parts.append((places, along, np.interp(at, way, track.height_m[part])))
    places, along, heights = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Line(places, along, heights, cKDTree(places))


def fit_survey(gnss: Places, line: Line, start_m: tuple[float, float] = (0.0, 0.0)) -> SurveyFit:
    """The constant shift that brings moving positions onto the track, by repeated projection and robust regression.

    `start_m`: a shift to begin with.
    """
    config, moving = gnss.config, gnss.moving
    rows = np.flatnonzero(sampled(moving if moving.sum() >= 20 else np.ones_like(moving), 400))
    points = gnss.points.take(rows)
    axes = np.stack([points.east, points.north], axis=1)

    def beside(shift_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Direction across the track at the nearest point of each moved position, how far it is, and its height."""
        nearest = line.tree.query(points.surface + np.einsum("ijk,j->ik", axes, shift_m))[1]
        along = np.einsum("ijk,ik->ij", axes, line.along[nearest])
        across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        off = np.einsum("ijk,ik->ij", axes, line.places_m[nearest] - points.surface)
        return across, np.einsum("ij,ij->i", off, across), line.height_m[nearest]

    aside_m = float(np.median(np.abs(beside(np.zeros(2))[1])))
    shift = np.array(start_m)
    for _ in range(_ROUNDS):
        across, apart, height_m = beside(shift)
        fit = regressed(across[:, None, :], apart[:, None], floor=1.0, told=config.one_heading, halves=False)
        shift = fit.estimate
    left = np.abs(apart - across @ shift)
    left_m, half = float(np.median(left)), len(apart) // 2
    toward, whole = (across @ shift) * apart, (across @ shift) ** 2
    steady = all(toward[part].sum() > 0.5 * whole[part].sum() for part in (slice(half), slice(half, None)))
    near = float(np.mean(left < 4.5 * left_m + 3.0)) > config.shift_positions
    return SurveyFit(
        east_m=float(shift[0]),
        north_m=float(shift[1]),
        aside_m=aside_m,
        constant=left_m < config.shift_leaves * aside_m and near and steady,
        one_heading=not fit.whole,
        height_m=gnss.height_m[rows],
        up_m=height_m - gnss.height_m[rows],
    )
