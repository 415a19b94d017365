"""The network of oriented net elements of a site: which lead on to which, and what lies within reach."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
import polars as pl

from pipeline.stages.track.chords import Chords
from pipeline.stages.track.path import Chain, Reach, search_chains
from pipeline.stages.track.segments import Visit
from pipeline.stages.track.survey import (
    SurveyedTrack,
    end_places,
    gap_lengths_m,
    in_pieces,
    pieces_of,
    track_in_parts,
    track_of,
)
from schemas.arrays import Bools, Floats, Ints, ints
from schemas.enums import Navigability
from schemas.frozen import frozen
from schemas.run import Site

Source = TypeVar("Source")
Made = TypeVar("Made")


class Once(Generic[Source, Made]):
    """A function of one argument, a site or a track, whose result is made once and kept as long as that argument."""

    def __init__(self, make: Callable[[Source], Made]) -> None:
        self._make = make
        self._made: WeakKeyDictionary[Source, Made] = WeakKeyDictionary()

    def __call__(self, source: Source) -> Made:
        if source not in self._made:
            self.keep(source, self._make(source))
        return self._made[source]

    def keep(self, source: Source, made: Made) -> None:
        """Keep what was made from a source already, so that it need not be made again."""
        self._made[source] = made


class Edge(NamedTuple):
    """A relation to a successor `to`, the gap between both [m], and whether trains may run it forward and backward."""

    to: int
    gap_m: float
    forward: bool
    backward: bool


@frozen
class Successors:
    """All relations to successors, as arrays: `first[e] : first[e + 1]` are those of element e."""

    first: Ints
    to: Ints
    gap_m: Floats
    forward: Bools
    backward: Bools
    _known: dict[int, tuple[Edge, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.first) - 1

    def __getitem__(self, oriented: int) -> tuple[Edge, ...]:
        """Relations of one element, kept once asked for: a run asks for few of the elements of a network."""
        known = self._known.get(oriented)
        if known is None:
            part = slice(int(self.first[oriented]), int(self.first[oriented + 1]))
            columns = (self.to, self.gap_m, self.forward, self.backward)
            known = tuple(Edge(*row) for row in zip(*(column[part].tolist() for column in columns), strict=True))
            self._known[oriented] = known
        return known

    @cached_property
    def here(self) -> Ints:
        """The oriented element that each relation leads on from."""
        return np.repeat(np.arange(len(self)), np.diff(self.first))


@dataclass
class Network:
    """Oriented elements `2 * element` (in the sense of its measure) and `2 * element + 1` (against it).

    `parts`: per oriented element the number of the part of the network that it is connected with. `usable`: one
    orientation of each such part, both where a loop turns trains round; `orientable`: no part has such a loop.
    """

    track: SurveyedTrack
    successors: Successors
    parts: Ints
    usable: Bools
    orientable: bool
    _known: dict[int, tuple[float, dict[int, Reach]]] = field(default_factory=dict)

    def unsearched(self) -> Network:
        """The same network without the results of searches: no run's answers may depend on runs before it."""
        self.chords  # noqa: B018  one for all copies: what it knows of a chain does not depend on who asked
        self.line_of_element  # noqa: B018  one for all copies too: it is a property of the network
        again = copy.copy(self)
        again._known = {}
        return again

    @cached_property
    def chords(self) -> Chords:
        """How far its chords lie off their curves."""
        return Chords(self.track, self.successors.here, self.successors.to)

    def survey_sigmas_m(self, unstated_m: float, vertex: Ints) -> Floats:
        """Sigma of the survey across the segments that begin at some vertices [m]: of its points, and of its chords.

        `unstated_m`: of points without one.
        """
        points_m = np.fmax(*(self._vertex_sigmas_m(at, unstated_m) for at in (vertex, vertex + 1)))
        return np.asarray(np.hypot(points_m, self.chords.sigmas_m(vertex)))

    def largest_survey_sigma_m(self, unstated_m: float) -> float:
        """A bound of the survey's sigma of all segments [m]; `unstated_m`: of points without one."""
        stated_m = np.fmax.reduce(self.track.sigma_m, initial=unstated_m)
        return float(np.hypot(stated_m, self.chords.largest_sigma_m))

    def _vertex_sigmas_m(self, vertex: Ints, unstated_m: float) -> Floats:
        """Survey uncertainty of vertices, or another where the survey states none [m]."""
        stated_m = self.track.sigma_m[vertex]
        return np.where(np.isfinite(stated_m), stated_m, unstated_m)

    @cached_property
    def connected_part(self) -> Ints:
        """Number of the part that each net element is connected with, whatever the direction of trains."""
        return np.asarray(self.parts.reshape(-1, 2).min(axis=1))

    @cached_property
    def line_of_element(self) -> Ints:
        """Number of the line without a branch that each net element belongs to, however it is cut."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        onward = self.successors
        alone = np.diff(onward.first) == 1
        # Two elements are one line where each is the only one that the other leads on to.
        joined = alone[onward.here] & alone[onward.to ^ 1]
        pairs = (onward.here[joined] // 2, onward.to[joined] // 2)
        size = (self.count, self.count)
        _, group = connected_components(coo_array((np.ones(len(pairs[0])), pairs), shape=size), directed=False)
        return np.asarray(group, dtype=np.int64)

    @property
    def count(self) -> int:
        """Number of net elements."""
        return len(self.track.ids)

    def length_m(self, oriented: int) -> float:
        """Length of an oriented element [m]."""
        return self._lengths_m[oriented // 2]

    @cached_property
    def _lengths_m(self) -> list[float]:
        """Length of each net element, as a list [m]."""
        lengths_m: list[float] = self.track.length_m.tolist()  # searches ask for one at a time
        return lengths_m

    def within_reach(self, oriented: int, limit_m: float) -> dict[int, Reach]:
        """The shortest chain to every element whose entry lies within `limit_m` beyond the exit of an oriented element.

        By the number of the oriented element. An element is reached from itself over a loop.
        """
        known = self._known.get(oriented)
        if known is None or known[0] < limit_m:
            limit_m = max(limit_m, MIN_REACH_M)
            begin = Chain.ending_at_zero(self, oriented)
            found = search_chains(
                self,
                begin,
                limit_m,
                lambda chain: self.successors[chain.oriented[-1]],
                lambda chain: None if chain is begin else chain.oriented[-1],
            )
            known = (limit_m, {reach.chain.oriented[-1]: reach for reach in itertools.islice(found, 1, None)})
            self._known[oriented] = known
        return known[1]

    def are_linked(self, first: int, second: int) -> bool:
        """Whether one is a direct successor of the other, in either order."""
        return any(
            edge.to == there for here, there in ((first, second), (second, first)) for edge in self.successors[here]
        )

    def edge(self, here: int, to: int) -> Edge:
        """The relation from an oriented element to a successor."""
        return next(edge for edge in self.successors[here] if edge.to == to)

    def have_successors(self) -> Bools:
        """Whether a relation leads on from each element's start and from its end; shape (elements, 2)."""
        onward = np.diff(self.successors.first) > 0
        return onward.reshape(-1, 2)[:, ::-1]


# Numerics: searches go at least so far, so that one of them answers for several. What is found farther away than asked
# competes by its length as every route does.
MIN_REACH_M = 150.0


def network_of(track: SurveyedTrack, links: pl.DataFrame) -> Network:
    """The network of a site; gaps between linked ends count as track. Pieces of one element are joined in order."""
    usable_links = links.filter(pl.col("navigability") != Navigability.NONE.value)
    element_a, position_a = _linked_ends(track, usable_links, "a")
    element_b, position_b = _linked_ends(track, usable_links, "b")
    ends = end_places(track)
    gap_m = gap_lengths_m(ends[element_a, position_a], ends[element_b, position_b])
    navigability = usable_links["navigability"].cast(pl.String)
    there = navigability.is_in([Navigability.AB.value, Navigability.BOTH.value]).to_numpy()
    back = navigability.is_in([Navigability.BA.value, Navigability.BOTH.value]).to_numpy()
    leaving = 2 * element_a + 1 - position_a
    entering = 2 * element_b + position_b
    # Piece by piece first, then each relation there and back, in their order.
    piece = np.flatnonzero(np.array([one == other for one, other in itertools.pairwise(track.ids)], dtype=np.bool_))
    joined = np.ones(2 * len(piece), dtype=np.bool_)
    onward = _successors_of(
        2 * len(track.ids),
        np.concatenate([_interleaved(2 * piece, 2 * piece + 3), _interleaved(leaving, entering ^ 1)]),
        np.concatenate([_interleaved(2 * piece + 2, 2 * piece + 1), _interleaved(entering, leaving ^ 1)]),
        np.concatenate([np.zeros(2 * len(piece)), np.repeat(gap_m, 2)]),
        np.concatenate([joined, _interleaved(there, back)]),
        np.concatenate([joined, _interleaved(back, there)]),
    )
    return _with_orientations(track, onward)


def _interleaved(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Values of two columns in turn."""
    return np.column_stack([first, second]).ravel()


def _linked_ends(track: SurveyedTrack, links: pl.DataFrame, side: str) -> tuple[Ints, Ints]:
    """Elements of one side of the links and the ends linked; of an element in pieces the first or the last one."""
    names = pl.Series(track.ids, dtype=pl.String)
    every = pl.DataFrame({"name": names, "number": np.arange(len(names))})
    numbers = every.group_by("name").agg(first=pl.col("number").min(), last=pl.col("number").max())
    linked = links.select(name=pl.col(f"netelement_{side}").cast(pl.String), end=f"position_{side}")
    both = linked.join(numbers, on="name", how="left", maintain_order="left")
    element = both.select(pl.when(pl.col("end") == 1).then("last").otherwise("first")).to_series()
    return ints(element), ints(both["end"])


def _successors_of(count: int, here: Ints, to: Ints, gap_m: Floats, forward: Bools, backward: Bools) -> Successors:
    """Relations in the order given; one given twice, or once from each side, counts once, with what either allows."""
    # `here * count + to` is one number for each pair of ends.
    _, begins, same = np.unique(here * count + to, return_index=True, return_inverse=True)
    allowed = np.zeros((2, len(begins)), dtype=np.bool_)
    np.logical_or.at(allowed[0], same, forward)
    np.logical_or.at(allowed[1], same, backward)
    order = np.lexsort((begins, here[begins]))
    first = np.searchsorted(here[begins[order]], np.arange(count + 1))
    return Successors(first, to[begins[order]], gap_m[begins[order]], allowed[0][order], allowed[1][order])


def _with_orientations(track: SurveyedTrack, onward: Successors) -> Network:
    """The network over these relations, with the orientations in use of each connected part."""
    part = connected_parts(len(onward), onward.here, onward.to)
    turned = part.reshape(-1, 2)[:, ::-1].ravel()
    # Of a part and its mirror image the one that holds the first element in the sense of its measure.
    first = np.full(len(part), len(part))
    np.minimum.at(first, part[::2], np.arange(0, len(part), 2))
    return Network(track, onward, part, first[part] <= first[turned], bool((part != turned).all()))


def connected_parts(count: int, here: Ints, there: Ints) -> Ints:
    """Number of the part that each place is connected with, which is that of its first place.

    Written out: the library for graphs takes longer to load than a run to replay.
    """
    part = np.arange(count)
    while True:
        least = np.minimum(part[here], part[there])
        if (part[here] == least).all() and (part[there] == least).all():
            return part
        # The first place of each part follows that of the neighbouring part, and then every place its first one.
        np.minimum.at(part, part[here], least)
        np.minimum.at(part, part[there], least)
        while (part[part] != part).any():
            part = part[part]


# `Site.route` names directions as the site reader writes them: from an element's start to its end, or back.
_FORWARD = "AB"


def route_visits(track: SurveyedTrack, route: pl.DataFrame) -> list[Visit]:
    """The route's elements in order, each in its sense."""
    return [
        Visit(track.index[name], direction == _FORWARD)
        for name, direction in route.select("netelement_id", "direction").iter_rows()
    ]


def network_of_route(track: SurveyedTrack, visits: list[Visit]) -> Network:
    """A network of nothing but the route, in pieces; an element passed twice is there twice, one after the other."""
    pieces = pieces_of(track)
    parts = [(visit, part) for visit in visits for part in pieces[visit.element][:: 1 if visit.forward else -1]]
    split = track_in_parts(track, [(visit.element, part) for visit, part in parts])
    usable = np.array([visit.forward == (side == 0) for visit, _ in parts for side in (0, 1)])
    along = [Visit(number, visit.forward) for number, (visit, _) in enumerate(parts)]
    onward = _onward_along_route(split, along)
    return Network(split, onward, connected_parts(len(onward), onward.here, onward.to), usable, orientable=True)


def _onward_along_route(track: SurveyedTrack, visits: Sequence[Visit]) -> Successors:
    """Successors by the relations that the route uses, and no other."""
    element = np.array([visit.element for visit in visits], dtype=np.int64)
    forward = np.array([visit.forward for visit in visits], dtype=np.int64)
    ends = end_places(track)
    gap_m = gap_lengths_m(ends[element[:-1], forward[:-1]], ends[element[1:], 1 - forward[1:]])
    oriented = 2 * element + 1 - forward
    here = _interleaved(oriented[:-1], oriented[1:] ^ 1)
    there = _interleaved(oriented[1:], oriented[:-1] ^ 1)
    both = np.ones(len(here), dtype=np.bool_)
    return _successors_of(2 * len(track.ids), here, there, np.repeat(gap_m, 2), both, both)


@Once
def surveyed_track(site: Site) -> SurveyedTrack:
    """The track of a site as arrays."""
    return track_of(site.track)


@Once
def network_in_pieces(site: Site) -> Network:
    """The network of a site, or of nothing but its route, with elements that turn round in pieces that do not."""
    track = surveyed_track(site)
    if site.route is not None:
        return network_of_route(track, route_visits(track, site.route))
    pieces = in_pieces(track)
    return site_network(site) if pieces is track else network_of(pieces, site.links)


@Once
def site_network(site: Site) -> Network:
    """The network of a site; where it gives a route, the elements of the survey with its relations alone."""
    track = surveyed_track(site)
    if site.route is None:
        return network_of(track, site.links)
    return _with_orientations(track, _onward_along_route(track, route_visits(track, site.route)))
