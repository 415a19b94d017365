"""How a train gets from one place on the network to another, and how well that agrees with the way it made."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np

from pipeline.stages.paths.path_steps import PathSteps
from pipeline.stages.track.chain import Chain, search
from pipeline.stages.track.network import Edge, Network
from schemas.arrays import Floats, Ints
from schemas.config import MatchingConfig
from schemas.frozen import frozen

# Ways that are looked for are longer than the distance by so many of its sigmas (`detour_share`, `detour_m`).
_MARGIN_SIGMAS = 10.0


class Move(NamedTuple):
    """The elements between two places, and how the first is left.

    `sense`: +1 ahead, -1 behind, 0 not at all.
    """

    between: tuple[int, ...]
    sense: int


class Way(NamedTuple):
    """Between two steps [m]: signed in the odometer's sense where `measured`, else its size; how far to search."""

    distance_m: float
    measured: bool
    limit_m: float


class Place(NamedTuple):
    """A step, and where the train was then: oriented element, and metres from its entry."""

    step: int
    oriented: int
    at_m: float


@frozen
class Moves:
    """`counted_m`: signed distance at each step by an odometer, NaN where unknown; `doubt_m`: running sum of its doubt.

    Ways compare where nothing of the distance came into doubt between.
    `polarity`: its sign against each oriented element, 0 where unknown.
    """

    network: Network
    steps: PathSteps
    counted_m: Floats
    doubt_m: Floats
    polarity: Ints
    config: MatchingConfig

    @classmethod
    def without_odometer(cls, network: Network, steps: PathSteps, config: MatchingConfig) -> Moves:
        count = len(steps)
        unknown = np.zeros(len(network.successors), dtype=np.int64)
        return cls(network, steps, np.full(count, np.nan), np.zeros(count), unknown, config)

    def way(self, earlier: int, later: int) -> Way:
        """By the odometer where it knows it, else straight on."""
        places = self.steps.points.surface
        chord_m = float(np.linalg.norm(places[later] - places[earlier]))
        counted_m = float("nan")
        if self._doubts_m[later] == self._doubts_m[earlier]:
            counted_m = self._at_m[later] - self._at_m[earlier]
        measured = bool(np.isfinite(counted_m))
        distance_m = counted_m if measured else chord_m
        limit_m = (1.0 + self.config.detour_share) * max(chord_m, abs(distance_m)) + self.config.detour_m
        return Way(distance_m, measured, limit_m)

    def cost(self, here: Place, there: Place, way: Way) -> float:
        """The least cost of a move between two places, infinite where the network has none."""
        return min((cost for cost, _, _ in self._all(here, there, way)), default=np.inf)

    def best(self, here: Place, there: Place) -> Move | None:
        """The move of least cost, none where the network has none."""
        moves = self._all(here, there, self.way(here.step, there.step))
        chosen = min(moves, key=lambda move: move[0], default=None)
        if chosen is None:
            return None
        _, sense, between = chosen
        return Move(between[::-1] if sense < 0 else between, sense)

    @property
    def break_cost(self) -> float:
        """Of going over to a track that no relation leads to: so many seconds of positions off the path."""
        return self.config.break_s * self.config.outlier_sigmas**2

    def _all(self, here: Place, there: Place, way: Way) -> Iterator[tuple[float, int, tuple[int, ...]]]:
        """Cost and sense of every move, and what lies between: on the element, ahead, behind.

        A relation that is passed against its navigability costs as much as a break.
        """
        if here.oriented == there.oriented:
            yield self._mismatch(there.at_m - here.at_m, here.oriented, way), 0, ()
        for sense, first, last in ((1, here, there), (-1, there, here)):
            # From the exit of the first to the entry of the last, both run in the sense of their elements.
            found = self.network.reach(first.oriented, way.limit_m).get(last.oriented)
            if found is None:
                continue
            ends_m = self.network.length_m(first.oriented) - first.at_m + last.at_m
            driven_m = sense * (ends_m + found.distance_m)
            cost = self._mismatch(driven_m, here.oriented, way)
            barred = found.barred_forward if sense > 0 else found.barred_backward
            yield cost + (self.break_cost if barred else 0.0), sense, found.chain.between
            if cost > 1.0 and way.measured and abs(driven_m) < abs(way.distance_m):
                # Another way may be as long as the odometer says.
                for chain in self._longer(first.oriented, last.oriented, sense, way.limit_m - ends_m):
                    driven_m = sense * (ends_m + chain.entry_m[-1])
                    yield self._mismatch(driven_m, here.oriented, way), sense, chain.between

    def _longer(self, first: int, last: int, sense: int, limit_m: float) -> Iterator[Chain]:
        """Ways from the exit of an element to the entry of another, of those as long as each other the first found."""
        apart_m = self.config.detour_m / _MARGIN_SIGMAS
        found = search(
            self.network,
            Chain.behind(self.network, first),
            limit_m,
            lambda chain: self._allowed(chain, sense),
            lambda chain: (len(chain.oriented) > 1, chain.oriented[-1], round(chain.entry_m[-1] / apart_m)),
        )
        return (reach.chain for reach in islice(found, 1, None) if reach.chain.oriented[-1] == last)

    def _allowed(self, chain: Chain, sense: int) -> Iterator[Edge]:
        onward = self.network.successors[chain.oriented[-1]]
        return (edge for edge in onward if (edge.forward if sense > 0 else edge.backward))

    def _mismatch(self, driven_m: float, oriented: int, way: Way) -> float:
        """Square of the difference from the way made over its own sigma, limited as that of every position."""
        sign = int(self.polarity[oriented]) if way.measured else 0
        apart_m = driven_m - sign * way.distance_m if sign else abs(driven_m) - abs(way.distance_m)
        root_m = (self.config.detour_share * abs(way.distance_m) + self.config.detour_m) / _MARGIN_SIGMAS
        return min((apart_m / root_m) ** 2, self.config.outlier_sigmas**2)

    @cached_property
    def _at_m(self) -> list[float]:
        return [float(value) for value in self.counted_m]

    @cached_property
    def _doubts_m(self) -> list[float]:
        return [float(value) for value in self.doubt_m]
