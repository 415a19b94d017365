"""Moves of a train over the network from one sample of the reference to the next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from pipeline.stages.reference.visits import Transition
from pipeline.stages.track.network import MIN_REACH_M, Network

_Entered = tuple[int, float, tuple[int, ...]]
"""An oriented element, how far beyond an end it is entered [m], and over which elements."""


class Moves:
    """Remembers how far it has looked beyond each end."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.known: dict[int, tuple[float, list[_Entered]]] = {}

    def onward(
        self, start: int, here: Mapping[int, float], there: Mapping[int, float], limit_m: float
    ) -> Iterator[Transition]:
        """From an oriented element to those near the next sample, forward or back, no farther than the limit.

        `here`, `there`: net elements near both samples, with the measures there.
        """
        element = start // 2
        along_m = self.network.track.along_m
        if element in there and abs(there[element] - here[element]) <= limit_m:
            yield Transition(start, start)
        for back in (0, 1):
            left_m = self.network.length_m(start) - along_m(start ^ back, here[element])
            for to, gap_m, between in self._beyond(start ^ back, limit_m - left_m) if left_m <= limit_m else ():
                if to // 2 in there and left_m + gap_m + along_m(to, there[to // 2]) <= limit_m:
                    yield Transition(start, to ^ back, tuple(oriented ^ back for oriented in between), bool(back))

    def _beyond(self, side: int, limit_m: float) -> list[_Entered]:
        """What can be entered beyond the end of an oriented element."""
        searched_m, entered = self.known.get(side, (-1.0, []))
        if searched_m < limit_m:
            searched_m = max(limit_m, MIN_REACH_M)
            entered = []
            open_ways: list[_Entered] = [(side, 0.0, ())]
            while open_ways:
                last, gone_m, between = open_ways.pop()
                for edge in self.network.successors[last]:
                    if edge.forward and gone_m + edge.gap_m <= searched_m:
                        entered.append((edge.to, gone_m + edge.gap_m, between))
                        left_m = gone_m + edge.gap_m + self.network.length_m(edge.to)
                        open_ways.append((edge.to, left_m, (*between, edge.to)))
            self.known[side] = searched_m, entered
        return entered
