"""Chains of oriented net elements with one coordinate, and the one search for them."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.stages.track.path import RoutePath

if TYPE_CHECKING:
    from pipeline.stages.track.network import Edge, Network

# Only the order of the search: longer than any allowed way between two steps, so that an allowed one is found first.
BARRED_DETOUR_M = 10_000.0


@dataclass(frozen=True)
class Chain:
    """Oriented net elements in order, and the coordinate [m] at which each is entered."""

    oriented: tuple[int, ...]
    entry_m: tuple[float, ...]

    @classmethod
    def behind(cls, network: Network, oriented: int) -> Chain:
        """One element whose exit is at 0."""
        return cls((oriented,), (-network.length_m(oriented),))

    @property
    def between(self) -> tuple[int, ...]:
        """All but the first and the last."""
        return self.oriented[1:-1]

    def exit_m(self, network: Network) -> float:
        return self.entry_m[-1] + network.length_m(self.oriented[-1])

    def after(self, network: Network, edge: Edge) -> Chain:
        """The chain carried on over a way from its last element."""
        return Chain((*self.oriented, edge.to), (*self.entry_m, self.exit_m(network) + edge.gap_m))

    def turned(self, network: Network) -> Chain:
        """The same elements run the other way round; the coordinate changes its sign."""
        pairs = zip(reversed(self.oriented), reversed(self.entry_m), strict=True)
        left = [(oriented ^ 1, -(entry_m + network.length_m(oriented))) for oriented, entry_m in pairs]
        return Chain(*zip(*left, strict=True))

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
