"""The track network as oriented net elements, and how far it is from one to another.

An oriented element is a net element together with the sense in which the path runs over it. Moving forward
over a net relation leads from one to its successors, reversing leads back, and a train that reverses over
a switch comes out on another predecessor. So direction of travel is no state of its own.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.geodesy import Bools
from pipeline.track import Track, end_places, gap_m
from schemas.enums import Navigability


class Edge(NamedTuple):
    """A way on: successor, gap [m], and whether trains may run it forward and backward."""

    to: int
    gap_m: float
    forward: bool
    backward: bool


class Reach(NamedTuple):
    """Network distance [m] from an element's exit to another's entry, what lies between, moves not allowed."""

    distance_m: float
    between: tuple[int, ...]
    barred_forward: int
    barred_backward: int


@dataclass
class Network:
    """Oriented elements `2 * element` (in the sense of its measure) and `2 * element + 1` (against it)."""

    track: Track
    successors: list[list[Edge]]
    usable: list[bool]
    orientable: bool
    pairs: frozenset[tuple[int, int]] = field(init=False)
    _known: dict[int, tuple[float, dict[int, Reach]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.pairs = frozenset((one, edge.to) for one, edges in enumerate(self.successors) for edge in edges)

    @property
    def count(self) -> int:
        """Number of net elements."""
        return len(self.track.ids)

    def length_m(self, oriented: int) -> float:
        return float(self.track.length_m[oriented // 2])

    def reach(self, oriented: int, limit_m: float) -> dict[int, Reach]:
        """Everything whose entry lies within `limit_m` beyond the exit of an oriented element."""
        known = self._known.get(oriented)
        if known is None or known[0] < limit_m:
            limit_m = max(limit_m, MIN_REACH_M)
            known = (limit_m, self._search(oriented, limit_m))
            self._known[oriented] = known
        return known[1]

    def linked(self, one: int, other: int) -> bool:
        """Whether one is a direct successor of the other, either way round."""
        return (one, other) in self.pairs or (other, one) in self.pairs

    def linked_ends(self) -> Bools:
        """Per element, whether a relation leads on from its start and from its end."""
        onward = np.array([bool(edges) for edges in self.successors])
        return onward.reshape(-1, 2)[:, ::-1]

    def _search(self, source: int, limit_m: float) -> dict[int, Reach]:
        """Dijkstra; a move that is not allowed counts as a long detour, so an allowed way is preferred."""
        settled: dict[int, Reach] = {}
        queue: list[tuple[float, int, Reach]] = []
        self._push(queue, source, Reach(0.0, (), 0, 0))
        while queue:
            _, oriented, found = heapq.heappop(queue)
            if oriented in settled or found.distance_m > limit_m:
                continue
            settled[oriented] = found
            through = (*found.between, oriented)
            onward = found._replace(distance_m=found.distance_m + self.length_m(oriented), between=through)
            self._push(queue, oriented, onward)
        return settled

    def _push(self, queue: list[tuple[float, int, Reach]], oriented: int, found: Reach) -> None:
        for edge in self.successors[oriented]:
            reach = Reach(
                found.distance_m + edge.gap_m,
                found.between,
                found.barred_forward + (not edge.forward),
                found.barred_backward + (not edge.backward),
            )
            barred = min(reach.barred_forward, reach.barred_backward)
            heapq.heappush(queue, (reach.distance_m + barred * BARRED_DETOUR_M, edge.to, reach))


MIN_REACH_M = 150.0
BARRED_DETOUR_M = 10_000.0


def network_of(track: Track, links: pl.DataFrame) -> Network:
    """The network of a site; gaps between linked ends count as track."""
    successors: list[list[Edge]] = [[] for _ in range(2 * len(track.ids))]
    ends = end_places(track)
    for a, position_a, b, position_b, navigability in links.iter_rows():
        if navigability == Navigability.NONE.value:
            continue
        one, other = track.index[a], track.index[b]
        gap = gap_m(ends[one, int(position_a)], ends[other, int(position_b)])
        there = navigability in (Navigability.AB.value, Navigability.BOTH.value)
        back = navigability in (Navigability.BA.value, Navigability.BOTH.value)
        leaving, entering = 2 * one + (1 - int(position_a)), 2 * other + int(position_b)
        _add(successors[leaving], Edge(entering, gap, there, back))
        _add(successors[entering ^ 1], Edge(leaving ^ 1, gap, back, there))
    usable, orientable = _one_sheet(successors)
    return Network(track, successors, usable, orientable)


def _add(edges: list[Edge], edge: Edge) -> None:
    """Relations given twice, or once from each side, are one edge with what either allows."""
    for index, known in enumerate(edges):
        if known.to == edge.to:
            edges[index] = Edge(edge.to, edge.gap_m, known.forward or edge.forward, known.backward or edge.backward)
            return
    edges.append(edge)


def _one_sheet(successors: list[list[Edge]]) -> tuple[list[bool], bool]:
    """Of each connected part one orientation; both where a loop lets trains come back turned round."""
    neighbours: list[list[int]] = [[] for _ in successors]
    for one, edges in enumerate(successors):
        for edge in edges:
            neighbours[one].append(edge.to)
            neighbours[edge.to].append(one)
    usable, orientable, seen = [False] * len(successors), True, [False] * len(successors)
    for start in range(0, len(successors), 2):
        if seen[start]:
            continue
        part = _part(start, neighbours)
        turned = start ^ 1 in part
        orientable &= not turned
        for oriented in part:
            seen[oriented] = seen[oriented ^ 1] = True
            usable[oriented] = True
    return usable, orientable


def _part(start: int, neighbours: list[list[int]]) -> set[int]:
    part, queue = {start}, [start]
    while queue:
        for other in neighbours[queue.pop()]:
            if other not in part:
                part.add(other)
                queue.append(other)
    return part
