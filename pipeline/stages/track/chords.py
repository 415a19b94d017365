"""How far the chords of a survey may lie off the curve that they stand for.

A chord of length L between two points of an arc, at each of which the line turns by Δθ, lies up to L Δθ / 8 off it,
on the mean two thirds of that. Half of it counts as sigma: twice its variance is that of the mean, and three cover it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.stages.track.geodesy import place_distances_m, sines_and_cosines
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Floats, Ints

# Numerics [m]: turns of points so close together are one; smaller sigmas count as none; no longer chord is looked for.
_ONE_POINT_M = 1.0
_LEAST_M = 0.02
_LONGEST_M = 2000.0
# A chord with points on it, as of a line drawn by hand and cut evenly afterwards, is no longer than this [m]: a
# straight between two switches is no chord of a curve.
_LONGEST_CUT_M = 150.0


@dataclass
class Chords:
    """How far the chords of a track lie aside: of what is asked for, not of a whole network, and each once.

    `here`, `there`: oriented elements, each with one that follows it. It follows from the shape alone: points on a
    chord and borders of net elements change nothing.
    """

    track: SurveyedTrack
    here: Ints
    there: Ints

    def sigmas_m(self, vertex: Ints) -> Floats:
        """Sigma of the distance between chord and curve [m] for the segments that begin at some vertices."""
        unknown = vertex[np.isnan(self._sigma_by_vertex_m[vertex])]
        for element in np.unique(np.searchsorted(self.track.first, unknown, side="right") - 1).tolist():
            if np.isnan(self._sigma_by_vertex_m[self.track.first[element]]):
                self._measure_chain(_chain_through(element, self._straight_neighbours))
        return self._sigma_by_vertex_m[vertex]

    @cached_property
    def largest_sigma_m(self) -> float:
        """A bound [m] of all sigmas of the track: of a chord as long as they get, with half a turn."""
        step_m = place_distances_m(self.track.surface)
        step_m[self.track.first[1:-1] - 1] = 0.0
        return float(_LONGEST_M + step_m.max()) * np.pi / 16.0

    @cached_property
    def _sigma_by_vertex_m(self) -> Floats:
        """Sigmas worked out so far, by vertex [m]; NaN where none is yet."""
        return np.full(len(self.track.measure_m), np.nan)

    @cached_property
    def _straightest_successors(self) -> tuple[Ints, Floats]:
        """The successor that each oriented element goes on to with the least turn, and that turn; -1 without one."""
        first = self.track.first[:-1]
        last = self.track.first[1:] - 2
        _, first_rad = _segment_lengths_and_headings(self.track, first)
        _, last_rad = _segment_lengths_and_headings(self.track, last)
        enter_rad = np.column_stack([first_rad[:, 0], last_rad[:, 1] + np.pi]).ravel()
        leave_rad = np.column_stack([last_rad[:, 1], first_rad[:, 0] + np.pi]).ravel()
        return _least_turns(leave_rad, enter_rad, self.here, self.there)

    @cached_property
    def _straight_neighbours(self) -> Ints:
        """The straightest successor of each oriented element, if it is its straightest predecessor too."""
        onward, _ = self._straightest_successors
        # `oriented ^ 1` is the same element run in the other direction.
        back = onward[onward ^ 1] == np.arange(len(onward)) ^ 1
        return np.where((onward >= 0) & back, onward, -1)

    def _measure_chain(self, chain: list[int]) -> None:
        """Work out the segments of a chain of elements."""
        vertex, against = _segment_vertices(self.track, chain)
        length_m, heading_rad = _segment_lengths_and_headings(self.track, vertex)
        row = np.arange(len(vertex))
        begin_rad = heading_rad[row, against] + np.pi * against
        end_rad = heading_rad[row, 1 - against] + np.pi * against
        inner_rad = _wrap_angle(begin_rad[1:] - end_rad[:-1])
        # A chain ends at a switch whose other branch is straighter: the turn there is the switch's, not the track's.
        turn_rad = np.concatenate([[0.0], inner_rad, [0.0]])
        self._sigma_by_vertex_m[vertex] = _chord_sigmas_m(np.append(0.0, np.cumsum(length_m)), turn_rad)


def _segment_lengths_and_headings(track: SurveyedTrack, vertex: Ints) -> tuple[Floats, Floats]:
    """Length [m] of the segment that begins at each vertex, and its heading [rad] at its start and at its end."""
    along = track.surface[vertex + 1] - track.surface[vertex]
    x_m, y_m, z_m = along.T
    headings = []
    for viewpoint in (vertex, vertex + 1):
        sin_lat, cos_lat, sin_lon, cos_lon = sines_and_cosines(
            track.latitude_deg[viewpoint], track.longitude_deg[viewpoint]
        )
        # The segment on the unit vectors east and north there (`geodesy.points_of`).
        east_m = x_m * -sin_lon + y_m * cos_lon
        north_m = x_m * (-sin_lat * cos_lon) + y_m * (-sin_lat * sin_lon) + z_m * cos_lat
        headings.append(np.arctan2(east_m, north_m))
    return np.linalg.norm(along, axis=1), np.column_stack(headings)


def _least_turns(leave_rad: Floats, enter_rad: Floats, here: Ints, there: Ints) -> tuple[Ints, Floats]:
    """Successor of each oriented element with the least turn, -1 without one, and that turn [rad].

    `leave_rad`, `enter_rad`: heading at the exit and the entry of each; `here`, `there`: pairs of successors.
    """
    # Sorted by element, then by turn: the first row of each element is its straightest successor.
    turns_rad = _wrap_angle(enter_rad[there] - leave_rad[here])
    order = np.lexsort((np.abs(turns_rad), here))
    least = order[np.diff(here[order], prepend=-1) > 0]
    onward = np.full(len(leave_rad), -1)
    turn_rad = np.zeros(len(leave_rad))
    onward[here[least]] = there[least]
    turn_rad[here[least]] = turns_rad[least]
    return onward, turn_rad


def _chain_through(element: int, after: Ints) -> list[int]:
    """Oriented elements of which each goes straight on from the one before: the same whichever of them is asked for."""
    return _straight_chain(2 * min(oriented // 2 for oriented in _straight_chain(2 * element, after)), after)


def _straight_chain(start: int, after: Ints) -> list[int]:
    """Oriented elements that go straight on through `start`, in order; a ring ends with `start`."""
    first = start
    while (before := int(after[first ^ 1])) not in (-1, start ^ 1):
        first = before ^ 1
    chain = [first]
    while (onward := int(after[chain[-1]])) not in (-1, first):
        chain.append(onward)
    return chain


def _segment_vertices(track: SurveyedTrack, chain: Sequence[int]) -> tuple[Ints, Ints]:
    """Vertices at which the segments of a chain begin, and whether they are run against their measure (0 or 1)."""
    parts = []
    for oriented in chain:
        part = np.arange(track.first[oriented // 2], track.first[oriented // 2 + 1] - 1)
        parts.append(part[::-1] if oriented % 2 else part)
    return np.concatenate(parts), np.repeat(np.array(chain) % 2, [len(part) for part in parts])


def _chord_sigmas_m(distance_m: Floats, turn_rad: Floats) -> Floats:
    """Largest sigma of all chords that each segment between points of a chain may be a part of [m].

    A chord spans 1, 2, ... `points` segments. Its turn is the geometric mean of the turns at its ends (0 with a
    straight at one of them) less the turn within it. Where the chain ends, with the survey or at a switch, its turn is
    unknown: the points there are as far apart as beyond, and so it counts as that of the curve that begins there.
    """
    bend_rad = _turn_about(distance_m, turn_rad)
    ends_rad = _turn_at_begin(distance_m, bend_rad), _turn_at_begin(distance_m[-1] - distance_m[::-1], bend_rad[::-1])
    bend_rad[[0, -1]] = np.maximum(bend_rad[[0, -1]], ends_rad)
    inside_rad = np.cumsum(np.abs(turn_rad))
    last = len(distance_m) - 1
    out = np.zeros(last)
    begin = np.arange(last)
    points = 0
    while len(begin):
        points += 1
        end = begin + points
        length_m = distance_m[end] - distance_m[begin]
        turn = np.sqrt(bend_rad[begin] * bend_rad[end]) - (inside_rad[end - 1] - inside_rad[begin])
        sigma_m = length_m * np.minimum(turn, np.pi) / 16.0
        if points > 1:
            sigma_m = np.where(length_m <= _LONGEST_CUT_M, sigma_m, 0.0)
        for row in np.flatnonzero(sigma_m > _LEAST_M).tolist():
            chord = slice(int(begin[row]), int(end[row]))
            out[chord] = np.maximum(out[chord], sigma_m[row])
        sharpest = np.sqrt(bend_rad[begin] * bend_rad.max())
        longer = (end < last) & (sharpest > inside_rad[end] - inside_rad[begin]) & (length_m < _LONGEST_CUT_M)
        begin = begin[longer & (sharpest * _LONGEST_M / 8.0 > _LEAST_M)]
    return out


def _turn_about(distance_m: Floats, turn_rad: Floats) -> Floats:
    """Turn at each point together with those within `_ONE_POINT_M` of it [rad]."""
    turned = np.cumsum(np.append(0.0, turn_rad))
    low = np.searchsorted(distance_m, distance_m - _ONE_POINT_M)
    high = np.searchsorted(distance_m, distance_m + _ONE_POINT_M, side="right")
    return np.asarray(np.abs(turned[high] - turned[low]))


def _turn_at_begin(distance_m: Floats, bend_rad: Floats) -> float:
    """Turn [rad] at the first point of a chain, by those after it.

    A point turns by half of the arc before it and half of that after it; the arc after it has the curvature of the next
    point. What is left is of the chord before, twice over, and no more than the point's own: nothing where a straight
    leads to a curve. A curve at a switch is no longer than a chord with points on it may be.
    """
    # Smaller turns are none: points on a chord.
    turns = np.flatnonzero(bend_rad[1:-1] > 16.0 * _LEAST_M / _LONGEST_CUT_M)[:3] + 1
    if not turns.size or distance_m[turns[0]] > _LONGEST_CUT_M:
        return 0.0
    own_rad = float(bend_rad[turns[0]])
    if turns.size < 2:
        return own_rad
    next_m, after_m = np.diff(distance_m[[*turns, -1][:3]])
    arc_rad = float(bend_rad[turns[1]] * next_m / (next_m + after_m))
    return min(own_rad, max(2.0 * (own_rad - arc_rad), 0.0))


def _wrap_angle(angle_rad: Floats) -> Floats:
    """Angle between -π and π."""
    return np.asarray((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)
