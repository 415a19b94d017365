"""Chains of oriented net elements with one coordinate, and the one search for them."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Iterable, Iterator
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.stages.track.path import RoutePath
from schemas.frozen import frozen

if TYPE_CHECKING:
    from pipeline.stages.track.network import Edge, Network

# Only the order of the search: longer than any allowed way between two steps, so that an allowed one is found first.
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
    def behind(cls, network: Network, oriented: int) -> Chain:
        """One element whose exit is at 0."""
        return cls((oriented,), (-network.length_m(oriented),))

    @property
    def high(self) -> int:
        return self.low + len(self.oriented) - 1

    @property
    def between(self) -> tuple[int, ...]:
        """All but the first and the last."""
        return self.oriented[1:-1]

    def exit_m(self, network: Network) -> float:
        return self.entry_m[-1] + network.length_m(self.oriented[-1])

    def after(self, network: Network, edge: Edge) -> Chain:
        """The chain carried on over a way from its last element."""
        entry_m = self.exit_m(network) + edge.gap_m
        return Chain((*self.oriented, edge.to), (*self.entry_m, entry_m), self.low, self.shared)

    def before(self, network: Network, oriented: int) -> Chain:
        """The chain with an element before its first, that leads to it."""
        entry_m = self.entry_m[0] - network.way(oriented, self.oriented[0]).gap_m - network.length_m(oriented)
        return Chain((oriented, *self.oriented), (entry_m, *self.entry_m), self.low - 1, self.shared)

    def part(self, first: int, last: int, shared: int) -> Chain:
        """Its elements of some numbers, as the beginning of a chain after this one."""
        inside = slice(first - self.low, last - self.low + 1)
        return Chain(self.oriented[inside], self.entry_m[inside], first, shared)

    def turned(self, network: Network) -> Chain:
        """The same elements run the other way round; coordinate and numbers change their signs."""
        pairs = zip(self.oriented, self.entry_m, strict=True)
        entry_m = [-(entry_m + network.length_m(oriented)) for oriented, entry_m in pairs]
        around = tuple(oriented ^ 1 for oriented in reversed(self.oriented))
        return Chain(around, tuple(reversed(entry_m)), -self.high, None if self.shared is None else -self.shared)

    def route(self, network: Network, numbers: dict[str, int] | None = None) -> RoutePath:
        """`numbers`: net elements as the caller counts them, where the network has them in pieces."""
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


def moved_on(chains: list[Chain], network: Network, at: int, oriented: int, sense: int) -> int:
    """The number of the element on the last chain that a train comes to from number `at`, ahead (+1) or behind (-1).

    The chain grows at its ends; where the train, having turned, takes another branch than that which it came from, a
    new chain begins: the element that it is on and what lies behind it, then the other way on.
    """
    chain = chains[-1]
    number = at + sense
    inside = chain.low <= number <= chain.high
    if inside and chain.oriented[number - chain.low] == oriented:
        return number
    if inside:
        chain = chain.part(chain.low, at, at) if sense > 0 else chain.part(at, chain.high, at)
        chains.append(chain)
    last = chain.oriented[-1]
    chains[-1] = chain.after(network, network.way(last, oriented)) if sense > 0 else chain.before(network, oriented)
    return number


class Reach(NamedTuple):
    """A chain to an element, and over how many of its relations trains do not run, in its sense and against it."""

    chain: Chain
    barred_forward: int = 0
    barred_backward: int = 0

    @property
    def distance_m(self) -> float:
        """Coordinate at which the last element is entered."""
        return self.chain.entry_m[-1]

    def after(self, network: Network, edge: Edge) -> Reach:
        barred = self.barred_forward + (not edge.forward), self.barred_backward + (not edge.backward)
        return Reach(self.chain.after(network, edge), *barred)


def search(
    network: Network,
    begin: Chain,
    until_m: float,
    onward: Callable[[Chain], Iterable[Edge]],
    same: Callable[[Chain], Hashable] | None = None,
) -> Iterator[Reach]:
    """The chains that carry one on, itself the first, in order of the coordinate at which the last element is entered.

    `until_m`: none is entered beyond; `onward`: the ways that a chain is carried on over; `same`: of chains that are
    the same to the caller only the first counts. A move that is not allowed counts as a long detour, so that an allowed
    way is preferred.
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
                further = found.after(network, edge)
                barred = min(further.barred_forward, further.barred_backward)
                order_m = further.distance_m + barred * BARRED_DETOUR_M
                heapq.heappush(waiting, (order_m, edge.to, next(number), further))
