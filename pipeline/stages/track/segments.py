"""Polylines on the ellipsoid, and the nearest place on them."""

from __future__ import annotations

from dataclasses import field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from pipeline.stages.track.geodesy import Points
from schemas.arrays import Floats, Ints
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

    def touched_by(self, start: Floats, end: Floats) -> Ints:
        """Segments that may come into it: all that do are among them."""
        outside = ((np.maximum(start, end) < self.low_m) | (np.minimum(start, end) > self.high_m)).any(axis=1)
        return np.flatnonzero(~outside)

    def holds(self, other: Box) -> bool:
        return bool((self.low_m <= other.low_m).all() and (self.high_m >= other.high_m).all())


def box_about(places: Floats, reach_m: float) -> Box:
    """`places`: one at least, earth-centred [m]."""
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
        if not self._looked or not self._looked[0][0].holds(box_about(places, _ABOUT_M)):
            box = box_about(places, 2.0 * _ABOUT_M)
            rows = box.touched_by(self.start, self.end)
            # Where nothing is near, the nearest is anywhere.
            rows = rows if len(rows) else np.arange(len(self))
            tree, segment = Polyline(self.start[rows], self.end[rows]).samples
            self._looked[:] = [(box, tree, rows[segment])]
        _, tree, segment = self._looked[0]
        distance_m, sample = tree.query(places)
        if (distance_m <= _ABOUT_M).all():
            return distance_m, segment[sample]
        # A sample elsewhere may be nearer than that.
        tree, segment = self.samples
        distance_m, sample = tree.query(places)
        return distance_m, segment[sample]

    @cached_property
    def samples(self) -> tuple[Tree, Ints]:
        """A search tree over points at most `SAMPLE_SPACING_M` apart, and the segment of each."""
        from scipy.spatial import cKDTree  # takes long to load, and a log needs none

        way = self.end - self.start
        pieces = np.maximum(1, np.ceil(np.linalg.norm(way, axis=1) / SAMPLE_SPACING_M)).astype(np.int64)
        segment = np.repeat(np.arange(len(self)), pieces)
        number = np.arange(len(segment)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        fraction = ((number + 0.5) / pieces[segment])[:, None]
        places = self.start.take(segment, axis=0) + fraction * way.take(segment, axis=0)
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


def no_feet(count: int) -> Feet:
    """Feet to be filled with `put`."""
    unknown = np.full(count, np.nan)
    return Feet(np.zeros(count, dtype=np.int64), unknown, unknown.copy(), unknown.copy())


def nearest(points: Points, line: Polyline) -> Feet:
    """The nearest place on the line: nearest sample, then downhill over neighbouring segments."""
    if len(points) == 0:
        return no_feet(0)
    _, segment = line.nearest_sample(points.surface)
    return held_to_line(downhill(points, line, segment), len(line))


def downhill(points: Points, line: Polyline, segment: Ints, line_of: Ints | None = None) -> Feet:
    """The nearest place from a first guess, walking along the line while that gets nearer; `fraction` is not limited.

    `line_of`: per segment the line that it belongs to, where there are several.
    """
    feet = on_segments(points, line, segment)
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
        trial = on_segments(points.take(active), line, neighbour)
        better = np.flatnonzero(trial.distance_m < feet.distance_m[active] - 1e-9)
        active = active[better]
        feet.put(active, trial.take(better))
        active = active[(feet.fraction[active] < 0) | (feet.fraction[active] > 1)]
    return feet


def on_segments(points: Points, line: Polyline, segment: Ints) -> Feet:
    """Each point on its given segment, in the tangent plane of the point; `fraction` is not limited."""
    to_start = line.start.take(segment, axis=0) - points.surface
    to_end = line.end.take(segment, axis=0) - points.surface
    x = _dot(to_start, points.east)
    y = _dot(to_start, points.north)
    dx = _dot(to_end, points.east) - x
    dy = _dot(to_end, points.north) - y
    square = np.maximum(dx * dx + dy * dy, 1e-18)
    fraction = -(x * dx + y * dy) / square
    held = np.clip(fraction, 0.0, 1.0)
    distance = np.hypot(x + held * dx, y + held * dy)
    offset = (dy * x - dx * y) / np.sqrt(square)
    return Feet(np.array(segment), fraction, offset, distance)


def held_to_line(feet: Feet, count: int) -> Feet:
    """At a corner between two segments the vertex is nearest; only beyond the ends the line goes on."""
    low = np.where(feet.segment == 0, -np.inf, 0.0)
    high = np.where(feet.segment == count - 1, np.inf, 1.0)
    fraction = np.clip(feet.fraction, low, high)
    at_corner = fraction != feet.fraction
    side = np.where(feet.offset_m < 0, -1.0, 1.0)
    offset = np.where(at_corner, side * feet.distance_m, feet.offset_m)
    return Feet(feet.segment, fraction, offset, feet.distance_m)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", a, b))
