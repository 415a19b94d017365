"""Chains of net elements with one coordinate, and the chains that lead from one place to another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.track.network import Edge, Network
from pipeline.track.path import TravelledPath
from schemas.arrays import Bools, Floats, Ints

# Of two visits of one element the one that holds the measure comes first, however near the other is:
# an order of two costs, not a limit.
_OUTSIDE_COUNTS = 1e3


@dataclass(frozen=True)
class Place:
    """A place on the network: net element by its number in the survey, and measure [m]."""

    element: int
    measure_m: float


@dataclass(frozen=True)
class Route:
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
        return self.entry_m + self.high_m - self.low_m

    def coordinate(self, element: Ints, measure_m: Floats, near_m: Floats) -> tuple[Floats, Ints]:
        """Coordinate [m] of places, NaN where not on the route; +1 where it grows with the measure, else -1.

        Of several visits the one nearest to `near_m` is meant: a lap more is no error of place.
        """
        found, sense = np.full(element.size, np.nan), np.zeros(element.size, dtype=np.int64)
        cost = np.full(element.size, np.inf)
        order = np.argsort(element, kind="stable")
        ends = np.searchsorted(element[order], self.element, side="right")
        begins = np.searchsorted(element[order], self.element, side="left")
        for visit in np.flatnonzero(ends > begins).tolist():
            rows = order[begins[visit] : ends[visit]]
            low, high = self.low_m[visit], self.high_m[visit]
            measure = measure_m[rows]
            at_m = self.entry_m[visit] + (measure - low if self.forward[visit] else high - measure)
            outside = np.maximum(np.maximum(low - measure, measure - high), 0.0)
            own = outside * _OUTSIDE_COUNTS + np.abs(at_m - near_m[rows])
            better = own < cost[rows]
            chosen = rows[better]
            cost[chosen], found[chosen] = own[better], at_m[better]
            sense[chosen] = 1 if self.forward[visit] else -1
        return found, sense

    def locate(self, at_m: Floats) -> tuple[Ints, Floats, Ints]:
        """Element, measure [m] and its sense (+1: grows with the coordinate); beyond the ends the measure goes on."""
        visit = np.clip(np.searchsorted(self.entry_m, at_m, side="right") - 1, 0, self.entry_m.size - 1)
        since = at_m - self.entry_m[visit]
        forward = self.forward[visit]
        measure = np.where(forward, self.low_m[visit] + since, self.high_m[visit] - since)
        return self.element[visit], measure, np.where(forward, 1, -1)

    def covers(self, at_m: Floats) -> Bools:
        """The coordinate lies on the route, not beyond its ends."""
        inside: Bools = (at_m >= self.entry_m[0]) & (at_m <= self.exit_m[-1])
        return inside


def routes_of_path(path: TravelledPath, numbers: dict[str, int]) -> list[Route]:
    """The legs of a path as routes whose coordinate is `path_m`; `numbers`: net elements as the survey counts them."""
    routes = []
    for leg in path.legs:
        own = [visit.element for visit in leg.visits]
        measures = [path.track.measure_m[path.track.vertices(element)] for element in own]
        routes.append(
            Route(
                element=np.array([numbers[path.track.ids[element]] for element in own], dtype=np.int64),
                forward=np.array([visit.forward for visit in leg.visits]),
                entry_m=np.array([leg.entry_m(number) for number in range(len(own))]),
                low_m=np.array([float(values[0]) for values in measures]),
                high_m=np.array([float(values[-1]) for values in measures]),
            )
        )
    return routes


@dataclass(frozen=True)
class Chain:
    """Oriented net elements in order, and the coordinate [m] at which each is entered."""

    oriented: tuple[int, ...]
    entry_m: tuple[float, ...]

    def route(self, network: Network) -> Route:
        oriented = np.array(self.oriented, dtype=np.int64)
        element, track = oriented // 2, network.track
        return Route(
            element=element,
            forward=oriented % 2 == 0,
            entry_m=np.array(self.entry_m),
            low_m=track.measure_m[track.first[element]],
            high_m=track.measure_m[track.first[element + 1] - 1],
        )


def along_m(network: Network, oriented: int, measure_m: float) -> float:
    """Distance of a measure from where the oriented element is entered [m]."""
    part = network.track.measure_m[network.track.vertices(oriented // 2)]
    return float(measure_m - part[0]) if oriented % 2 == 0 else float(part[-1] - measure_m)


def chains_between(
    network: Network, start: int, begin: Place, goal: Place, lengths_m: tuple[float, float], back: bool, most: int
) -> list[Chain] | None:
    """Chains from `begin` on the oriented element `start` to `goal`, of a length between the two; `begin` is at 0.

    `back`: the train runs them from the goal to the begin. None where there are more than `most`.
    """
    shortest_m, longest_m = lengths_m
    found: list[Chain] = []
    open_chains = [Chain((start,), (-along_m(network, start, begin.measure_m),))]
    steps = 0
    while open_chains:
        chain = open_chains.pop()
        last, entry_m = chain.oriented[-1], chain.entry_m[-1]
        if last // 2 == goal.element:
            at_m = entry_m + along_m(network, last, goal.measure_m)
            if shortest_m <= at_m <= longest_m:
                found.append(chain)
        exit_m = entry_m + network.length_m(last)
        steps += 1
        if len(found) > most or steps > most**2:
            return None
        open_chains += [
            Chain((*chain.oriented, edge.to), (*chain.entry_m, exit_m + edge.gap_m))
            for edge in network.successors[last]
            if exit_m + edge.gap_m <= longest_m and (edge.backward if back else edge.forward)
        ]
    return found


def extended(network: Network, chain: Chain, least_m: float, most_m: float, most: int) -> list[Chain] | None:
    """The chain carried on over every branch until it covers the coordinates from `least_m` to `most_m`.

    Where the track ends before, it ends. None where there are more than `most` chains.
    """
    ahead = _grown(network, [chain], most_m, _onward, most)
    return None if ahead is None else _grown(network, ahead, least_m, _before, most)


_Step = Callable[[Network, Chain, float], Iterator[Chain]]


def _grown(network: Network, chains: list[Chain], until_m: float, step: _Step, most: int) -> list[Chain] | None:
    done: list[Chain] = []
    growing = list(chains)
    while growing:
        chain = growing.pop()
        further = list(step(network, chain, until_m))
        if further:
            growing += further
        else:
            done.append(chain)
        if len(done) + len(growing) > most:
            return None
    return done


def _onward(network: Network, chain: Chain, until_m: float) -> Iterator[Chain]:
    exit_m = chain.entry_m[-1] + network.length_m(chain.oriented[-1])
    if exit_m < until_m:
        for edge in _runnable(network.successors[chain.oriented[-1]]):
            yield Chain((*chain.oriented, edge.to), (*chain.entry_m, exit_m + edge.gap_m))


def _before(network: Network, chain: Chain, until_m: float) -> Iterator[Chain]:
    entry_m = chain.entry_m[0]
    if entry_m > until_m:
        for edge in _runnable(network.successors[chain.oriented[0] ^ 1]):
            here = edge.to ^ 1
            yield Chain((here, *chain.oriented), (entry_m - edge.gap_m - network.length_m(here), *chain.entry_m))


def _runnable(edges: list[Edge]) -> list[Edge]:
    return [edge for edge in edges if edge.forward or edge.backward]
