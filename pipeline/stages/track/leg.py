"""A chain of net elements as one polyline with one path position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from pipeline.stages.track.geodesy import Points, points_of
from pipeline.stages.track.segments import (
    SAMPLE_SPACING_M,
    Feet,
    Polyline,
    held_to_line,
    nearest,
    on_segments,
)
from pipeline.stages.track.survey import GAP_COUNTS_M, SurveyedTrack
from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen

# A hint further than this from the nearest place may mean another passage of the same place,
# if the track of that passage lies within the second distance of the first. Geometry of a line: anything between the
# noise of surveys and positions and the shortest loop of a railway gives the same passage.
HINT_WINDOW_M = 100.0
SAME_PLACE_M = 10.0
# A chord of less than GAP_COUNTS_M has the direction of the line over so much to both sides: scatter of 5 cm bends one
# of 9 cm by 30 degrees, and a position 1 m aside would stand still there and then jump. Geometry again: 5 cm over it is
# 1 degree, and a curve of 300 m leaves a chord of twice as much by 1 cm.
BASELINE_M = 2.5


@frozen
class Visit:
    """One net element on the path; `forward` when its measure grows with the path position."""

    element: int
    forward: bool


@frozen
class Leg:
    """A chain of net elements on which `path_m` is one to one; arrays are per segment, in order.

    `turn_start_rad`, `turn_end_rad`: change of heading at the segment's ends, positive to the left.
    """

    visits: tuple[Visit, ...]
    line: Polyline
    visit: Ints
    path_start_m: Floats
    path_end_m: Floats
    measure_start_m: Floats
    measure_end_m: Floats
    height_start_m: Floats
    height_end_m: Floats
    sigma_m: Floats
    heading_deg: Floats
    turn_start_rad: Floats
    turn_end_rad: Floats

    @cached_property
    def returns(self) -> bool:
        """Whether the leg comes back to a place where it was: a loop, or an element passed twice."""
        return _returns(self.line, self.path_start_m)

    @property
    def start_m(self) -> float:
        return float(self.path_start_m[0])

    @property
    def end_m(self) -> float:
        return float(self.path_end_m[-1])

    def entry_m(self, number: int) -> float:
        """Path position where an element of the leg is entered, behind the gap before it."""
        first = np.searchsorted(self.visit, number)
        return float(self.path_start_m[first + (self.measure_start_m[first] == self.measure_end_m[first])])


def leg_of(track: SurveyedTrack, visits: Sequence[Visit], start_m: float = 0.0) -> Leg:
    """A leg over oriented elements, `path_m` beginning at `start_m`.

    Gaps that the site check let pass count as straight track, so that path and odometer agree; an offset sideways
    between two elements adds no length.
    """
    vertex = np.concatenate([_vertices(track, visit) for visit in visits])
    count = np.array([track.first[visit.element + 1] - track.first[visit.element] for visit in visits])
    visit = np.repeat(np.arange(len(visits)), count)
    places = points_of(track.latitude_deg[vertex], track.longitude_deg[vertex])
    border = visit[1:] != visit[:-1]
    gap = _gaps(places.surface, border)
    measure = track.measure_m[vertex]
    grown = np.where(border, gap, np.abs(np.diff(measure)))
    path = start_m + np.concatenate([[0.0], np.cumsum(grown)])
    kept = np.flatnonzero(~border | (gap > 0))
    head = kept
    tail = kept + 1
    short = path[tail] - path[head] < GAP_COUNTS_M
    surface = _without_scatter(places.surface, path, path[np.concatenate([head[short], tail[short]])])
    heading, turn = _headings(places.take(head), surface.take(tail, axis=0) - surface.take(head, axis=0))
    height = track.height_m[vertex]
    sigma = track.sigma_m[vertex]
    return Leg(
        visits=tuple(visits),
        line=Polyline(surface.take(head, axis=0), surface.take(tail, axis=0)),
        visit=visit[tail],
        path_start_m=path[head],
        path_end_m=path[tail],
        # A gap belongs to the element after it, at that element's very start.
        measure_start_m=np.where(border[head], measure[tail], measure[head]),
        measure_end_m=measure[tail],
        height_start_m=height[head],
        height_end_m=height[tail],
        sigma_m=np.fmax(np.where(border[head], sigma[tail], sigma[head]), sigma[tail]),
        heading_deg=np.degrees(heading) % 360.0,
        turn_start_rad=np.concatenate([[0.0], turn]),
        turn_end_rad=np.concatenate([turn, [0.0]]),
    )


def shifted(leg: Leg, by_m: float) -> Leg:
    """The same leg with its path position moved on."""
    return replace(leg, path_start_m=leg.path_start_m + by_m, path_end_m=leg.path_end_m + by_m)


def nearest_on_leg(points: Points, leg: Leg, near_path_m: Floats | None = None) -> Feet:
    """The nearest place on a leg; of several passages of that place the one close to the hint."""
    feet = nearest(points, leg.line)
    if near_path_m is None or not leg.returns:
        return feet
    away = np.abs(path_at(leg, feet) - near_path_m) > HINT_WINDOW_M
    for row in np.flatnonzero(away):
        _prefer_hint(points.take(np.array([row])), leg, float(near_path_m[row]), int(row), feet)
    return feet


def path_at(leg: Leg, feet: Feet) -> Floats:
    """Path position of places on a leg [m]."""
    start = leg.path_start_m[feet.segment]
    return start + feet.fraction * (leg.path_end_m[feet.segment] - start)


def segments_at(leg: Leg, path_m: Floats) -> tuple[Ints, Floats]:
    """Segment and fraction along it of path positions; beyond the leg's ends the fraction leaves 0..1."""
    segment = np.searchsorted(leg.path_start_m, path_m, side="right") - 1
    segment = np.clip(segment, 0, len(leg.visit) - 1)
    return segment, (path_m - leg.path_start_m[segment]) / (leg.path_end_m - leg.path_start_m)[segment]


def _prefer_hint(point: Points, leg: Leg, hint_m: float, row: int, feet: Feet) -> None:
    """Replace the foot of `row` by another passage of the same place that is closer to the hint, if there is one.

    Looked for as far from the hint as the nearest place is: a position that jumped may lie far from where expected.
    """
    nearest_m = float(path_at(leg, feet.take(np.array([row])))[0])
    reach_m = max(HINT_WINDOW_M, abs(nearest_m - hint_m))
    inside = np.flatnonzero((leg.path_end_m >= hint_m - reach_m) & (leg.path_start_m <= hint_m + reach_m))
    trial = on_segments(point.take(np.zeros(len(inside), dtype=np.int64)), leg.line, inside)
    same = np.flatnonzero(trial.distance_m <= feet.distance_m[row] + SAME_PLACE_M)
    if len(same) == 0:
        return
    at_m = path_at(leg, trial.take(same))
    near = same[np.abs(at_m - at_m[np.argmin(np.abs(at_m - hint_m))]) <= HINT_WINDOW_M]
    best = int(near[np.argmin(trial.distance_m[near])])
    feet.put(np.array([row]), held_to_line(trial.take(np.array([best])), len(leg.line)))


def _returns(line: Polyline, path_start_m: Floats) -> bool:
    from scipy.spatial import cKDTree  # takes long to load, and a log needs none

    probes = np.unique(np.searchsorted(path_start_m, np.arange(path_start_m[0], path_start_m[-1], SAMPLE_SPACING_M)))
    places = line.start[probes]
    path_m = path_start_m[probes]
    pairs = cKDTree(places).query_pairs(SAME_PLACE_M + 2 * SAMPLE_SPACING_M, output_type="ndarray")
    return bool((np.abs(path_m[pairs[:, 0]] - path_m[pairs[:, 1]]) > HINT_WINDOW_M).any())


def _gaps(surface: Floats, border: Bools) -> Floats:
    """Way along the track that is missing between consecutive vertices [m]; zero but at borders of elements."""
    gap = np.zeros(border.size)
    at = np.flatnonzero(border)
    along = _unit(surface[at] - surface[at - 1]) + _unit(surface[at + 2] - surface[at + 1])
    missing = np.einsum("ij,ij->i", surface[at + 1] - surface[at], _unit(along))
    gap[at] = np.where(missing > GAP_COUNTS_M, missing, 0.0)
    return gap


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0))


def _vertices(track: SurveyedTrack, visit: Visit) -> Ints:
    part = np.arange(track.first[visit.element], track.first[visit.element + 1])
    return part if visit.forward else part[::-1]


def _without_scatter(surface: Floats, path_m: Floats, short_m: Floats) -> Floats:
    """Vertices at these path positions moved onto the chord of the line about them; not the ends of the leg."""
    inner = np.isin(path_m, short_m) & (path_m > path_m[0]) & (path_m < path_m[-1])
    rows = np.flatnonzero(inner)
    if not rows.size:
        return surface
    reach_m = np.minimum(BASELINE_M, np.minimum(path_m[rows] - path_m[0], path_m[-1] - path_m[rows]))
    before, after = (
        np.column_stack([np.interp(path_m[rows] + way_m, path_m, axis) for axis in surface.T])
        for way_m in (-reach_m, reach_m)
    )
    moved = surface.copy()
    moved[rows] = 0.5 * (before + after)
    return moved


def _headings(begin: Points, along: Floats) -> tuple[Floats, Floats]:
    """Heading of each segment, clockwise from north, and the left turn between neighbours [rad]."""
    east = np.einsum("ij,ij->i", along, begin.east)
    north = np.einsum("ij,ij->i", along, begin.north)
    heading = np.arctan2(east, north)
    turn = -np.diff(heading)
    return heading, np.asarray((turn + np.pi) % (2.0 * np.pi) - np.pi)
