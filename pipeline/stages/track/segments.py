"""Polylines on the ellipsoid with the nearest place on them, and the legs of a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.stages.track.geodesy import Points, points_of
from pipeline.stages.track.survey import GAP_COUNTS_M, SurveyedTrack
from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen

if TYPE_CHECKING:
    from scipy.spatial import cKDTree as Tree


# Search points along long segments: close enough that the nearest one leads to the nearest segment.
SAMPLE_SPACING_M = 20.0
# Numerics: so far about the places asked for, a network is looked through first; a run is on a small part of it.
_ABOUT_M = 10_000.0


@frozen
class Box:
    """What lies within a reach of some places, along the three axes."""

    low_m: Floats
    high_m: Floats

    def segments_touching(self, start: Floats, end: Floats) -> Ints:
        """Segments that may come into it: all that do are among them."""
        outside = ((np.maximum(start, end) < self.low_m) | (np.minimum(start, end) > self.high_m)).any(axis=1)
        return np.flatnonzero(~outside)

    def contains(self, other: Box) -> bool:
        """Whether another box lies within this one."""
        return bool((self.low_m <= other.low_m).all() and (self.high_m >= other.high_m).all())


def box_about(places: Floats, reach_m: float) -> Box:
    """The box that holds everything within a reach [m] of these places (one at least, earth-centred [m])."""
    return Box(places.min(axis=0) - reach_m, places.max(axis=0) + reach_m)


@frozen
class Polyline:
    """Segments in order along one line; `start` and `end` are earth-centred [m] at height zero."""

    start: Floats
    end: Floats

    # Where was looked last, with the search tree over its samples.
    _looked: list[tuple[Box, Tree, Ints]] = field(default_factory=list, init=False, repr=False)

    def __len__(self) -> int:
        return len(self.start)

    def nearest_sample(self, places: Floats) -> tuple[Floats, Ints]:
        """Distance [m] of each place from the nearest sample, and the segment of that."""
        if len(places) == 0:
            return np.zeros(0), np.zeros(0, dtype=np.int64)
        if not self._looked or not self._looked[0][0].contains(box_about(places, _ABOUT_M)):
            box = box_about(places, 2.0 * _ABOUT_M)
            rows = box.segments_touching(self.start, self.end)
            # Where nothing is near, the nearest is anywhere.
            rows = rows if len(rows) else np.arange(len(self))
            tree, segment = Polyline(self.start[rows], self.end[rows]).sample_tree
            self._looked[:] = [(box, tree, rows[segment])]
        _, tree, segment = self._looked[0]
        distance_m, sample = tree.query(places)
        if (distance_m <= _ABOUT_M).all():
            return distance_m, segment[sample]
        # A sample elsewhere may be nearer than that.
        tree, segment = self.sample_tree
        distance_m, sample = tree.query(places)
        return distance_m, segment[sample]

    @cached_property
    def sample_tree(self) -> tuple[Tree, Ints]:
        """A search tree over points at most `SAMPLE_SPACING_M` apart, and the segment of each."""
        from scipy.spatial import cKDTree  # takes long to load, and a log needs none

        along = self.end - self.start
        pieces = np.maximum(1, np.ceil(np.linalg.norm(along, axis=1) / SAMPLE_SPACING_M)).astype(np.int64)
        # `number` counts the pieces of each segment from 0: the running number less that of its first piece.
        segment = np.repeat(np.arange(len(self)), pieces)
        number = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        fraction = ((number + 0.5) / pieces[segment])[:, None]
        places = self.start.take(segment, axis=0) + fraction * along.take(segment, axis=0)
        # A tree without rebalancing builds faster and answers as fast on lines.
        return cKDTree(places, balanced_tree=False), segment


@frozen
class Feet:
    """The nearest place on a line for each point.

    `fraction` along `segment` is in 0..1, except beyond the line's two ends where it goes on straight;
    `offset_m` is positive to the left of the segment; `distance_m` is to the line itself.
    """

    segment: Ints
    fraction: Floats
    offset_m: Floats
    distance_m: Floats

    def take(self, rows: Ints) -> Feet:
        """Some of the feet."""
        return Feet(self.segment[rows], self.fraction[rows], self.offset_m[rows], self.distance_m[rows])

    def put(self, rows: Ints, replacement: Feet) -> None:
        """Replace some of the feet."""
        self.segment[rows] = replacement.segment
        self.fraction[rows] = replacement.fraction
        self.offset_m[rows] = replacement.offset_m
        self.distance_m[rows] = replacement.distance_m


def unknown_feet(count: int) -> Feet:
    """So many feet that are not known, to be filled with `put`."""
    unknown = np.full(count, np.nan)
    return Feet(np.zeros(count, dtype=np.int64), unknown, unknown.copy(), unknown.copy())


def nearest(points: Points, line: Polyline) -> Feet:
    """The nearest place on the line: nearest sample, then downhill over neighbouring segments."""
    if len(points) == 0:
        return unknown_feet(0)
    _, segment = line.nearest_sample(points.surface)
    return limit_to_line(walk_to_nearest(points, line, segment), len(line))


def walk_to_nearest(points: Points, line: Polyline, segment: Ints, line_of: Ints | None = None) -> Feet:
    """The nearest place from a first guess, walking along the line while that gets nearer.

    `fraction` is not limited; `line_of`: per segment the line that it belongs to, where there are several.
    """
    feet = project_on_segments(points, line, segment)
    active = np.flatnonzero((feet.fraction < 0) | (feet.fraction > 1))
    while len(active):
        step = np.where(feet.fraction[active] < 0, -1, 1)
        neighbour = feet.segment[active] + step
        inside = (neighbour >= 0) & (neighbour < len(line))
        active = active[inside]
        neighbour = neighbour[inside]
        if line_of is not None:
            same = line_of[neighbour] == line_of[feet.segment[active]]
            active = active[same]
            neighbour = neighbour[same]
        trial = project_on_segments(points.take(active), line, neighbour)
        better = np.flatnonzero(trial.distance_m < feet.distance_m[active] - 1e-9)
        active = active[better]
        feet.put(active, trial.take(better))
        active = active[(feet.fraction[active] < 0) | (feet.fraction[active] > 1)]
    return feet


def project_on_segments(points: Points, line: Polyline, segment: Ints) -> Feet:
    """Projection of each point on its segment, in the point's tangent plane; `fraction` is not limited."""
    to_start = line.start.take(segment, axis=0) - points.surface
    to_end = line.end.take(segment, axis=0) - points.surface
    x = _row_products(to_start, points.east)
    y = _row_products(to_start, points.north)
    dx = _row_products(to_end, points.east) - x
    dy = _row_products(to_end, points.north) - y
    # Foot of the perpendicular from the origin (the point): t = -(s . d) / |d|^2; left offset = (s x d) / |d|.
    square = np.maximum(dx * dx + dy * dy, 1e-18)
    fraction = -(x * dx + y * dy) / square
    held = np.clip(fraction, 0.0, 1.0)
    distance = np.hypot(x + held * dx, y + held * dy)
    offset = (dy * x - dx * y) / np.sqrt(square)
    return Feet(np.array(segment), fraction, offset, distance)


def limit_to_line(feet: Feet, count: int) -> Feet:
    """Feet held to the line: at a corner the vertex is nearest; only beyond the ends the line goes on."""
    low = np.where(feet.segment == 0, -np.inf, 0.0)
    high = np.where(feet.segment == count - 1, np.inf, 1.0)
    fraction = np.clip(feet.fraction, low, high)
    at_corner = fraction != feet.fraction
    side = np.where(feet.offset_m < 0, -1.0, 1.0)
    offset = np.where(at_corner, side * feet.distance_m, feet.offset_m)
    return Feet(feet.segment, fraction, offset, feet.distance_m)


def _row_products(a: Floats, b: Floats) -> Floats:
    """Scalar products row by row: shapes (n, 3), (n, 3) to (n,)."""
    return np.asarray(np.einsum("ij,ij->i", a, b))


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
        return _comes_back(self.line, self.path_start_m)

    @property
    def start_m(self) -> float:
        """Path position of its start [m]."""
        return float(self.path_start_m[0])

    @property
    def end_m(self) -> float:
        """Path position of its end [m]."""
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
    vertex = np.concatenate([_vertices_in_order(track, visit) for visit in visits])
    count = np.array([track.first[visit.element + 1] - track.first[visit.element] for visit in visits])
    visit = np.repeat(np.arange(len(visits)), count)
    places = points_of(track.latitude_deg[vertex], track.longitude_deg[vertex])
    border = visit[1:] != visit[:-1]
    gap = _gap_lengths_m(places.surface, border)
    measure = track.measure_m[vertex]
    grown = np.where(border, gap, np.abs(np.diff(measure)))
    path = start_m + np.concatenate([[0.0], np.cumsum(grown)])
    kept = np.flatnonzero(~border | (gap > 0))
    head = kept
    tail = kept + 1
    short = path[tail] - path[head] < GAP_COUNTS_M
    surface = _smoothed_vertices(places.surface, path, path[np.concatenate([head[short], tail[short]])])
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


def shift_leg(leg: Leg, by_m: float) -> Leg:
    """The same leg with its path position moved on by so much [m]."""
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
    trial = project_on_segments(point.take(np.zeros(len(inside), dtype=np.int64)), leg.line, inside)
    same = np.flatnonzero(trial.distance_m <= feet.distance_m[row] + SAME_PLACE_M)
    if len(same) == 0:
        return
    at_m = path_at(leg, trial.take(same))
    near = same[np.abs(at_m - at_m[np.argmin(np.abs(at_m - hint_m))]) <= HINT_WINDOW_M]
    best = int(near[np.argmin(trial.distance_m[near])])
    feet.put(np.array([row]), limit_to_line(trial.take(np.array([best])), len(leg.line)))


def _comes_back(line: Polyline, path_start_m: Floats) -> bool:
    """Whether two points far apart along the line lie in the same place."""
    from scipy.spatial import cKDTree  # takes long to load, and a log needs none

    probes = np.unique(np.searchsorted(path_start_m, np.arange(path_start_m[0], path_start_m[-1], SAMPLE_SPACING_M)))
    places = line.start[probes]
    path_m = path_start_m[probes]
    pairs = cKDTree(places).query_pairs(SAME_PLACE_M + 2 * SAMPLE_SPACING_M, output_type="ndarray")
    return bool((np.abs(path_m[pairs[:, 0]] - path_m[pairs[:, 1]]) > HINT_WINDOW_M).any())


def _gap_lengths_m(surface: Floats, border: Bools) -> Floats:
    """Length of track that is missing between consecutive vertices [m]; zero but at borders of elements."""
    gap = np.zeros(border.size)
    at = np.flatnonzero(border)
    along = _unit_vectors(surface[at] - surface[at - 1]) + _unit_vectors(surface[at + 2] - surface[at + 1])
    missing = np.einsum("ij,ij->i", surface[at + 1] - surface[at], _unit_vectors(along))
    gap[at] = np.where(missing > GAP_COUNTS_M, missing, 0.0)
    return gap


def _unit_vectors(vectors: Floats) -> Floats:
    """Vectors of length 1, shape (n, 3); of no length where they had none."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0))


def _vertices_in_order(track: SurveyedTrack, visit: Visit) -> Ints:
    """Vertices of an element in the order in which the path runs over them."""
    part = np.arange(track.first[visit.element], track.first[visit.element + 1])
    return part if visit.forward else part[::-1]


def _smoothed_vertices(surface: Floats, path_m: Floats, short_m: Floats) -> Floats:
    """Vertices at these path positions moved onto the chord of the line about them; not the ends of the leg."""
    inner = np.isin(path_m, short_m) & (path_m > path_m[0]) & (path_m < path_m[-1])
    rows = np.flatnonzero(inner)
    if not rows.size:
        return surface
    reach_m = np.minimum(BASELINE_M, np.minimum(path_m[rows] - path_m[0], path_m[-1] - path_m[rows]))
    before, after = (
        np.column_stack([np.interp(path_m[rows] + offset_m, path_m, axis) for axis in surface.T])
        for offset_m in (-reach_m, reach_m)
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
