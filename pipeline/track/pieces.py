"""Elements that turn round, in pieces that do not, so that no place is near two places of one piece.

A balloon loop whose ends join the same switch, a ring, a ramp that crosses itself, a road up and down beside itself:
the nearest place on the whole element may be the wrong one of two, that on a piece never is.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from pipeline.track.geodesy import points_of
from pipeline.track.survey import Track
from schemas.arrays import Ints

# An element's direction is taken over so much of it [m]: single vertices may lie a centimetre apart.
_DIRECTION_OVER_M = 10.0


def in_pieces(track: Track) -> Track:
    """The track with its elements in pieces, each of its element's name and measures, in order."""
    pieces = pieces_of(track)
    if all(len(parts) == 1 for parts in pieces):
        return track
    return track_in_parts(track, [(element, part) for element, parts in enumerate(pieces) for part in parts])


def pieces_of(track: Track) -> list[list[slice]]:
    """Per element the vertices of its pieces in order; neighbours share one.

    A piece ends where it has turned by more than a right angle since its start.
    """
    owner, vertex = _spaced_vertices(track)
    along = np.diff(points_of(track.latitude_deg[vertex], track.longitude_deg[vertex]).surface, axis=0)
    own = owner[:-1] == owner[1:]
    start = np.searchsorted(owner, np.arange(len(track.ids)))
    turned = own & (np.einsum("ij,ij->i", along, along[np.minimum(start[owner[:-1]], len(along) - 1)]) < 0.0)
    cuts: list[list[int]] = [[] for _ in track.ids]
    for element in np.unique(owner[:-1][turned]).tolist():
        since = int(start[element])
        for number in range(since, int(np.searchsorted(owner, element, side="right")) - 1):
            if along[number] @ along[since] < 0.0:
                cuts[element].append(int(vertex[number]))
                since = number
    pieces = []
    for element, inside in enumerate(cuts):
        whole = track.vertices(element)
        ends = [whole.start, *inside, whole.stop - 1]
        pieces.append([slice(begin, end + 1) for begin, end in itertools.pairwise(ends)])
    return pieces


def _spaced_vertices(track: Track) -> tuple[Ints, Ints]:
    """Elements and vertices, the first in every so many metres."""
    owner = np.repeat(np.arange(len(track.ids)), np.diff(track.first))
    number = np.floor((track.measure_m - track.measure_m[track.first[owner]]) / _DIRECTION_OVER_M)
    kept = np.flatnonzero((np.diff(number, prepend=-1.0) != 0) | (np.diff(owner, prepend=-1) != 0))
    return owner[kept], kept


def track_in_parts(track: Track, parts: Sequence[tuple[int, slice]]) -> Track:
    """Parts of elements in the given order, as elements; `index` gives the first of each name."""
    rows = np.concatenate([np.arange(part.start, part.stop) for _, part in parts])
    names = tuple(track.ids[element] for element, _ in parts)
    return Track(
        ids=names,
        index={name: number for number, name in reversed(list(enumerate(names)))},
        first=np.concatenate([[0], np.cumsum([part.stop - part.start for _, part in parts])]),
        latitude_deg=track.latitude_deg[rows],
        longitude_deg=track.longitude_deg[rows],
        height_m=track.height_m[rows],
        measure_m=track.measure_m[rows],
        sigma_m=track.sigma_m[rows],
        length_m=np.array([track.measure_m[part.stop - 1] - track.measure_m[part.start] for _, part in parts]),
    )
