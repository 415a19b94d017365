"""Chains of oriented net elements with one coordinate, the search for them, and the path of a run."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.stages.track.geodesy import Points
from pipeline.stages.track.segments import Feet, Leg, nearest_on_leg, path_at, segments_at, unknown_feet
from pipeline.stages.track.survey import MEASURE_TOLERANCE_M, SurveyedTrack
from schemas.arrays import Bools, Floats, Ints, floats
from schemas.enums import BaliseDirection, BaliseKind
from schemas.frozen import frozen

if TYPE_CHECKING:
    from pipeline.stages.track.network import Edge, Network


# Only the order of the search: longer than any allowed route between two steps, so that an allowed one is found first.
BARRED_DETOUR_M = 10_000.0


@frozen
class Chain:
    """Oriented net elements in order, and the coordinate [m] at which each is entered.

    Elements are numbered on from `low`: their numbers stay while the chain grows at both ends, and go on over chains
    that share an element. `shared`: the number of the one in common with the chain before, none where there is none.
    """

    oriented: tuple[int, ...]
    entry_m: tuple[float, ...]
    low: int = 0
    shared: int | None = None

    @classmethod
    def ending_at_zero(cls, network: Network, oriented: int) -> Chain:
        """One element whose exit is at 0."""
        return cls((oriented,), (-network.length_m(oriented),))

    @property
    def last_number(self) -> int:
        """Number of its last element."""
        return self.low + len(self.oriented) - 1

    @property
    def inner_elements(self) -> tuple[int, ...]:
        """Its elements but for the first and the last."""
        return self.oriented[1:-1]

    def exit_m(self, network: Network) -> float:
        """Coordinate at which the last element is left [m]."""
        return self.entry_m[-1] + network.length_m(self.oriented[-1])

    def extended_by(self, network: Network, edge: Edge) -> Chain:
        """The chain carried on over a relation from its last element."""
        entry_m = self.exit_m(network) + edge.gap_m
        return Chain((*self.oriented, edge.to), (*self.entry_m, entry_m), self.low, self.shared)

    def preceded_by(self, network: Network, oriented: int) -> Chain:
        """The chain with an element before its first, that leads to it."""
        entry_m = self.entry_m[0] - network.edge(oriented, self.oriented[0]).gap_m - network.length_m(oriented)
        return Chain((oriented, *self.oriented), (entry_m, *self.entry_m), self.low - 1, self.shared)

    def part_between(self, first: int, last: int, shared: int) -> Chain:
        """Its elements of some numbers, as the beginning of a chain after this one."""
        inside = slice(first - self.low, last - self.low + 1)
        return Chain(self.oriented[inside], self.entry_m[inside], first, shared)

    def in_other_direction(self, network: Network) -> Chain:
        """The same elements run in the other direction; coordinate and numbers change their signs."""
        pairs = zip(self.oriented, self.entry_m, strict=True)
        entry_m = [-(entry_m + network.length_m(oriented)) for oriented, entry_m in pairs]
        around = tuple(oriented ^ 1 for oriented in reversed(self.oriented))
        return Chain(around, tuple(reversed(entry_m)), -self.last_number, None if self.shared is None else -self.shared)

    def as_route(self, network: Network, numbers: dict[str, int] | None = None) -> RoutePath:
        """The chain as arrays.

        `numbers`: net elements as the caller counts them, where the network has them in pieces.
        """
        oriented = np.array(self.oriented, dtype=np.int64)
        element = oriented // 2
        track = network.track
        numbered = element if numbers is None else np.array([numbers[track.ids[number]] for number in element.tolist()])
        return RoutePath(
            element=numbered,
            forward=oriented % 2 == 0,
            entry_m=np.array(self.entry_m),
            low_m=track.begin_m[element],
            high_m=track.end_m[element],
        )


def move_along(chains: list[Chain], network: Network, at: int, oriented: int, sense: int) -> int:
    """The number of the element on the last chain that a train comes to from number `at`, ahead (+1) or behind (-1).

    The chain grows at its ends; where the train, having turned, takes another branch than that which it came from, a
    new chain begins: the element that it is on and what lies behind it, then the branch taken now.
    """
    chain = chains[-1]
    number = at + sense
    inside = chain.low <= number <= chain.last_number
    if inside and chain.oriented[number - chain.low] == oriented:
        return number
    if inside:
        chain = chain.part_between(chain.low, at, at) if sense > 0 else chain.part_between(at, chain.last_number, at)
        chains.append(chain)
    last = chain.oriented[-1]
    chains[-1] = (
        chain.extended_by(network, network.edge(last, oriented)) if sense > 0 else chain.preceded_by(network, oriented)
    )
    return number


class Reach(NamedTuple):
    """A chain to an element, and over how many of its relations trains do not run, in its sense and against it."""

    chain: Chain
    barred_forward: int = 0
    barred_backward: int = 0

    @property
    def distance_m(self) -> float:
        """Coordinate at which the last element is entered [m]."""
        return self.chain.entry_m[-1]

    def extended_by(self, network: Network, edge: Edge) -> Reach:
        """Carried on over a relation."""
        barred = self.barred_forward + (not edge.forward), self.barred_backward + (not edge.backward)
        return Reach(self.chain.extended_by(network, edge), *barred)


def search_chains(
    network: Network,
    begin: Chain,
    until_m: float,
    onward: Callable[[Chain], Iterable[Edge]],
    same: Callable[[Chain], Hashable] | None = None,
) -> Iterator[Reach]:
    """The chains that carry one on, itself the first, in order of the coordinate at which the last element is entered.

    `until_m`: none is entered beyond; `onward`: the relations that a chain is carried on over; `same`: of chains that
    are the same to the caller only the first counts. A move that is not allowed counts as a long detour, so that an
    allowed route is preferred.
    """
    number = count()
    waiting = [(0.0, begin.oriented[-1], next(number), Reach(begin))]
    known: set[Hashable] = set()
    while waiting:
        found = heapq.heappop(waiting)[-1]
        if same is not None:
            if (key := same(found.chain)) in known:
                continue
            known.add(key)
        yield found
        exit_m = found.chain.exit_m(network)
        for edge in onward(found.chain):
            if exit_m + edge.gap_m <= until_m:
                further = found.extended_by(network, edge)
                barred = min(further.barred_forward, further.barred_backward)
                order_m = further.distance_m + barred * BARRED_DETOUR_M
                heapq.heappush(waiting, (order_m, edge.to, next(number), further))


Objects = npt.NDArray[np.object_]
BALISE_COLUMNS: dict[str, type[pl.DataType]] = {
    "leg": pl.Int32,
    "balise_id": pl.String,
    "kind": pl.String,
    "netelement_id": pl.String,
    "measure_m": pl.Float64,
    "path_m": pl.Float64,
    "sense": pl.Int64,
    "location_accuracy_m": pl.Float64,
    "linked": pl.Boolean,
    "link_reaction": pl.String,
    "valid_direction": pl.Int64,
}


def valid_along_measure(balises: pl.DataFrame) -> pl.Series:
    """The direction along its net element in which each balise is valid (DOMAIN section 4): +1 growing, -1 falling.

    0 both: a physical one, which every train reads, and one of a table that does not say (CONTRACT section 2).
    """
    said = "direction" in balises.columns
    directions = balises["direction"].to_list() if said else [BaliseDirection.BOTH.value] * balises.height
    kinds = balises["kind"].to_list()
    along = [
        _ALONG_MEASURE[direction] if kind == BaliseKind.VIRTUAL.value else 0
        for direction, kind in zip(directions, kinds, strict=True)
    ]
    return pl.Series(along, dtype=pl.Int64)


_ALONG_MEASURE = {BaliseDirection.AB.value: 1, BaliseDirection.BA.value: -1, BaliseDirection.BOTH.value: 0}

# Of two visits of one element the one that holds the measure comes first, however near the other is:
# an order of two costs, not a limit.
_OUTSIDE_COUNTS = 1e3


@frozen
class Place:
    """A place on the network: net element by its number in the survey, and measure [m]."""

    element: int
    measure_m: float


@frozen
class RoutePath:
    """Net elements in order with one coordinate [m]; arrays per visit.

    `forward`: the measure grows with the coordinate; `entry_m`: coordinate at which the element is entered;
    `low_m`, `high_m`: the measures that it covers.
    """

    element: Ints
    forward: Bools
    entry_m: Floats
    low_m: Floats
    high_m: Floats

    @cached_property
    def exit_m(self) -> Floats:
        """Coordinate at which each element is left [m]."""
        return self.entry_m + self.high_m - self.low_m

    def coordinates_of(self, element: Ints, measure_m: Floats, near_m: Floats) -> tuple[Floats, Ints]:
        """Coordinate [m] of places, NaN where not on the route; +1 where it grows with the measure, else -1.

        Of several visits the one nearest to `near_m` is meant: one more circuit of a ring is no error of place.
        """
        coordinate_m = np.full(element.size, np.nan)
        sense = np.zeros(element.size, dtype=np.int64)
        cost = np.full(element.size, np.inf)
        order = np.argsort(element, kind="stable")
        ends = np.searchsorted(element[order], self.element, side="right")
        begins = np.searchsorted(element[order], self.element, side="left")
        for visit in np.flatnonzero(ends > begins).tolist():
            rows = order[begins[visit] : ends[visit]]
            low = self.low_m[visit]
            high = self.high_m[visit]
            measure = measure_m[rows]
            at_m = self.entry_m[visit] + (measure - low if self.forward[visit] else high - measure)
            outside = np.maximum(np.maximum(low - measure, measure - high), 0.0)
            visit_cost = outside * _OUTSIDE_COUNTS + np.abs(at_m - near_m[rows])
            better = visit_cost < cost[rows]
            chosen = rows[better]
            cost[chosen] = visit_cost[better]
            coordinate_m[chosen] = at_m[better]
            sense[chosen] = 1 if self.forward[visit] else -1
        return coordinate_m, sense

    def locate(self, at_m: Floats) -> tuple[Ints, Floats, Ints]:
        """Element, measure [m] and its sense (+1: grows with the coordinate); beyond the ends the measure goes on."""
        visit = np.clip(np.searchsorted(self.entry_m, at_m, side="right") - 1, 0, self.entry_m.size - 1)
        since = at_m - self.entry_m[visit]
        forward = self.forward[visit]
        measure = np.where(forward, self.low_m[visit] + since, self.high_m[visit] - since)
        return self.element[visit], measure, np.where(forward, 1, -1)

    def visits_of_places(self, element: Ints, measure_m: Floats) -> tuple[Ints, Floats, Ints]:
        """All visits of some places, but for what lists round: which place, coordinate [m], sense of the measure."""
        holds = self.element[:, None] == element
        holds &= (self.low_m[:, None] - MEASURE_TOLERANCE_M <= measure_m) & (
            measure_m <= self.high_m[:, None] + MEASURE_TOLERANCE_M
        )
        visit, place = np.nonzero(holds)
        measure = measure_m[place]
        since = np.where(self.forward[visit], measure - self.low_m[visit], self.high_m[visit] - measure)
        return place, self.entry_m[visit] + since, np.where(self.forward[visit], 1, -1)

    def covers_coordinates(self, at_m: Floats) -> Bools:
        """Whether each coordinate lies on the route, not beyond its ends."""
        inside: Bools = (at_m >= self.entry_m[0]) & (at_m <= self.exit_m[-1])
        return inside


def legs_as_routes(track: SurveyedTrack, legs: Sequence[Leg]) -> list[RoutePath]:
    """Legs as routes whose coordinate is `path_m`; net elements by their numbers in the track."""
    routes = []
    for leg in legs:
        element = np.array([visit.element for visit in leg.visits])
        routes.append(
            RoutePath(
                element=element,
                forward=np.array([visit.forward for visit in leg.visits]),
                entry_m=np.array([leg.entry_m(number) for number in range(len(element))]),
                low_m=track.begin_m[element],
                high_m=track.end_m[element],
            )
        )
    return routes


@frozen
class TravelledPath:
    """The legs of a run in order of time; `path_m` is 0 at the start of the first net element."""

    track: SurveyedTrack
    legs: tuple[Leg, ...]

    def element_names(self) -> list[str]:
        """Net elements in order of growing path, leg by leg; one on both sides of a leg change stands once."""
        names: list[str] = []
        for leg in self.legs:
            for visit in leg.visits:
                name = self.track.ids[visit.element]
                if not names or names[-1] != name:
                    names.append(name)
        return names

    def locate(self, leg: npt.ArrayLike, path_m: npt.ArrayLike) -> tuple[Objects, Floats]:
        """Net element and measure [m] of path positions; beyond the path's ends the measure goes on.

        None and NaN where the position is not known.
        """
        position = np.atleast_1d(np.asarray(path_m, dtype=np.float64))
        number = np.broadcast_to(np.asarray(leg, dtype=np.int64), position.shape)
        element, measure = self.locate_index(number, position)
        return np.array([*self.track.ids, None], dtype=object)[element], measure

    def locate_index(self, leg: Ints, path_m: Floats) -> tuple[Ints, Floats]:
        """Net element and measure as `locate`, the element as its number in the track (-1: not known)."""
        element = np.full(len(path_m), -1, dtype=np.int64)
        measure = np.full(len(path_m), np.nan)
        for index, route_leg in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & np.isfinite(path_m))
            segment, fraction = segments_at(route_leg, path_m[rows])
            span = route_leg.measure_end_m[segment] - route_leg.measure_start_m[segment]
            element[rows] = np.array([visit.element for visit in route_leg.visits])[route_leg.visit[segment]]
            measure[rows] = route_leg.measure_start_m[segment] + fraction * span
        return element, measure

    def nearest_feet(self, points: Points, leg: Ints, known: Bools, near_path_m: Floats | None = None) -> Feet:
        """The nearest place of each known point on its leg.

        `near_path_m` tells passages of the same place apart; it never moves a point that has only one, so jumps stay.
        """
        feet = unknown_feet(len(points))
        for index, route_leg in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & known)
            near = None if near_path_m is None else near_path_m[rows]
            feet.put(rows, nearest_on_leg(points.take(rows), route_leg, near))
        return feet

    def path_positions(self, leg: Ints, feet: Feet, height_m: Floats) -> tuple[Floats, Floats]:
        """Feet on the legs as path positions, and heights over the track [m]; NaN where not known."""
        path_m, vertical_m = np.full((2, len(leg)), np.nan)
        for index, route_leg in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & np.isfinite(feet.fraction))
            part = feet.take(rows)
            rise = route_leg.height_end_m[part.segment] - route_leg.height_start_m[part.segment]
            path_m[rows] = path_at(route_leg, part)
            vertical_m[rows] = height_m[rows] - route_leg.height_start_m[part.segment] - part.fraction * rise
        return path_m, vertical_m

    def routes_by_leg(self, numbers: dict[str, int]) -> list[RoutePath]:
        """The legs as routes whose coordinate is `path_m`; `numbers`: net elements as the caller counts them."""
        number = np.array([numbers[name] for name in self.track.ids], dtype=np.int64)
        return [replace(route, element=number[route.element]) for route in legs_as_routes(self.track, self.legs)]

    def balises_on_path(self, balises: pl.DataFrame | None) -> pl.DataFrame:
        """Balises on the path with path position and `sense` (of the measure along it), in order of leg and position.

        `valid_direction`: the direction of travel along growing path in which a virtual one is valid, +1 or -1; 0 both.
        A place that two legs share is given on each of them, for a train may pass it on each; an element passed
        twice on one leg gives its balises twice. A balise off its element is on no path (the site's findings
        name it).
        """
        if balises is None:
            return pl.DataFrame(schema=BALISE_COLUMNS)
        element = np.array([self.track.index.get(name, -1) for name in balises["netelement_id"]], dtype=np.int64)
        valid = valid_along_measure(balises).to_numpy()
        parts = []
        for leg, route in enumerate(self.routes_by_leg(self.track.index)):
            place, path_m, sense = route.visits_of_places(element, floats(balises, "measure_m"))
            columns = {"path_m": path_m, "sense": sense, "valid_direction": valid[place] * sense}
            parts.append(balises[place].with_columns(leg=pl.lit(leg), **columns))
        whole = pl.concat(parts).select(pl.col(name).cast(kind) for name, kind in BALISE_COLUMNS.items())
        # Where two pieces of an element meet they share a place.
        once = whole.unique(["leg", "balise_id", pl.col("path_m").round(3)], keep="first", maintain_order=True)
        return once.sort("leg", "path_m", "balise_id")
