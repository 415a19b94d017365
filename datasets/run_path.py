"""The path that a recorded train took, so that a displaced position stays on its track."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.prepare import prepare
from pipeline.stages.track.geodesy import curvature_radii_m, moved_deg, point_distances_m
from schemas.arrays import Floats, Ints, floats
from schemas.config import Configuration, Vehicle
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.run import RunLog, Site

# Positions are averaged over this distance, and movement below it is taken for noise of a standing train.
_BIN_M = 10.0
_OUTER_CELLS = 3


@frozen
class DrivenPath:
    """Where positions were along their own path and left of it at some instants, and the path by the distance along it.

    `own_height_m`: of the positions. `course_m`: over so much of it, to both sides, its course is taken.
    """

    t_ns: Ints
    s_m: Floats
    left_m: Floats
    own_height_m: Floats
    course_m: float
    axis_m: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats

    def places(self, s_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Positions at distances along the path; beyond its ends it goes on straight."""
        axes = (self.latitude_deg, self.longitude_deg, self.height_m)
        latitude, longitude, height = (_interpolate_beyond(s_m, self.axis_m, values) for values in axes)
        return latitude, longitude, height


def driven_path(run: RunLog, solution: str, site: Site | None = None) -> DrivenPath:
    """The track of the site where one is given, else what the run's own positions show, averaged over 10 m."""
    return _path_of_positions(run, solution) if site is None else _path_of_site(run, solution, site)


def displacement_m(driven: DrivenPath, t_ns: Ints, ahead_m: Floats, left_m: Floats) -> Floats:
    """East, north, up [m] of positions moved along the track and to its left, shape (instants, 3).

    Ahead is the run's first direction of travel.
    """
    now = t_ns.astype(np.float64)
    known = driven.t_ns.astype(np.float64)
    s_m, offset_m, own_m = (np.interp(now, known, at) for at in (driven.s_m, driven.left_m, driven.own_height_m))
    here = driven.places(s_m)
    there = driven.places(s_m + ahead_m)
    east_here, north_here = _left_direction(driven, s_m)
    # A position off the track stays as far off it where the track has turned.
    begin = moved_deg(*here, offset_m * east_here, offset_m * north_here)
    east_there, north_there = _left_direction(driven, s_m + ahead_m)
    end = moved_deg(*there, offset_m * east_there, offset_m * north_there)
    east, north, _ = _horizon_vector_m((*begin, own_m), (*end, own_m))
    return np.column_stack([east + left_m * east_here, north + left_m * north_here, there[2] - here[2]])


def _left_direction(driven: DrivenPath, s_m: Floats) -> tuple[Floats, Floats]:
    """East and north of the unit vector to the left of the path at these distances."""
    course_e, course_n, _ = _horizon_vector_m(
        driven.places(s_m - driven.course_m), driven.places(s_m + driven.course_m)
    )
    norm = np.hypot(course_e, course_n)
    return -course_n / norm, course_e / norm


def _path_of_positions(run: RunLog, solution: str) -> DrivenPath:
    """The path of the run's own positions, by odometer distance where recorded, else by that between positions."""
    fixes = _valid_positions(run, solution)
    t_ns = fixes["t"].to_physical().to_numpy()
    places = [fixes[name].to_numpy().astype(np.float64) for name in ("latitude_deg", "longitude_deg", "height_m")]
    places[2] = np.nan_to_num(places[2])
    s_m = _odometer_m(run, t_ns)
    if s_m is None:
        s_m = _distance_of_positions_m(*places)
    cell = np.floor(s_m / _BIN_M).astype(np.int64)
    cells, of_epoch = np.unique(cell, return_inverse=True)
    if cells.size < 3:
        raise InputError("the train moves too little to know its track", place=run.run_id, expected="30 m or more")
    count = np.bincount(of_epoch)
    means = [np.bincount(of_epoch, weights=values) / count for values in (s_m, *places)]
    return DrivenPath(t_ns, s_m, np.zeros_like(s_m), places[2], _BIN_M, *means)


def _path_of_site(run: RunLog, solution: str, site: Site) -> DrivenPath:
    """The path by the site: every epoch of the run, and what lies beyond, at its place on the matched path."""
    prepared = prepare(run, site, Vehicle(), Configuration())
    fixes = prepared.fixes(solution)
    found = prepared.match(solution)
    epochs = found.epochs.table.filter(pl.col("path_m").is_not_null())
    if epochs["leg"].n_unique() != 1:
        raise InputError("the path changes direction at a switch", place=run.run_id, remedy="Inject without --site.")
    s_m = epochs["path_m"].to_numpy()
    points_m = found.path.legs[epochs["leg"][0]].path_start_m
    axis = np.union1d(np.arange(s_m.min() - _BEYOND_M, s_m.max() + _BEYOND_M, _BIN_M / 2.0), points_m)
    leg = np.full(axis.size, epochs["leg"][0], dtype=np.int64)
    elements, measures = found.path.locate(leg, axis)
    places = _places_on_track(site.track, elements.tolist(), measures)
    left_m = epochs["cross_track_m"].to_numpy()
    own = fixes.join(epochs.select("t"), on="t", how="right", maintain_order="right")
    own_m = np.nan_to_num(floats(own, "height_m"))
    return DrivenPath(epochs["t"].to_physical().to_numpy(), s_m, left_m, own_m, _AT_POINT_M, axis, *places)


# The survey is straight from point to point, so its course at a place is that of the segment there.
_AT_POINT_M = 0.05
# How far a position may be displaced beyond the ends of the run and still follow the track.
_BEYOND_M = 5000.0


def _places_on_track(
    track: pl.DataFrame, elements: list[str | None], measures: Floats
) -> tuple[Floats, Floats, Floats]:
    """Places on the track, by net element and measure."""
    names = np.array(elements, dtype=object)
    result = np.full((3, names.size), np.nan)
    for element in dict.fromkeys(elements):
        rows = np.flatnonzero(names == element)
        points = track.filter(pl.col("netelement_id") == element)
        at = points["measure_m"].to_numpy()
        for axis, name in enumerate(("latitude_deg", "longitude_deg", "height_m")):
            values = np.nan_to_num(points[name].to_numpy().astype(np.float64))
            result[axis, rows] = _interpolate_beyond(measures[rows], at, values)
    return result[0], result[1], result[2]


def _valid_positions(run: RunLog, solution: str) -> pl.DataFrame:
    """Positions of one solution, those without fix left out."""
    fixes = run.gnss.filter(
        (pl.col("solution") == solution) & pl.col("latitude_deg").is_not_null() & (pl.col("fix") != "none")
    )
    if fixes.is_empty():
        raise InputError("has no positions", place=f"{run.run_id}: gnss, solution {solution}")
    return fixes.sort("t", maintain_order=True)


def _odometer_m(run: RunLog, t_ns: Ints) -> Floats | None:
    """Odometer distance at instants, growing in the first direction of travel."""
    if run.odometer is None:
        return None
    counting = run.odometer.filter(pl.col("distance_m").is_not_null()).sort("t", maintain_order=True)
    moves = counting.filter(pl.col("sensor") == pl.col("sensor").min())
    if moves.is_empty():
        return None
    distance = moves["distance_m"].to_numpy()
    gone = np.flatnonzero(np.abs(distance - distance[0]) > 2.0 * _BIN_M)
    sign = np.sign(distance[gone[0]] - distance[0]) if gone.size else 1.0
    stamps = moves["t"].to_physical().to_numpy().astype(np.float64)
    along: Floats = np.interp(t_ns.astype(np.float64), stamps, sign * (distance - distance[0]))
    return along


def _distance_of_positions_m(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> Floats:
    """Length of the polyline through positions at least 10 m apart; those between are placed by share of time."""
    kept = [0]
    for i in range(1, latitude_deg.size):
        pair = [values[[kept[-1], i]] for values in (latitude_deg, longitude_deg, height_m)]
        if point_distances_m(*pair)[0] >= _BIN_M:
            kept.append(i)
    if kept[-1] != latitude_deg.size - 1 and len(kept) > 1:
        # What is left at the end belongs to the last step, as noise of a train that stands or its last metres.
        kept[-1] = latitude_deg.size - 1
    lengths = point_distances_m(latitude_deg[kept], longitude_deg[kept], height_m[kept])
    return np.interp(np.arange(latitude_deg.size), kept, np.concatenate(([0.0], np.cumsum(lengths))))


def _interpolate_beyond(x: Floats, at: Floats, values: Floats) -> Floats:
    """Linear interpolation that goes on beyond the ends with the mean slope of the outer cells."""
    order = np.argsort(at, kind="stable")
    at = at[order]
    values = values[order]
    inside = np.interp(x, at, values)
    some = min(_OUTER_CELLS, at.size - 1)
    first = (values[some] - values[0]) / (at[some] - at[0])
    last = (values[-1] - values[-1 - some]) / (at[-1] - at[-1 - some])
    return np.where(
        x < at[0], values[0] + first * (x - at[0]), np.where(x > at[-1], values[-1] + last * (x - at[-1]), inside)
    )


def _horizon_vector_m(
    origin: tuple[Floats, Floats, Floats], point: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats, Floats]:
    """Vector between near places in the horizon of the first [m]."""
    latitude = np.radians(origin[0])
    meridian_m, normal_m = curvature_radii_m(latitude)
    east = np.radians(point[1] - origin[1]) * (normal_m + origin[2]) * np.cos(latitude)
    north = np.radians(point[0] - origin[0]) * (meridian_m + origin[2])
    return east, north, point[2] - origin[2]
