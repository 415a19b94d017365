"""Positions against the surveyed track: how far away, and by which constant shift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.plausibility.records import Places
from pipeline.plausibility.robust import Shift, regressed, sampled
from pipeline.track.geodesy import points_of
from pipeline.track.segments import Polyline, on_segments
from pipeline.track.survey import track_of
from schemas.arrays import Floats

# Each round finds the nearest segments of the track anew.
_ROUNDS = 8


@dataclass(frozen=True)
class Line(Polyline):
    """The segments of a survey, with the heights of their ends."""

    height_start_m: Floats
    height_end_m: Floats

    def far_m(self, latitude_deg: Floats, longitude_deg: Floats) -> float:
        """Usual distance of some positions from the track."""
        if np.any(np.abs(latitude_deg) > 90.0):
            return float("inf")
        rows = slice(None, None, max(1, len(latitude_deg) // 100))
        return float(np.median(self.samples[0].query(points_of(latitude_deg[rows], longitude_deg[rows]).surface)[0]))


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
    """The segments of a site's track."""
    track = track_of(frame)
    surface = points_of(track.latitude_deg, track.longitude_deg).surface
    within = np.setdiff1d(np.arange(len(surface) - 1), track.first[1:-1] - 1)
    rows = within[np.any(surface[within] != surface[within + 1], axis=1)]
    return Line(surface[rows], surface[rows + 1], track.height_m[rows], track.height_m[rows + 1])


def fit_survey(gnss: Places, line: Line, start_m: tuple[float, float] = (0.0, 0.0)) -> SurveyFit:
    """The constant shift that brings moving positions onto the track, by repeated projection and robust regression.

    `start_m`: a shift to begin with.
    """
    config, moving = gnss.config, gnss.moving
    rows = np.flatnonzero(sampled(moving if moving.sum() >= 20 else np.ones_like(moving), 400))
    points = gnss.points.take(rows)
    axes = np.stack([points.east, points.north], axis=1)

    def beside(shift_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Direction across the track at the nearest segment of each moved position, how far it is, and its height."""
        tree, segment = line.samples
        nearest = segment[tree.query(points.surface + np.einsum("ijk,j->ik", axes, shift_m))[1]]
        along = np.einsum("ijk,ik->ij", axes, line.end[nearest] - line.start[nearest])
        across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        feet = on_segments(points, line, nearest)
        part, low_m = np.clip(feet.fraction, 0.0, 1.0), line.height_start_m[nearest]
        return across, -feet.offset_m, low_m + part * (line.height_end_m[nearest] - low_m)

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
