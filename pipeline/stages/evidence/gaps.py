"""Gaps between anchors: which chains of net elements the train may have run there (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from pipeline.stages.evidence.carrying import (
    SignedOdometer,
    TrueAnchor,
    carry_from_anchor,
    odometer_closes,
    odometer_confidence_m,
)
from pipeline.stages.track.network import Edge, Network
from pipeline.stages.track.path import Chain, Place, search_chains
from schemas.arrays import NS_PER_S, Ints
from schemas.config import Configuration
from schemas.frozen import frozen


@frozen
class GapChain:
    """A chain through a gap, in the sense in which the odometer counts up, with its anchors at `at_m`.

    `closed`: the odometer counted its length within its own noise.
    """

    chain: Chain
    at_m: tuple[float, ...]
    closed: bool = False

    @property
    def length_m(self) -> float:
        """Distance between its anchors, as the odometer counts up [m]."""
        return self.at_m[-1] - self.at_m[0]


@frozen
class Gap:
    """Time between two anchors, or on one side of one.

    `routes` is None where there are more than can be weighed: then nothing is said of place or track.
    """

    begin_ns: int
    end_ns: int
    begin: TrueAnchor | None
    end: TrueAnchor | None
    routes: list[GapChain] | None

    @property
    def anchors(self) -> list[TrueAnchor]:
        """Its anchors, one or two."""
        return [anchor for anchor in (self.begin, self.end) if anchor is not None]

    @property
    def closed_routes(self) -> list[GapChain]:
        """The routes whose length the odometer counted."""
        return [route for route in self.routes or [] if route.closed]

    @property
    def only_closed_route(self) -> list[GapChain]:
        """The one closed route between two anchors; nothing where routes of several lengths close."""
        lengths = {round(route.length_m, 2) for route in self.closed_routes}
        return self.closed_routes[:1] if len(lengths) == 1 and len(self.anchors) == 2 else []

    @property
    def only_length_m(self) -> list[float]:
        """The length of the routes between two anchors [m], closed by the odometer or not.

        Nothing if there are several.
        """
        lengths = {round(route.length_m, 2) for route in self.routes or []}
        return [self.routes[0].length_m] if self.routes and len(lengths) == 1 and len(self.anchors) == 2 else []

    def is_on_survey(self, network: Network) -> bool:
        """Whether its anchors are on the survey, joined by one route without a branch that the odometer closes."""
        if len(self.anchors) != 2 or len(self.closed_routes) != 1 or len(self.routes or []) != 1:
            return False
        return all(anchor.proved for anchor in self.anchors) and not _has_branch_inside(
            self.closed_routes[0].chain, network
        )

    @property
    def is_unreachable(self) -> bool:
        """Whether no train can have passed its two anchors one after the other: one of the two is wrong."""
        return len(self.anchors) == 2 and self.routes == []


@frozen
class CarriedGaps:
    """What one odometer carries from anchors, by its gaps."""

    counter: SignedOdometer
    gaps: tuple[Gap, ...]


@frozen
class GapSearch:
    """One odometer over the network, and in which direction the train ran as the odometer of the LDS counted up.

    `oriented_elements`: oriented net elements by the reference.
    """

    counter: SignedOdometer
    network: Network
    config: Configuration
    oriented_elements: frozenset[int] = frozenset()

    def carry_over_gaps(self, borders: list[tuple[TrueAnchor, TrueAnchor]]) -> CarriedGaps:
        """Gaps before, between and after what is known, each border from one anchor to the other.

        An odometer that counts up in both directions carries over no stand.
        """
        if not borders:
            return CarriedGaps(self.counter, ())
        borders = sorted(borders, key=lambda border: border[0].t_ns)
        gaps = self.find_gaps(borders)
        if not self._possible_orientations(gaps):
            return replace(self, counter=self.counter.without_sign()).carry_over_gaps(borders)
        return CarriedGaps(self.counter, tuple(gaps))

    def find_gaps(self, borders: Sequence[tuple[TrueAnchor, TrueAnchor]]) -> list[Gap]:
        """The gaps before, between and after the borders, with all chains through each; `borders` in order of time."""
        odometer = self.counter.odometer
        first = borders[0][0]
        last = borders[-1][1]
        gaps = [Gap(min(odometer.begin_ns, first.t_ns), first.t_ns, None, first, [])]
        for (_, begin), (end, _) in pairwise(borders):
            gaps += self._gaps_between(begin, end)
        gaps.append(Gap(last.t_ns, max(odometer.end_ns, last.t_ns), last, None, []))
        gaps = _without_contradicted(gaps)
        orientations = self._possible_orientations(gaps) or {True, False}
        return [self._extend_gap(gap, orientations) for gap in gaps]

    def _gaps_between(self, begin: TrueAnchor, end: TrueAnchor) -> list[Gap]:
        """The gap between two anchors; where the odometer lost distance in it, two halves, each with one anchor.

        Routes within the odometer's error come first; only where there is none, those within slip too.
        """
        if end.t_ns < begin.t_ns:
            return []
        end_ns = np.array([end.t_ns])
        counted = self.counter.distance_and_variance(begin.t_ns, end_ns)
        length_m, bound_m = float(counted.distance_m[0]), float(counted.bound_m[0])
        if np.isnan(length_m):
            return [Gap(begin.t_ns, end.t_ns, begin, None, []), Gap(begin.t_ns, end.t_ns, None, end, [])]
        driven_m = self.counter.driven_between_m(begin.t_ns, end_ns)
        hazards = self.config.hazards
        noise_m = hazards.evidence_factor * (begin.sigma_m + end.sigma_m) + begin.clock_m + end.clock_m
        slack_m = float(odometer_confidence_m(driven_m, 0.0, self.config)[0]) + noise_m + bound_m
        routes = self._routes_of_length(begin, end, length_m, slack_m)
        if routes == []:
            slip_m = hazards.slip_m + hazards.slip_share * float(driven_m[0]) + bound_m
            routes = self._routes_of_length(begin, end, length_m, slip_m)
        if routes is not None:
            ends = (begin, end)
            routes = [
                replace(route, closed=odometer_closes(self.counter, ends, route.length_m, self.config))
                for route in routes
            ]
        return [Gap(begin.t_ns, end.t_ns, begin, end, routes)]

    def only_length_m(self, begin: TrueAnchor, end: TrueAnchor) -> list[float]:
        """The length of the routes between two anchors, as the odometer counts up [m]; nothing if there are several."""
        gaps = self._gaps_between(begin, end)
        return gaps[0].only_length_m if len(gaps) == 1 else []

    def misclosure_m(self, begin: TrueAnchor, end: TrueAnchor, scale: float, scale_sigma: float) -> float:
        """How much farther apart the anchors are than the odometer counted [m].

        `scale`: true over counted distance beyond a vehicle file, with its sigma. 0 where a route closes within k_T
        sigmas (at k = 3 a reference of few samples would step every few minutes), or none leads; NaN where routes
        differ.
        """
        gaps = self._gaps_between(begin, end)
        if len(gaps) != 1 or not gaps[0].routes:
            return 0.0
        counted = self.counter.distance_and_variance(begin.t_ns, np.array([end.t_ns]))
        counted_m = float(counted.distance_m[0])
        variance_m2 = begin.sigma_m**2 + end.sigma_m**2 + float(counted.variance_m2[0])
        allowed_m = self.config.align.sure_sigmas * float(np.sqrt(variance_m2 + (scale_sigma * counted_m) ** 2))
        allowed_m += float(counted.bound_m[0]) + begin.clock_m + end.clock_m
        if not self.counter.has_known_scale:
            allowed_m += self.config.lds.odometer_fixed_m
        off_m = sorted((route.length_m - scale * counted_m for route in gaps[0].routes), key=abs)
        if abs(off_m[0]) <= allowed_m:
            return 0.0
        # At a stand a route leads there and one back: nobody knows which.
        other = any(abs(off) <= abs(off_m[0]) + allowed_m and abs(off - off_m[0]) > allowed_m for off in off_m)
        return float("nan") if other else off_m[0]

    def _routes_of_length(
        self, first: TrueAnchor, second: TrueAnchor, length_m: float, slack_m: float
    ) -> list[GapChain] | None:
        """Routes from anchor to anchor of the odometer's length +- the slack, in either direction; None if too many.

        Each chain once: a gap of hardly any length is found from both sides.
        """
        network = self.network
        most = self.config.hazards.routes_limit
        routes: dict[tuple[object, ...], GapChain] = {}
        for back in (False, True):
            starts, goals = (second, first) if back else (first, second)
            signed_m = -length_m if back else length_m
            lengths_m = (max(signed_m - slack_m, 0.0), signed_m + slack_m)
            for start, side, goal in product(starts.places, (0, 1), goals.places):
                chains = chains_between(network, 2 * start.element + side, start, goal, lengths_m, back, most)
                if chains is None:
                    return None
                for chain in chains:
                    end_m = chain.entry_m[-1] + network.track.distance_from_entry_m(chain.oriented[-1], goal.measure_m)
                    route = GapChain(chain, (end_m, 0.0) if back else (0.0, end_m))
                    routes.setdefault((chain.oriented, round(route.length_m, 2)), route)
        return list(routes.values())

    def _possible_orientations(self, gaps: Sequence[Gap]) -> set[bool]:
        """Orientations of the network (`Network.usable`) in which the odometer counts up, over the whole run.

        By closed gaps and by the reference (`oriented_elements`), never by the positions that are judged: so it is not
        asked of `odometry.polarity`. Both where nothing decides: a loop turns trains round, parts of the network are
        not connected, or the counter has no sign. Empty where the gaps contradict each other. (50 random topologies,
        10,000 instants: the evidence leaves one element at 8,251 by a reference, 3,464 by reads; without
        `oriented_elements` at 7,679 and 3,464, with both orientations at 7,320 and 1,560.)
        """
        both = {True, False}
        if not self.counter.signed:
            return both
        usable = self.network.usable
        elements = {place.element for gap in gaps for anchor in gap.anchors for place in anchor.places}
        connected = set(self.network.connected_part[list(elements)].tolist())
        if not self.network.orientable or len(connected) > 1:
            return both
        decided = [
            {bool(usable[route.chain.oriented[0]]) for route in gap.closed_routes} for gap in gaps if gap.closed_routes
        ]
        decided += [{bool(usable[oriented])} for oriented in self.oriented_elements]
        return set.intersection(both, *decided)

    def _extend_gap(self, gap: Gap, orientations: set[bool]) -> Gap:
        """The gap with its chains in the possible orientations, over every branch as far as the odometer counts.

        Between two anchors too, where the train may have turned beyond one of them. (Without this the truth is outside
        at 269 of 7,508 instants by reads, in 3 of 50 random topologies; with it at none.)
        """
        if gap.routes is None:
            return gap
        count = int((gap.end_ns - gap.begin_ns) / (self.counter.odometer.config.speed_window_s * NS_PER_S)) + 2
        # One speed window apart the train's farthest places are looked for.
        looks_ns = np.linspace(gap.begin_ns, gap.end_ns, count).astype(np.int64)
        turned = self._may_have_turned(gap, looks_ns)
        reached: list[GapChain] = []
        for route in gap.routes if len(gap.anchors) == 2 else self._from_one_anchor(gap):
            if self.network.usable[route.chain.oriented[0]] not in orientations:
                continue
            most = self.config.hazards.routes_limit
            chains = extend_chain(self.network, route.chain, *self._reach_m(gap, route, looks_ns), most)
            # A train that turned beyond a switch may have come back on another track.
            if chains is None or (turned and any(self._branches(chain) for chain in chains)):
                return replace(gap, routes=None)
            reached += [replace(route, chain=chain) for chain in chains]
        return replace(gap, routes=reached)

    def _may_have_turned(self, gap: Gap, looks_ns: Ints) -> bool:
        """Whether the train went back in the gap by more than the fixed error of the odometer."""
        distance_m = self.counter.distance_and_variance(gap.anchors[0].t_ns, looks_ns).distance_m
        distance_m = distance_m[np.isfinite(distance_m)]
        # The largest fall behind the farthest place so far; a run without a turn has none in one of the two senses.
        senses = (distance_m, -distance_m)
        falls_m = [float((np.maximum.accumulate(moved_m) - moved_m).max(initial=0.0)) for moved_m in senses]
        return min(falls_m) > self.config.lds.odometer_fixed_m

    def _branches(self, chain: Chain) -> bool:
        """Whether the track branches on a chain, in either direction."""
        sides = (side for oriented in chain.oriented for side in (oriented, oriented ^ 1))
        return any(len(self.network.successors[side]) > 1 for side in sides)

    def _from_one_anchor(self, gap: Gap) -> list[GapChain]:
        """Chains of one element from the only anchor of a gap: of each of its places, run in either direction."""
        (anchor,) = gap.anchors
        along_m = self.network.track.distance_from_entry_m
        return [
            # The coordinate is 0 at the anchor, so the element is entered at minus the distance to it.
            GapChain(Chain((oriented,), (-along_m(oriented, place.measure_m),)), (0.0,))
            for place in anchor.places
            for oriented in (2 * place.element, 2 * place.element + 1)
        ]

    def _reach_m(self, gap: Gap, route: GapChain, looks_ns: Ints) -> tuple[float, float]:
        """Least and largest coordinate that the train may have come to in the gap [m]."""
        reach_m = list(route.at_m)
        for anchor, at_m in zip(gap.anchors, route.at_m, strict=True):
            low_m, high_m = carry_from_anchor(self.counter, anchor, at_m, looks_ns, self.config)
            if np.isfinite(low_m).any():
                reach_m += [float(np.nanmin(low_m)), float(np.nanmax(high_m))]
        return min(reach_m), max(reach_m)


def _without_contradicted(gaps: list[Gap]) -> list[Gap]:
    """The gaps, without routes where nothing can be carried from their anchors.

    That is outward from an anchor none of whose routes closes, and from the anchors of an unreachable gap: one of these
    two is wrong, and nothing tells which.
    """
    weighed = [gap for gap in gaps if len(gap.anchors) == 2 and gap.routes is not None]
    joined = {id(anchor) for gap in weighed for anchor in gap.anchors}
    closed = {id(anchor) for gap in weighed if gap.closed_routes for anchor in gap.anchors}
    wrong = {id(anchor) for gap in gaps if gap.is_unreachable for anchor in gap.anchors}

    def is_doubtful(gap: Gap) -> bool:
        """Whether an anchor of the gap is wrong, or the only one and closed by no route of another gap."""
        anchors = {id(anchor) for anchor in gap.anchors}
        return bool(anchors & wrong) or (len(anchors) == 1 and bool(anchors & (joined - closed)))

    return [replace(gap, routes=None) if is_doubtful(gap) and not gap.is_unreachable else gap for gap in gaps]


def _has_branch_inside(chain: Chain, network: Network) -> bool:
    """Whether another track begins or ends where two elements of the chain join."""
    joints = [*chain.oriented[:-1], *(oriented ^ 1 for oriented in chain.oriented[1:])]
    return any(len(network.successors[side]) > 1 for side in joints)


def chains_between(
    network: Network, start: int, begin: Place, goal: Place, lengths_m: tuple[float, float], back: bool, most: int
) -> list[Chain] | None:
    """Chains from `begin` on the oriented element `start` to `goal`, of a length between the two; `begin` is at 0.

    `back`: the train runs them from the goal to the begin. None where there are more than `most`.
    """
    shortest_m, longest_m = lengths_m
    first = Chain((start,), (-network.track.distance_from_entry_m(start, begin.measure_m),))

    def onward(chain: Chain) -> list[Edge]:
        """Relations that the train may run over from the end of a chain."""
        edges = network.successors[chain.oriented[-1]]
        return [edge for edge in edges if (edge.backward if back else edge.forward)]

    chains: list[Chain] = []
    for steps, found in enumerate(search_chains(network, first, longest_m, onward), 1):
        last = found.chain.oriented[-1]
        if last // 2 == goal.element:
            at_m = found.distance_m + network.track.distance_from_entry_m(last, goal.measure_m)
            if shortest_m <= at_m <= longest_m:
                chains.append(found.chain)
        if len(chains) > most or steps > most**2:
            return None
    return chains


def extend_chain(network: Network, chain: Chain, least_m: float, most_m: float, most: int) -> list[Chain] | None:
    """The chain carried on over every branch until it covers the coordinates from `least_m` to `most_m`.

    Where the track ends before, it ends. None where there are more than `most` chains.
    """
    done: list[Chain] = []
    for ahead in _extend_ahead(network, chain, most_m, most):
        done += [
            whole.in_other_direction(network)
            for whole in _extend_ahead(network, ahead.in_other_direction(network), -least_m, most)
        ]
        if len(done) > most:
            return None
    return done or None


def _extend_ahead(network: Network, chain: Chain, until_m: float, most: int) -> list[Chain]:
    """The chain carried on ahead over every branch, up to a coordinate [m] or the end of the track.

    None if too many.
    """

    def onward(chain: Chain) -> list[Edge]:
        """Relations that lead on from a chain which does not reach the coordinate yet."""
        edges = network.successors[chain.oriented[-1]] if chain.exit_m(network) < until_m else ()
        return [edge for edge in edges if edge.forward or edge.backward]

    whole: list[Chain] = []
    number = 1
    for found in search_chains(network, chain, np.inf, onward):
        branches = len(onward(found.chain))
        whole += [] if branches else [found.chain]
        number += max(branches - 1, 0)
        if number > most:
            return []
    return whole
