"""Positions as steps of a second: what the paths of a set are tested against."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.stages.track.geodesy import Points
from pipeline.stages.track.network import Edge, Network
from pipeline.stages.track.path import Chain, search_chains
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, median
from schemas.config import MatchingConfig
from schemas.frozen import frozen

# Steps on each side with which one is compared before it counts.
_NEIGHBOURS = 3
# The usual time between steps is that of so many before.
_PERIOD_STEPS = 31
# The direction of travel is that over so many steps before.
_HEADING_STEPS = 5


@frozen
class PathSteps:
    """Means of a second of positions, shapes (n,); `points` (n, 3).

    `t_ns`: mean time; `begin_s`, `end_s`: of its first and last position, since `start_ns`, the first of all; `sigma_m`
    of the position across; `distance_m`: since the step before, the larger of odometer and positions; `counted`: it
    moved by a metre, and is no outlier; `along_m`: position along the track minus an independent odometer, NaN without
    one; `with_odometer`: some odometer has measured a distance by then; `read_element`: element of a balise read then,
    else -1.
    """

    t_ns: Ints
    start_ns: int
    begin_s: Floats
    end_s: Floats
    points: Points
    sigma_m: Floats
    distance_m: Floats
    counted: Bools
    along_m: Floats
    with_odometer: Bools
    read_element: Ints

    def __len__(self) -> int:
        return len(self.end_s)

    @property
    def begin_ns(self) -> Ints:
        """Instant of the first position of each step [ns]."""
        return np.round(self.begin_s * NS_PER_S).astype(np.int64) + self.start_ns

    @cached_property
    def period_s(self) -> Floats:
        """Usual time from one to the next, a second at least: median of the last half minute of steps [s].

        Of those before alone: what feeds detection knows nothing of later ones.
        """
        since_s = np.diff(self.end_s)
        period_s = np.ones(len(self.end_s))
        for step in range(1, min(_PERIOD_STEPS, len(period_s))):
            period_s[step] = median(since_s[:step])
        if since_s.size >= _PERIOD_STEPS:
            period_s[_PERIOD_STEPS:] = np.median(sliding_window_view(since_s, _PERIOD_STEPS), axis=1)
        return np.maximum(period_s, 1.0)


def path_steps(
    t_ns: Ints,
    points: Points,
    sigma_m: Floats,
    distance: Callable[[Ints, Ints], Floats] | None = None,
    independent: bool = False,
    read_elements: Ints | None = None,
) -> PathSteps:
    """Means of a second of positions, in order of time; slower logs: single positions.

    Args:
        t_ns: times of the positions [ns], shape (n,).
        points: the positions, shape (n, 3).
        sigma_m: standard deviation of each across the track [m], shape (n,).
        distance: signed distance between instants [ns] by an odometer [m], NaN where unknown; None without one.
        independent: the odometer is not made of the positions.
        read_elements: net element of the balise read at each position, else -1, shape (n,).

    Returns:
        One step a second, arrays of shape (steps,).

    Source:
        DOMAIN section 2, rule 1.
    """
    t_s = (t_ns - t_ns[0]) / NS_PER_S if t_ns.size else np.zeros(0)
    second = np.floor(t_s + 1e-6).astype(np.int64)
    # The first position of each second, and the number of them.
    first = np.flatnonzero(np.diff(second, prepend=-1))
    size = np.diff(first, append=t_ns.size)

    def mean(values: Floats) -> Floats:
        """Means over the positions of each second, shape (n, ...) to (steps, ...)."""
        return np.asarray(np.add.reduceat(values, first, axis=0).T / size).T

    means = Points(*(mean(vectors) for vectors in (points.surface, points.east, points.north)))
    chord_m = np.linalg.norm(np.diff(means.surface, axis=0, prepend=means.surface[:1]), axis=1)
    counted_m = np.full(len(means), np.nan)
    start_ns = int(t_ns[0]) if t_ns.size else 0
    middle_ns = np.round(mean(t_s) * NS_PER_S).astype(np.int64) + start_ns
    if distance is not None:
        counted_m[1:] = distance(middle_ns[:-1], middle_ns[1:])
    known = np.isfinite(counted_m)
    moved_m = np.where(known, np.abs(counted_m), chord_m)
    mean_sigma_m = np.sqrt(mean(sigma_m**2))
    counted = np.diff(np.floor(np.cumsum(moved_m)), prepend=-1.0) > 0
    read_element = np.full(len(means), -1, dtype=np.int64)
    if read_elements is not None:
        read = np.flatnonzero(read_elements >= 0)
        read_element[np.searchsorted(first, read, side="right") - 1] = read_elements[read]
    return PathSteps(
        t_ns=middle_ns,
        start_ns=start_ns,
        begin_s=t_s[first],
        end_s=t_s[first + size - 1],
        points=means,
        sigma_m=mean_sigma_m,
        distance_m=np.where(known, np.maximum(moved_m, chord_m), chord_m),
        counted=counted & ~are_outliers(means, mean_sigma_m),
        along_m=_odometer_offset_m(means, counted_m) if independent else np.full(len(means), np.nan),
        with_odometer=np.logical_or.accumulate(known),
        read_element=read_element,
    )


def are_outliers(points: Points, sigma_m: Floats) -> Bools:
    """Steps far from the middle of their neighbours: reflections follow no model of errors."""
    count = len(points)
    reach = _NEIGHBOURS
    if count <= 2 * reach:
        return np.zeros(count, dtype=np.bool_)
    # Midpoints of the neighbours k steps before and after: on a line at even speed all of them are the step's place.
    around = sliding_window_view(points.surface, 2 * reach + 1, axis=0)
    middles = [0.5 * (around[:, :, reach - k] + around[:, :, reach + k]) for k in range(1, reach + 1)]
    middle = np.median(np.stack(middles), axis=0)
    far = np.zeros(count, dtype=np.bool_)
    away_m = np.linalg.norm(points.surface[reach:-reach] - middle, axis=1)
    far[reach:-reach] = away_m > 4.0 * sigma_m[reach:-reach] + 3.0
    return far


def _odometer_offset_m(points: Points, counted_m: Floats) -> Floats:
    """Position along the direction of travel minus an independent odometer [m]; NaN where it does not count."""
    if len(points) < _HEADING_STEPS:
        return np.full(len(points), np.nan)
    surface = points.surface
    rows = np.arange(len(points))
    # The direction of travel, by positions before: the same for every path.
    ahead = surface - surface[np.maximum(rows - _HEADING_STEPS, 0)]
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-6)
    moved_m = np.einsum("ij,ij->i", np.diff(surface, axis=0, prepend=surface[:1]), ahead)
    apart_m = np.where(np.isfinite(counted_m), moved_m - np.abs(counted_m), 0.0)
    return np.where(np.isfinite(counted_m), np.cumsum(apart_m), np.nan)


# Routes that are searched for are longer than the distance by so many of its sigmas (`detour_share`, `detour_m`).
_MARGIN_SIGMAS = 10.0


class Move(NamedTuple):
    """The elements between two places, in order of travel, and how the first is left.

    `sense`: +1 ahead, -1 behind, 0 not at all.
    """

    between: tuple[int, ...]
    sense: int


class StepDistance(NamedTuple):
    """Distance between two steps [m]: signed in the odometer's sense where `measured`, else its size.

    `limit_m`: how far routes are searched for [m].
    """

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
    """What it costs to move between places on the network, by odometer or positions.

    `counted_m`: signed distance at each step by an odometer, NaN where unknown; `doubt_m`: running sum of its doubt.
    Distances compare where nothing of them came into doubt between. `polarity`: its sign against each oriented element,
    0 where unknown.
    """

    network: Network
    steps: PathSteps
    counted_m: Floats
    doubt_m: Floats
    polarity: Ints
    config: MatchingConfig

    @classmethod
    def without_odometer(cls, network: Network, steps: PathSteps, config: MatchingConfig) -> Moves:
        """Moves whose length only the positions show."""
        count = len(steps)
        unknown = np.zeros(len(network.successors), dtype=np.int64)
        return cls(network, steps, np.full(count, np.nan), np.zeros(count), unknown, config)

    def distance(self, earlier: int, later: int) -> StepDistance:
        """Distance between two steps, by the odometer where it knows it, else straight on."""
        places = self.steps.points.surface
        chord_m = float(np.linalg.norm(places[later] - places[earlier]))
        counted_m = float("nan")
        if self._doubts_m[later] == self._doubts_m[earlier]:
            counted_m = self._counted_list_m[later] - self._counted_list_m[earlier]
        measured = bool(np.isfinite(counted_m))
        distance_m = counted_m if measured else chord_m
        limit_m = (1.0 + self.config.detour_share) * max(chord_m, abs(distance_m)) + self.config.detour_m
        return StepDistance(distance_m, measured, limit_m)

    def least_cost(self, here: Place, there: Place, distance: StepDistance) -> float:
        """The least cost of a move between two places, infinite where the network has none."""
        return min((cost for cost, _, _ in self._possible_moves(here, there, distance)), default=np.inf)

    def best_move(self, here: Place, there: Place) -> Move | None:
        """The move of least cost between two places; None where the network has none."""
        moves = self._possible_moves(here, there, self.distance(here.step, there.step))
        chosen = min(moves, key=lambda move: move[0], default=None)
        if chosen is None:
            return None
        _, sense, between = chosen
        return Move(between[::-1] if sense < 0 else between, sense)

    @property
    def break_cost(self) -> float:
        """Cost of going over to a track that no relation leads to: that of `break_s` of positions off the path."""
        return self.config.break_s * self.config.outlier_sigmas**2

    def _possible_moves(
        self, here: Place, there: Place, distance: StepDistance
    ) -> Iterator[tuple[float, int, tuple[int, ...]]]:
        """Cost, sense and elements between, of every move from one place to another: on the element, ahead, behind.

        A relation that is passed against its navigability costs as much as a break.
        """
        if here.oriented == there.oriented:
            yield self._mismatch_cost(there.at_m - here.at_m, here.oriented, distance), 0, ()
        for sense, first, last in ((1, here, there), (-1, there, here)):
            # From the exit of the first to the entry of the last, both run in the sense of their elements.
            found = self.network.within_reach(first.oriented, distance.limit_m).get(last.oriented)
            if found is None:
                continue
            ends_m = self.network.length_m(first.oriented) - first.at_m + last.at_m
            driven_m = sense * (ends_m + found.distance_m)
            cost = self._mismatch_cost(driven_m, here.oriented, distance)
            barred = found.barred_forward if sense > 0 else found.barred_backward
            yield cost + (self.break_cost if barred else 0.0), sense, found.chain.inner_elements
            if cost > 1.0 and distance.measured and abs(driven_m) < abs(distance.distance_m):
                # Another route may be as long as the odometer says.
                for chain in self._longer_routes(first.oriented, last.oriented, sense, distance.limit_m - ends_m):
                    driven_m = sense * (ends_m + chain.entry_m[-1])
                    yield self._mismatch_cost(driven_m, here.oriented, distance), sense, chain.inner_elements

    def _longer_routes(self, first: int, last: int, sense: int, limit_m: float) -> Iterator[Chain]:
        """Routes, but for the shortest, from the exit of one element to the entry of another.

        Of equally long ones the first.
        """
        apart_m = self.config.detour_m / _MARGIN_SIGMAS
        found = search_chains(
            self.network,
            Chain.ending_at_zero(self.network, first),
            limit_m,
            lambda chain: self._navigable_edges(chain, sense),
            lambda chain: (len(chain.oriented) > 1, chain.oriented[-1], round(chain.entry_m[-1] / apart_m)),
        )
        return (reach.chain for reach in islice(found, 1, None) if reach.chain.oriented[-1] == last)

    def _navigable_edges(self, chain: Chain, sense: int) -> Iterator[Edge]:
        """Relations that lead on from a chain, navigable in one sense."""
        onward = self.network.successors[chain.oriented[-1]]
        return (edge for edge in onward if (edge.forward if sense > 0 else edge.backward))

    def _mismatch_cost(self, driven_m: float, oriented: int, distance: StepDistance) -> float:
        """Square of the difference from the distance run over its sigma, limited as that of every position."""
        sign = int(self.polarity[oriented]) if distance.measured else 0
        apart_m = driven_m - sign * distance.distance_m if sign else abs(driven_m) - abs(distance.distance_m)
        root_m = (self.config.detour_share * abs(distance.distance_m) + self.config.detour_m) / _MARGIN_SIGMAS
        return min((apart_m / root_m) ** 2, self.config.outlier_sigmas**2)

    @cached_property
    def _counted_list_m(self) -> list[float]:
        """Counted distance at each step, as a list [m]."""
        return [float(value) for value in self.counted_m]

    @cached_property
    def _doubts_m(self) -> list[float]:
        """Uncertainty of the counted distance at each step, as a list [m]."""
        return [float(value) for value in self.doubt_m]
