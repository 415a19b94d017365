"""Positions against the surveyed track: wrong axes and signs, and a constant shift."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from pipeline.plausibility.course import Places
from pipeline.plausibility.frames import SLIPS, Slip
from pipeline.track.geodesy import Points, points_of
from pipeline.track.survey import Track, track_of
from schemas.arrays import Floats

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_SPACING_M = 20.0
_MOST = 400
_ROUNDS = 8
# Farther than this from every track, axes and signs are tried [m].
_FAR_M = 2_000.0
# A heading only: below this share of the information across it, the shift along the track is not known.
_ONE_HEADING = 0.04
_MOVES_MPS = 0.5


@dataclass(frozen=True)
class Line:
    """The survey as points close together, with the direction of the track at each, in earth-centred metres."""

    places_m: Floats
    along: Floats
    height_m: Floats
    tree: cKDTree


@dataclass(frozen=True)
class SurveyFit:
    """How positions lie to the track; shifts [m] are the survey's place minus the positions'.

    `aside_m`: usual distance beside the track as recorded, `left_m`: with the shift; `share`: of positions within
    `left_m` and some metres then. `one_heading`: the shift along the track is not known. Steady is what both halves of
    the run show: a drift of the positions is no shift.
    """

    far_m: float
    slip: Slip | None = None
    east_m: float = 0.0
    north_m: float = 0.0
    up_m: float = float("nan")
    aside_m: float = 0.0
    left_m: float = 0.0
    share: float = 0.0
    sigma_m: float = 0.0
    one_heading: bool = False
    height_ratio: float = float("nan")
    shift_is_steady: bool = True
    up_is_steady: bool = True

    @property
    def shift_m(self) -> float:
        return float(np.hypot(self.east_m, self.north_m))


def line_of(track: pl.DataFrame) -> Line:
    """The points of a site's track, kept for the next run."""
    return _line(_Key(track))


class _Key:
    """A frame that a cache knows by its identity."""

    def __init__(self, frame: pl.DataFrame) -> None:
        self.frame = frame

    def __hash__(self) -> int:
        return id(self.frame)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.frame is self.frame


@lru_cache(maxsize=2)
def _line(key: _Key) -> Line:
    from scipy.spatial import cKDTree

    track: Track = track_of(key.frame)
    places, along, heights = [], [], []
    surface = points_of(track.latitude_deg, track.longitude_deg).surface
    for _, _, part in track.elements():
        step = np.diff(surface[part], axis=0)
        length = np.linalg.norm(step, axis=1)
        way = np.concatenate([[0.0], np.cumsum(length)])
        if way[-1] <= 0.0:
            continue
        at = np.linspace(0.0, way[-1], int(way[-1] / _SPACING_M) + 2)
        places.append(np.column_stack([np.interp(at, way, surface[part][:, axis]) for axis in range(3)]))
        segment = np.searchsorted(way, at, side="right").clip(1, way.size - 1) - 1
        along.append(step[segment] / np.maximum(length[segment], 1e-9)[:, None])
        heights.append(np.interp(at, way, track.height_m[part]))
    points = np.concatenate(places)
    return Line(points, np.concatenate(along), np.concatenate(heights), cKDTree(points))


def fit_survey(gnss: Places, line: Line, start_m: tuple[float, float] = (0.0, 0.0)) -> SurveyFit:
    """Where the positions lie to the track, and what would bring them onto it; `start_m`: a shift to begin with."""
    moving = np.flatnonzero(np.nan_to_num(gnss.speed(gnss.t_s)) > _MOVES_MPS)
    rows = moving if moving.size >= 20 else np.arange(gnss.t_s.size)
    rows = rows[:: max(1, rows.size // _MOST)]
    latitude, longitude = gnss.latitude_deg[rows], gnss.longitude_deg[rows]
    far_m = _usual_distance_m(latitude, longitude, line)
    if far_m > _FAR_M:
        return SurveyFit(far_m, _slip_of(latitude, longitude, line))
    return _shifted(latitude, longitude, gnss.height_m[rows], far_m, line, start_m)


def _usual_distance_m(latitude_deg: Floats, longitude_deg: Floats, line: Line) -> float:
    if np.any(np.abs(latitude_deg) > 90.0):
        return float("inf")
    return float(np.median(line.tree.query(points_of(latitude_deg, longitude_deg).surface)[0]))


def _slip_of(latitude_deg: Floats, longitude_deg: Floats, line: Line) -> Slip | None:
    """The way of writing positions wrongly that explains how far they are from the track."""
    distances = [_usual_distance_m(*slip.mended(latitude_deg, longitude_deg), line) for slip in SLIPS]
    best = int(np.argmin(distances))
    return SLIPS[best] if distances[best] < _FAR_M / 4 else None


def _shifted(
    latitude: Floats, longitude: Floats, height: Floats, far_m: float, line: Line, start_m: tuple[float, float]
) -> SurveyFit:
    """The constant shift, by repeated projection and robust regression on the directions across the track."""
    points = points_of(latitude, longitude)
    axes = np.stack([points.east, points.north], axis=1)
    shift, narrow = np.array(start_m), False
    aside_m = _aside_m(points, axes, line)
    apart, nearest = np.zeros(latitude.size), np.zeros(latitude.size, dtype=np.int64)
    for _ in range(_ROUNDS):
        moved = points.surface + np.einsum("ijk,j->ik", axes, shift)
        nearest = line.tree.query(moved)[1]
        along = np.einsum("ijk,ik->ij", axes, line.along[nearest])
        across = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
        apart = np.einsum("ij,ij->i", np.einsum("ijk,ik->ij", axes, line.places_m[nearest] - points.surface), across)
        shift, narrow = _regressed(across, apart, shift)
        toward = (across @ shift) * apart
    steady = all(np.sum(part[0]) > 0.5 * np.sum(part[1]) for part in _halves(toward, (across @ shift) ** 2))
    apart = apart - across @ shift
    spread_m = 1.4826 * float(np.median(np.abs(apart)))
    up = line.height_m[nearest] - height
    ratio = np.where(np.abs(line.height_m[nearest]) > 30.0, height / line.height_m[nearest], np.nan)
    return SurveyFit(
        far_m=far_m,
        east_m=float(shift[0]),
        north_m=float(shift[1]),
        up_m=_median(up),
        aside_m=aside_m,
        left_m=float(np.median(np.abs(apart))),
        share=float(np.mean(np.abs(apart) < 3.0 * spread_m + 3.0)),
        sigma_m=spread_m,
        one_heading=narrow,
        height_ratio=_median(ratio),
        shift_is_steady=bool(steady),
        up_is_steady=all(_median(part[0]) * _median(up) > 0.5 * _median(up) ** 2 for part in _halves(up, up)),
    )


def _aside_m(points: Points, axes: Floats, line: Line) -> float:
    """Usual distance beside the track as recorded."""
    nearest = line.tree.query(points.surface)[1]
    along = np.einsum("ijk,ik->ij", axes, line.along[nearest])
    off = np.einsum("ijk,ik->ij", axes, line.places_m[nearest] - points.surface)
    size = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    return float(np.median(np.abs(off[:, 1] * along[:, 0] - off[:, 0] * along[:, 1]) / size))


def _regressed(across: Floats, apart: Floats, shift: Floats) -> tuple[Floats, bool]:
    """The shift that explains distances across the track; along a single heading none."""
    for _ in range(4):
        left = apart - across @ shift
        weight = 1.0 / np.maximum(np.abs(left), 1.0)
        normal = across.T @ (across * weight[:, None]) / weight.sum()
        values, vectors = np.linalg.eigh(normal)
        known = values > _ONE_HEADING
        right = across.T @ (weight * apart) / weight.sum()
        shift = vectors[:, known] @ ((vectors[:, known].T @ right) / values[known])
    return shift, bool((~known).any())


def _halves(one: Floats, other: Floats) -> list[tuple[Floats, Floats]]:
    middle = one.size // 2
    return [(one[:middle], other[:middle]), (one[middle:], other[middle:])]


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")
