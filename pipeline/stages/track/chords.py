"""How far the chords of a survey may lie beside the curve that they stand for.

A chord of length L between two points of an arc, at each of which the line turns by Δθ, lies up to L Δθ / 8 beside it,
on the mean two thirds of that. Half of it counts as sigma: twice its variance is that of the mean, and three cover it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.stages.track.geodesy import sines
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import Floats, Ints

# Numerics [m]: turns of points so close together are one; smaller sigmas count as none; no longer chord is looked for.
_ONE_POINT_M = 1.0
_LEAST_M = 0.02
_LONGEST_M = 2000.0


def chord_sigmas_m(track: SurveyedTrack, here: Ints, there: Ints) -> Floats:
    """Sigma of the distance between chord and curve [m] for the segment that begins at each vertex.

    `here`, `there`: oriented elements, each with one that follows it. It follows from the shape alone: points on a
    chord and borders of net elements change nothing.
    """
    length_m, heading_rad = _segments(track)
    first = track.first[:-1]
    last = track.first[1:] - 2
    enter = np.column_stack([heading_rad[first, 0], heading_rad[last, 1] + np.pi]).ravel()
    leave = np.column_stack([heading_rad[last, 1], heading_rad[first, 0] + np.pi]).ravel()
    onward, onward_turn_rad = _straightest(leave, enter, here, there)
    chains = _chains(onward.tolist())
    # Points of all chains one after the other: a vertex each, and one at the end of each chain.
    vertex, against, ends = _points(track, chains)
    begin = heading_rad[vertex, against] + np.pi * against
    end = heading_rad[vertex, 1 - against] + np.pi * against
    turn_rad = _wrapped(begin - np.roll(end, 1))
    turn_rad[np.append(0, ends[:-1] + 1)] = onward_turn_rad[[chain[0] ^ 1 for chain in chains]]
    turn_rad[ends] = onward_turn_rad[[chain[-1] for chain in chains]]
    step_m = length_m[vertex]
    step_m[ends] = 3.0 * _ONE_POINT_M
    way_m = np.append(0.0, np.cumsum(step_m)[:-1])
    sigma_m = _sigmas_m(way_m, turn_rad, ends)
    out = np.zeros(len(length_m))
    inside = np.ones(len(vertex), dtype=np.bool_)
    inside[ends] = False
    out[vertex[inside]] = sigma_m[inside]
    return out


def _segments(track: SurveyedTrack) -> tuple[Floats, Floats]:
    """Length [m] of the segment that begins at each vertex, and its heading [rad] as seen from its start and end."""
    along = np.diff(track.surface, axis=0, append=track.surface[-1:])
    x_m, y_m, z_m = along.T
    sin_lat, cos_lat, sin_lon, cos_lon = sines(track.latitude_deg, track.longitude_deg)
    headings = []
    for _ in range(2):
        # As seen from a vertex: the way along its unit vectors east and north (`geodesy.points_of`).
        east_m = x_m * -sin_lon + y_m * cos_lon
        north_m = x_m * (-sin_lat * cos_lon) + y_m * (-sin_lat * sin_lon) + z_m * cos_lat
        headings.append(np.arctan2(east_m, north_m))
        sin_lat, cos_lat, sin_lon, cos_lon = (np.roll(of, -1) for of in (sin_lat, cos_lat, sin_lon, cos_lon))
    return np.linalg.norm(along, axis=1), np.column_stack(headings)


def _straightest(leave_rad: Floats, enter_rad: Floats, here: Ints, there: Ints) -> tuple[Ints, Floats]:
    """The successor that each oriented element goes on to with the least turn, and that turn; -1 without one."""
    turns_rad = _wrapped(enter_rad[there] - leave_rad[here])
    order = np.lexsort((np.abs(turns_rad), here))
    least = order[np.diff(here[order], prepend=-1) > 0]
    onward = np.full(len(leave_rad), -1)
    turn_rad = np.zeros(len(leave_rad))
    onward[here[least]] = there[least]
    turn_rad[here[least]] = turns_rad[least]
    return onward, turn_rad


def _chains(onward: Sequence[int]) -> list[list[int]]:
    """Oriented elements of which each is the straightest way on from the one before, there and back."""
    after = [to if to >= 0 and onward[to ^ 1] == oriented ^ 1 else -1 for oriented, to in enumerate(onward)]
    chains: list[list[int]] = []
    left = dict.fromkeys(range(0, len(onward), 2))
    while left:
        start = oriented = next(iter(left))
        while after[oriented ^ 1] not in (-1, start ^ 1):
            oriented = after[oriented ^ 1] ^ 1
        chain = [oriented]
        while after[chain[-1]] not in (-1, oriented):
            chain.append(after[chain[-1]])
        for member in chain:
            del left[member & ~1]
        chains.append(chain)
    return chains


def _points(track: SurveyedTrack, chains: Sequence[Sequence[int]]) -> tuple[Ints, Ints, Ints]:
    """Vertices at which the segments of chains begin, whether they are run against their measure, ends of chains."""
    oriented = np.concatenate([np.array(chain) for chain in chains])
    lengths = np.cumsum([len(chain) for chain in chains])
    element = oriented // 2
    against = oriented % 2
    counts = np.diff(track.first)[element] - 1
    counts[lengths - 1] += 1
    member = np.repeat(np.arange(len(oriented)), counts)
    number = np.arange(len(member)) - np.repeat(np.cumsum(counts) - counts, counts)
    # The last point of a chain stands for its end, at the vertex before.
    number = np.minimum(number, (np.diff(track.first)[element] - 2)[member])
    ahead = track.first[element][member] + number
    back = track.first[element + 1][member] - 2 - number
    vertex = np.where(against[member] == 1, back, ahead)
    return vertex, against[member], np.cumsum(counts)[lengths - 1] - 1


def _sigmas_m(way_m: Floats, turn_rad: Floats, ends: Ints) -> Floats:
    """Of the segment behind each point the largest sigma of all chords that it may be a part of.

    A chord spans 1, 2, ... `points` segments. Its turn is the geometric mean of the turns at its ends (0 with a
    straight at one of them) less the turn within it. At the end of the survey the turn is unknown and counts as 0.
    """
    bend_rad = _turn_about(way_m, turn_rad)
    inside_rad = np.abs(turn_rad)
    inside_rad[ends] = np.pi * _LONGEST_M  # no chord goes on from one chain to the next
    inside_rad = np.cumsum(inside_rad)
    out = np.zeros(len(way_m))
    begin = np.delete(np.arange(len(way_m)), ends)
    points = 0
    while len(begin):
        points += 1
        end = begin + points
        length_m = way_m[end] - way_m[begin]
        turn = np.sqrt(bend_rad[begin] * bend_rad[end]) - (inside_rad[end - 1] - inside_rad[begin])
        sigma_m = length_m * turn / 16.0
        for row in np.flatnonzero(sigma_m > _LEAST_M).tolist():
            chord = slice(int(begin[row]), int(end[row]))
            out[chord] = np.maximum(out[chord], sigma_m[row])
        sharpest = np.sqrt(bend_rad[begin] * bend_rad.max())
        longer = (sharpest > inside_rad[end] - inside_rad[begin]) & (length_m < _LONGEST_M)
        begin = begin[longer & (sharpest * _LONGEST_M / 8.0 > _LEAST_M)]
    return out


def _turn_about(way_m: Floats, turn_rad: Floats) -> Floats:
    """Turn at each point together with those beside it."""
    turned = np.cumsum(np.append(0.0, turn_rad))
    low = np.searchsorted(way_m, way_m - _ONE_POINT_M)
    high = np.searchsorted(way_m, way_m + _ONE_POINT_M, side="right")
    return np.asarray(np.abs(turned[high] - turned[low]))


def _wrapped(angle_rad: Floats) -> Floats:
    """Angle between -π and π."""
    return np.asarray((angle_rad + np.pi) % (2.0 * np.pi) - np.pi)
