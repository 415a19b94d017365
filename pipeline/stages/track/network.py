"""The track network as oriented net elements, and how far it is from one to another.

An oriented element is a net element together with the sense in which the path runs over it. Moving forward
over a net relation leads from one to its successors, reversing leads back, and a train that reverses over
a switch comes out on another predecessor. So direction of travel is no state of its own.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.track.chords import chord_sigmas_m
from pipeline.stages.track.leg import Visit
from pipeline.stages.track.survey import (
    SurveyedTrack,
    end_places,
    gaps_m,
    in_pieces,
    pieces_of,
    track_in_parts,
    track_of,
)
from schemas.arrays import Bools, Floats, Ints
from schemas.enums import Navigability
from schemas.run import Site


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

    track: SurveyedTrack
    successors: list[list[Edge]]
    usable: list[bool]
    orientable: bool
    pairs: frozenset[tuple[int, int]] = field(init=False)
    _known: dict[int, tuple[float, dict[int, Reach]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.pairs = frozenset((oriented, edge.to) for oriented, edges in enumerate(self.successors) for edge in edges)

    @cached_property
    def edges(self) -> tuple[Ints, Ints]:
        """All ways on: `to[first[one] : first[one + 1]]` are the successors of an oriented element."""
        first = np.concatenate([[0], np.cumsum([len(edges) for edges in self.successors])])
        return first, np.array([edge.to for edges in self.successors for edge in edges], dtype=np.int64)

    @cached_property
    def parts(self) -> Ints:
        """Per oriented element the number of the part of the network that it is connected with."""
        return connected_parts(self.successors)

    @cached_property
    def _chord_sigmas_m(self) -> Floats:
        return chord_sigmas_m(self.track, [[edge.to for edge in edges] for edges in self.successors])

    def survey_sigmas_m(self, unstated_m: float) -> Floats:
        """Sigma of the survey across the segment that begins at each vertex [m]: of its points, and of its chords.

        `unstated_m`: of points without one.
        """
        stated_m = np.where(np.isfinite(self.track.sigma_m), self.track.sigma_m, unstated_m)
        return np.asarray(np.hypot(np.maximum(stated_m, np.append(stated_m[1:], 0.0)), self._chord_sigmas_m))

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

    def linked(self, first: int, second: int) -> bool:
        """Whether one is a direct successor of the other, either way round."""
        return (first, second) in self.pairs or (second, first) in self.pairs

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
            _, oriented, so_far = heapq.heappop(queue)
            if oriented in settled or so_far.distance_m > limit_m:
                continue
            settled[oriented] = so_far
            through = (*so_far.between, oriented)
            onward = so_far._replace(distance_m=so_far.distance_m + self.length_m(oriented), between=through)
            self._push(queue, oriented, onward)
        return settled

    def _push(self, queue: list[tuple[float, int, Reach]], oriented: int, so_far: Reach) -> None:
        for edge in self.successors[oriented]:
            reach = Reach(
                so_far.distance_m + edge.gap_m,
                so_far.between,
                so_far.barred_forward + (not edge.forward),
                so_far.barred_backward + (not edge.backward),
            )
            barred = min(reach.barred_forward, reach.barred_backward)
            heapq.heappush(queue, (reach.distance_m + barred * BARRED_DETOUR_M, edge.to, reach))


# Numerics: searches go at least so far, so that one of them answers for several. What is found farther away than asked
# competes by its length as every way does.
MIN_REACH_M = 150.0
# Only the order of the search: longer than any allowed way between two steps, so that an allowed one is found first.
BARRED_DETOUR_M = 10_000.0


def network_of(track: SurveyedTrack, links: pl.DataFrame) -> Network:
    """The network of a site; gaps between linked ends count as track. Pieces of one element are joined in order."""
    successors: list[list[Edge]] = [[] for _ in range(2 * len(track.ids))]
    for number in range(1, len(track.ids)):
        if track.ids[number] == track.ids[number - 1]:
            successors[2 * number - 2].append(Edge(2 * number, 0.0, True, True))
            successors[2 * number + 1].append(Edge(2 * number - 1, 0.0, True, True))
    usable_links = links.filter(pl.col("navigability") != Navigability.NONE.value)
    element_a, position_a = _linked_ends(track, usable_links, "a")
    element_b, position_b = _linked_ends(track, usable_links, "b")
    ends = end_places(track)
    gap = gaps_m(ends[element_a, position_a], ends[element_b, position_b]).tolist()
    leaving = (2 * element_a + 1 - position_a).tolist()
    entering = (2 * element_b + position_b).tolist()
    for row, way in enumerate(usable_links["navigability"].cast(pl.String).to_list()):
        there = way in (Navigability.AB.value, Navigability.BOTH.value)
        back = way in (Navigability.BA.value, Navigability.BOTH.value)
        _add(successors[leaving[row]], Edge(entering[row], gap[row], there, back))
        _add(successors[entering[row] ^ 1], Edge(leaving[row] ^ 1, gap[row], back, there))
    usable, orientable = oriented_sheet(successors)
    return Network(track, successors, usable, orientable)


def _linked_ends(track: SurveyedTrack, links: pl.DataFrame, side: str) -> tuple[Ints, Ints]:
    """Elements of one side of the links and the ends linked; of an element in pieces the first or the last one."""
    last = {name: number for number, name in enumerate(track.ids)}
    position = links[f"position_{side}"].to_numpy().astype(np.int64)
    ends = zip(links[f"netelement_{side}"].to_list(), position.tolist(), strict=True)
    return np.array([(last if end else track.index)[name] for name, end in ends], dtype=np.int64), position


def _add(edges: list[Edge], edge: Edge) -> None:
    """Relations given twice, or once from each side, are one edge with what either allows."""
    for index, known in enumerate(edges):
        if known.to == edge.to:
            edges[index] = Edge(edge.to, edge.gap_m, known.forward or edge.forward, known.backward or edge.backward)
            return
    edges.append(edge)


def oriented_sheet(successors: list[list[Edge]]) -> tuple[list[bool], bool]:
    """Usable oriented elements: one orientation of each connected part, both where a loop turns trains round.

    And whether no part has such a loop (`Network.orientable`).
    """
    part = connected_parts(successors)
    turned = part.reshape(-1, 2)[:, ::-1].ravel()
    # Of a part and its mirror image the one that holds the first element in the sense of its measure.
    first = np.full(int(part.max()) + 1, len(part))
    np.minimum.at(first, part[::2], np.arange(0, len(part), 2))
    usable = first[part] <= first[turned]
    return usable.tolist(), bool((part != turned).all())


def connected_parts(successors: list[list[Edge]]) -> Ints:
    """Per oriented element the number of the part of the network that it is connected with."""
    # They take long to load, and a log needs none.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(successors)
    here = np.repeat(np.arange(count), [len(edges) for edges in successors])
    there = np.array([edge.to for edges in successors for edge in edges], dtype=np.int64)
    graph = coo_array((np.ones(len(here)), (here, there)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


# `Site.route` names directions as the site reader writes them: from an element's start to its end, or back.
_FORWARD = "AB"


def visits_of(track: SurveyedTrack, route: pl.DataFrame) -> list[Visit]:
    """The route's elements in order, each in its sense."""
    return [
        Visit(track.index[name], direction == _FORWARD)
        for name, direction in route.select("netelement_id", "direction").iter_rows()
    ]


def network_along(track: SurveyedTrack, visits: list[Visit]) -> Network:
    """A network of nothing but the route, in pieces; an element passed twice is there twice, one after the other."""
    pieces = pieces_of(track)
    parts = [(visit, part) for visit in visits for part in pieces[visit.element][:: 1 if visit.forward else -1]]
    split = track_in_parts(track, [(visit.element, part) for visit, part in parts])
    usable = [visit.forward == (side == 0) for visit, _ in parts for side in (0, 1)]
    along = [Visit(number, visit.forward) for number, (visit, _) in enumerate(parts)]
    return Network(split, _joined(split, along), usable, orientable=True)


def _joined(track: SurveyedTrack, visits: list[Visit]) -> list[list[Edge]]:
    """Successors of each oriented element by the relations that the route uses, and no other."""
    successors: list[list[Edge]] = [[] for _ in range(2 * len(track.ids))]
    ends = end_places(track)
    for here, there in itertools.pairwise(visits):
        gap = float(
            gaps_m(ends[[here.element], [int(here.forward)]], ends[[there.element], [int(not there.forward)]])[0]
        )
        leaving = 2 * here.element + (not here.forward)
        entering = 2 * there.element + (not there.forward)
        for start, end in ((leaving, entering), (entering ^ 1, leaving ^ 1)):
            if all(edge.to != end for edge in successors[start]):
                successors[start].append(Edge(end, gap, True, True))
    return successors


def network_in_pieces(site: Site) -> Network:
    """The network of a site, or of nothing but its route, with elements that turn round in pieces that do not."""
    track = track_of(site.track)
    if site.route is None:
        return network_of(in_pieces(track), site.links)
    return network_along(track, visits_of(track, site.route))


def site_network(site: Site) -> Network:
    """The network of a site; where it gives a route, the elements of the survey with its relations alone."""
    track = track_of(site.track)
    if site.route is None:
        return network_of(track, site.links)
    successors = _joined(track, visits_of(track, site.route))
    return Network(track, successors, *oriented_sheet(successors))
