"""Where each epoch may be: the nearest place on every net element within reach."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.stages.track.geodesy import Points, points_of
from pipeline.stages.track.network import Network, Once
from pipeline.stages.track.segments import Box, Feet, Polyline, box_about, walk_to_nearest
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Bools, Floats, Ints
from schemas.frozen import frozen

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Every place on an element has a search point within this distance along it. Numerics: it decides how many points are
# searched, not which elements are within reach.
PROBE_SPACING_M = 40.0
# Where two elements meet at a bend, a position lies inside both over so much at most: 40 m aside at 3 degrees.
BEND_M = 2.0


@frozen
class Segments(Polyline):
    """All segments of the network, element by element; `first[e] : first[e + 1]` are those of element e.

    `vertex` at which each begins; `length_m` of each, and `distance_along_m`: of all up to the end of each.
    """

    element: Ints
    first: Ints
    vertex: Ints
    length_m: Floats
    distance_along_m: Floats

    def search_in(self, box: Box | None = None) -> SegmentSearch:
        """The search over all segments, or those in a box: a run needs only the part of a network about it."""
        from scipy.spatial import cKDTree  # takes long to load, and a log needs none

        rows = np.arange(len(self)) if box is None else box.segments_touching(self.start, self.end)
        probes, segment = self._search_points(rows)
        return SegmentSearch(self, cKDTree(probes, balanced_tree=False, compact_nodes=False), segment)

    def _search_points(self, rows: Ints) -> tuple[Floats, Ints]:
        """Search points on some segments, and the segment of each: several on long ones, few on runs of short ones."""
        # Whether one is needed depends on the segment before.
        wanted = np.zeros(len(self), dtype=np.bool_)
        wanted[rows] = True
        some = np.flatnonzero(wanted | np.append(wanted[1:], False))
        pieces = np.maximum(1, np.ceil(self.length_m[some] / (0.25 * PROBE_SPACING_M))).astype(np.int64)
        segment = np.repeat(some, pieces)
        # Number of each point within its segment.
        number = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        fraction = (number + 0.5) / np.repeat(pieces, pieces)
        place = self.distance_along_m[segment] - self.length_m[segment] * (1.0 - fraction)
        # The first point in each bucket of distance along the element is enough.
        bucket = np.floor(place / (0.75 * PROBE_SPACING_M))
        new = np.ones(len(segment), dtype=np.bool_)
        new[1:] = (bucket[1:] != bucket[:-1]) | (np.diff(self.element[segment]) != 0)
        kept = np.flatnonzero(new & wanted[segment])
        chosen = segment[kept]
        start = self.start[chosen]
        return start + fraction[kept][:, None] * (self.end[chosen] - start), chosen


@frozen
class SegmentSearch:
    """A search tree over points on segments, and the segment of each point."""

    segments: Segments
    tree: cKDTree
    segment: Ints


@frozen
class Candidates:
    """Places on net elements within reach, by step, then element; `first[k] : first[k + 1]` are those of step k.

    `along_m` from the element's start and `left_m` to its end; `beyond_m` how far the position lies past the end that
    `past` names (-1 start, 1 end, 0 neither); `offset_m` left of its own sense; `height_m` of the track (NaN on a 2-D
    survey); `vertex` at which the segment begins; `linked_start`, `linked_end`: a relation leads on there.
    """

    first: Ints
    step: Ints
    element: Ints
    along_m: Floats
    left_m: Floats
    beyond_m: Floats
    offset_m: Floats
    distance_m: Floats
    height_m: Floats
    heading_rad: Floats
    vertex: Ints
    past: Ints
    linked_start: Bools
    linked_end: Bools

    def rows_of(self, element: int, begin: int, end: int) -> Ints:
        """Rows of an element at the steps from `begin` on, before `end`, in their order."""
        order, first = self._by_element
        rows = order[first[element] : first[element + 1]] if element + 1 < first.size else order[:0]
        low, high = np.searchsorted(self.step[rows], [begin, end]).tolist()
        return rows[low:high]

    @cached_property
    def _by_element(self) -> tuple[Ints, Ints]:
        """Rows in order of net element and step, and where each net element begins among them."""
        order = np.lexsort((self.step, self.element))
        most = int(self.element.max(initial=-1))
        return order, np.searchsorted(self.element[order], np.arange(most + 2))

    def take(self, rows: Ints, steps: int) -> Candidates:
        """Some of the candidates, in the same order; `steps`: how many steps there are."""
        step = self.step[rows]
        columns = {name: getattr(self, name)[rows] for name in _COLUMNS}
        return Candidates(first=np.searchsorted(step, np.arange(steps + 1)), **columns)

    def with_steps_renumbered(self, kept: Bools) -> Candidates:
        """The candidates with steps counted among the kept ones only; the others have no candidates."""
        number = np.cumsum(kept) - 1
        step = number[self.step]
        return replace(self, step=step, first=np.searchsorted(step, np.arange(int(kept.sum()) + 1)))


_COLUMNS = tuple(column.name for column in fields(Candidates) if column.name != "first")


@Once
def segments_of(track: SurveyedTrack) -> Segments:
    """Segments of all elements of a track."""
    owner = np.repeat(np.arange(len(track.ids)), np.diff(track.first))
    # A segment begins at each vertex but the last of an element.
    head = np.flatnonzero(owner[:-1] == owner[1:])
    start = track.surface[head]
    end = track.surface[head + 1]
    length_m = np.linalg.norm(end - start, axis=1)
    first = np.searchsorted(owner[head], np.arange(len(track.ids) + 1))
    return Segments(start, end, owner[head], first, head, length_m, np.cumsum(length_m))


def search_about(places: Floats, network: Network, reach_m: float) -> SegmentSearch:
    """A search over the segments within a reach [m] of these places."""
    return segments_of(network.track).search_in(box_about(places, reach_m + PROBE_SPACING_M))


def candidates_of(points: Points, network: Network, search: SegmentSearch, reach_m: float) -> Candidates:
    """The nearest place on each element within reach of every point.

    Args:
        points: positions, shape (n, 3).
        network: the track network.
        search: where to look, as `search_about` makes it.
        reach_m: largest distance of a place from its point [m].

    Returns:
        Places in order of point, then element.
    """
    from scipy.spatial import cKDTree

    segments = search.segments
    tree = cKDTree(points.surface)
    pairs = tree.sparse_distance_matrix(search.tree, reach_m + PROBE_SPACING_M, output_type="ndarray")
    step = pairs["i"].astype(np.int64)
    segment = search.segment[pairs["j"]]
    # Step and element in one number, which sorts faster than both.
    order = np.lexsort((pairs["v"], step * network.count + segments.element[segment]))
    step = step[order]
    segment = segment[order]
    element = segments.element[segment]
    # Sorted by step, element and distance: the first row of each pair is the nearest probe.
    fresh = np.ones(len(step), dtype=bool)
    fresh[1:] = (step[1:] != step[:-1]) | (element[1:] != element[:-1])
    feet = walk_to_nearest(points.take(step[fresh]), segments, segment[fresh], segments.element)
    near = np.flatnonzero(feet.distance_m <= reach_m)
    return _candidates_at_feet(len(points), network, segments, step[fresh][near], feet.take(near))


def belong_beyond(candidates: Candidates, network: Network) -> Bools:
    """Candidates near an end of their element whose position belongs to the next element beyond that end.

    So a position has one place on a line, however many elements this is cut into: on the element that it lies farther
    inside of, as at a bend it may lie past the ends of both, or inside both.
    """
    past_m = _distances_past_ends_m(candidates)
    row, end = np.nonzero(np.isfinite(past_m))
    edge_first = network.successors.first
    edge_to = network.successors.to
    # One row for each relation that leads on over that end.
    leaving = 2 * candidates.element[row] + 1 - end
    number = np.diff(edge_first)[leaving]
    edge = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number - edge_first[leaving], number)
    row = np.repeat(row, number)
    end = np.repeat(end, number)
    entered = edge_to[edge]
    # The candidate of the same step on the next element, looked up by step and element in one sorted number.
    keys = candidates.step * network.count + candidates.element
    rival_key = candidates.step[row] * network.count + entered // 2
    rival = np.minimum(np.searchsorted(keys, rival_key), len(keys) - 1)
    row_m = past_m[row, end]
    rival_m = past_m[rival, entered % 2]
    competes = (keys[rival] == rival_key) & (rival != row)
    beyond = competes & (row_m > 0.0) & np.isinf(rival_m)
    nearer = competes & ((rival_m < row_m) | ((rival_m == row_m) & (rival < row)))
    out = np.zeros(len(keys), dtype=bool)
    while True:
        # Only by a candidate that is not overtaken itself, as at a switch another branch may hold it: so in rounds.
        now = np.zeros(len(keys), dtype=bool)
        now[row[beyond | (nearer & ~out[rival])]] = True
        if (now == out).all():
            return out
        out = now


def _distances_past_ends_m(candidates: Candidates) -> Floats:
    """How far each candidate lies past its element's start and end [m], negative inside, infinite if not near."""
    columns = []
    for past, inside_m in ((-1, candidates.along_m), (1, candidates.left_m)):
        inside = np.where((candidates.past == 0) & (inside_m < BEND_M), -inside_m, np.inf)
        columns.append(np.where(candidates.past == past, candidates.beyond_m, inside))
    return np.column_stack(columns)


def merge_candidates(some: Candidates, added: Candidates, step_of_added: Ints) -> Candidates:
    """Candidates of two searches together; the steps of the second are numbered anew."""
    steps = len(some.first) - 1
    added = replace(added, step=step_of_added[added.step])
    columns = {name: np.concatenate([getattr(some, name), getattr(added, name)]) for name in _COLUMNS}
    order = np.lexsort((columns["element"], columns["step"]))
    columns = {name: values[order] for name, values in columns.items()}
    return Candidates(first=np.searchsorted(columns["step"], np.arange(steps + 1)), **columns)


def _candidates_at_feet(points: int, network: Network, segments: Segments, step: Ints, feet: Feet) -> Candidates:
    """Feet on segments as places on net elements, one row each; `step`: the point that each foot belongs to."""
    segment = feet.segment
    element = segments.element[segment]
    held = np.clip(feet.fraction, 0.0, 1.0)
    track = network.track
    vertex = segments.vertex[segment]
    measure = track.measure_m[vertex]
    span = track.measure_m[vertex + 1] - measure
    at_start = (segment == segments.first[element]) & (feet.fraction < 0)
    at_end = (segment == segments.first[element + 1] - 1) & (feet.fraction > 1)
    past = np.where(at_start, -1, np.where(at_end, 1, 0))
    corner = (past == 0) & (held != feet.fraction)
    side = np.where(feet.offset_m < 0, -1.0, 1.0)
    along = measure + held * span - track.measure_m[track.first[element]]
    linked = network.have_successors()
    return Candidates(
        first=np.searchsorted(step, np.arange(points + 1)),
        step=step,
        element=element,
        along_m=along,
        left_m=track.length_m[element] - along,
        beyond_m=np.abs(feet.fraction - held) * span * (past != 0),
        offset_m=np.where(corner, side * feet.distance_m, feet.offset_m),
        distance_m=feet.distance_m,
        height_m=(1.0 - held) * track.height_m[vertex] + held * track.height_m[vertex + 1],
        heading_rad=_headings_rad(track, vertex),
        vertex=vertex,
        past=past,
        linked_start=linked[element, 0],
        linked_end=linked[element, 1],
    )


def _headings_rad(track: SurveyedTrack, vertex: Ints) -> Floats:
    """Heading of the segments that begin at these vertices, clockwise from north [rad]."""
    # Steps share vertices: each heading once.
    some, which = np.unique(vertex, return_inverse=True)
    places = points_of(track.latitude_deg[some], track.longitude_deg[some])
    along = track.surface[some + 1] - track.surface[some]
    east = np.einsum("ij,ij->i", along, places.east)
    north = np.einsum("ij,ij->i", along, places.north)
    return np.asarray(np.arctan2(east, north)[which])
