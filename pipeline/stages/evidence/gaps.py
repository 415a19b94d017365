"""Gaps between anchors: which chains of net elements the train may have run there (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np

from pipeline.stages.evidence.carrying import Counter, TrueAnchor, beside_m, carried, closes
from pipeline.stages.evidence.chains import chains_between, extended
from pipeline.stages.track.chain import Chain
from pipeline.stages.track.network import Network
from schemas.arrays import NS_PER_S, Ints
from schemas.config import Configuration


@dataclass(frozen=True)
class GapChain:
    """A chain through a gap, in the sense in which the odometer counts up, with its anchors at `at_m`.

    `closed`: the odometer counted its length within its own noise.
    """

    chain: Chain
    at_m: tuple[float, ...]
    closed: bool = False


@dataclass(frozen=True)
class Gap:
    """Time between two anchors, or on one side of one.

    `ways` is None where there are more than can be weighed: then nothing is said of place or track.
    """

    begin_ns: int
    end_ns: int
    begin: TrueAnchor | None
    end: TrueAnchor | None
    ways: list[GapChain] | None

    @property
    def anchors(self) -> list[TrueAnchor]:
        return [anchor for anchor in (self.begin, self.end) if anchor is not None]

    @property
    def closed(self) -> bool:
        return any(way.closed for way in self.ways or [])

    @property
    def alone(self) -> list[GapChain]:
        """The one closed way between two anchors; nothing where ways of several lengths close."""
        closed = [way for way in self.ways or [] if way.closed]
        lengths = {round(way.at_m[-1] - way.at_m[0], 2) for way in closed}
        return closed[:1] if len(lengths) == 1 and len(self.anchors) == 2 else []


def gaps_of(
    borders: Sequence[tuple[TrueAnchor, TrueAnchor]],
    facing: Set[int],
    counter: Counter,
    network: Network,
    config: Configuration,
) -> list[Gap]:
    """Gaps before, between and after the borders (known from one anchor to the other), with all chains through each.

    `facing`: oriented net elements over which the train ran, by the reference, as the odometer counted up.
    """
    first = borders[0][0]
    last = borders[-1][1]
    gaps = [Gap(min(counter.odometer.begin_ns, first.t_ns), first.t_ns, None, first, [])]
    for (_, begin), (end, _) in pairwise(borders):
        gaps += _between(begin, end, counter, network, config)
    gaps.append(Gap(last.t_ns, max(counter.odometer.end_ns, last.t_ns), last, None, []))
    gaps = _without_contradicted(gaps)
    sheets = _sheets(gaps, facing, network) or {True, False}
    return [_reaching(gap, sheets, counter, network, config) for gap in gaps]


def without_sign(gaps: Sequence[Gap], facing: Set[int], network: Network) -> bool:
    """The odometer counted up whichever way the train ran."""
    return not _sheets(gaps, facing, network)


def _between(
    begin: TrueAnchor, end: TrueAnchor, counter: Counter, network: Network, config: Configuration
) -> list[Gap]:
    """The gap between two anchors; where the odometer lost distance in it, two halves, each with one anchor.

    Ways within the odometer's error come first; only where there is none, those within slip too.
    """
    if end.t_ns < begin.t_ns:
        return []
    end_ns = np.array([end.t_ns])
    length_m = float(counter.distance_m(begin.t_ns, end_ns)[0])
    if np.isnan(length_m):
        return [Gap(begin.t_ns, end.t_ns, begin, None, []), Gap(begin.t_ns, end.t_ns, None, end, [])]
    way_m = float(counter.driven_m(begin.t_ns, end_ns)[0])
    hazards = config.hazards
    noise_m = hazards.evidence_factor * (begin.sigma_m + end.sigma_m) + begin.clock_m + end.clock_m
    slack_m = float(beside_m(np.array(way_m), 0.0, config)) + noise_m
    ways = _ways_of_length(begin, end, length_m, slack_m, network, hazards.routes_limit)
    if ways == []:
        slack_m = hazards.slip_m + hazards.slip_share * way_m
        ways = _ways_of_length(begin, end, length_m, slack_m, network, hazards.routes_limit)
    if ways is not None:
        ways = [replace(way, closed=closes(counter, (begin, end), way.at_m[1] - way.at_m[0], config)) for way in ways]
    return [Gap(begin.t_ns, end.t_ns, begin, end, ways)]


def unreachable(gaps: Sequence[Gap]) -> list[Gap]:
    """Gaps whose anchors no train can have passed one after the other: one of the two is wrong."""
    return [gap for gap in gaps if gap.begin is not None and gap.end is not None and gap.ways == []]


def _without_contradicted(gaps: list[Gap]) -> list[Gap]:
    """Nothing is carried outward from an anchor none of whose ways closes, nor from the anchors of an unreachable gap.

    One of these two is wrong, and nothing tells which.
    """
    weighed = [gap for gap in gaps if len(gap.anchors) == 2 and gap.ways is not None]
    joined = {id(anchor) for gap in weighed for anchor in gap.anchors}
    closed = {id(anchor) for gap in weighed if gap.closed for anchor in gap.anchors}
    impossible = unreachable(gaps)
    wrong = {id(anchor) for gap in impossible for anchor in gap.anchors}

    def doubtful(gap: Gap) -> bool:
        anchors = {id(anchor) for anchor in gap.anchors}
        return bool(anchors & wrong) or (len(anchors) == 1 and bool(anchors & (joined - closed)))

    return [replace(gap, ways=None) if gap not in impossible and doubtful(gap) else gap for gap in gaps]


def _ways_of_length(
    first: TrueAnchor, second: TrueAnchor, length_m: float, slack_m: float, network: Network, most: int
) -> list[GapChain] | None:
    """Ways from anchor to anchor of the odometer's length +- the slack, either way round; None if they are too many."""
    ways: list[GapChain] = []
    for starts, goals, way_m, back in (
        (first.places, second.places, length_m, False),
        (second.places, first.places, -length_m, True),
    ):
        lengths = (max(way_m - slack_m, 0.0), way_m + slack_m)
        for start_place, side, goal_place in product(starts, (0, 1), goals):
            chains = chains_between(
                network, 2 * start_place.element + side, start_place, goal_place, lengths, back, most
            )
            if chains is None:
                return None
            for chain in chains:
                end_m = chain.entry_m[-1] + network.track.along_m(chain.oriented[-1], goal_place.measure_m)
                ways.append(GapChain(chain, (end_m, 0.0) if back else (0.0, end_m)))
    return _distinct(ways)


def _distinct(ways: list[GapChain]) -> list[GapChain]:
    """Each chain once: a gap of hardly any length is found from both sides."""
    distinct: dict[tuple[object, ...], GapChain] = {}
    for way in ways:
        apart_m = way.at_m[-1] - way.at_m[0]
        distinct.setdefault((way.chain.oriented, round(apart_m, 2)), way)
    return list(distinct.values())


def _sheets(gaps: Sequence[Gap], facing: Set[int], network: Network) -> set[bool]:
    """In which orientation of the network (`Network.usable`) the odometer counts up, over the whole run.

    Both where nothing decides: a loop turns trains round, or parts of the network are not connected. Empty where the
    gaps contradict each other: the odometer counts up both ways.
    """
    both = {True, False}
    if not network.orientable or not _connected(
        {place.element for gap in gaps for anchor in gap.anchors for place in anchor.places}, network
    ):
        return both
    decided = [
        {bool(network.usable[way.chain.oriented[0]]) for way in gap.ways or [] if way.closed}
        for gap in gaps
        if gap.closed
    ]
    decided += [{bool(network.usable[oriented])} for oriented in facing]
    return set.intersection(both, *decided)


def _connected(elements: set[int], network: Network) -> bool:
    return len(set(network.connected[list(elements)].tolist())) <= 1


def _reaching(gap: Gap, sheets: set[bool], counter: Counter, network: Network, config: Configuration) -> Gap:
    """The gap with its chains in the possible orientations, over every branch as far as the odometer counts."""
    if gap.ways is None:
        return gap
    turned = _turned(gap, counter, config)
    ways = gap.ways if len(gap.anchors) == 2 else _from_one_anchor(gap, network)
    reached: list[GapChain] = []
    for way in ways:
        if network.usable[way.chain.oriented[0]] not in sheets:
            continue
        chains = extended(network, way.chain, *_reach_m(gap, way, counter, config), config.hazards.routes_limit)
        if chains is None or (turned and any(_branches(chain, network) for chain in chains)):
            return replace(gap, ways=None)
        reached += [replace(way, chain=chain) for chain in chains]
    return replace(gap, ways=reached)


def _turned(gap: Gap, counter: Counter, config: Configuration) -> bool:
    """The train went back in the gap by more than the fixed error of the odometer."""
    t_ns = _looks(gap, counter)
    for anchor in gap.anchors[:1]:
        distance_m = counter.distance_m(anchor.t_ns, t_ns)
        distance_m = distance_m[np.isfinite(distance_m)]
        if distance_m.size:
            # The largest fall behind the farthest place so far; a run without a turn has none in one of the two senses.
            ways_m = (distance_m, -distance_m)
            back_m = min(float((np.maximum.accumulate(way_m) - way_m).max()) for way_m in ways_m)
            return back_m > config.lds.odometer_fixed_m
    return False


def _branches(chain: Chain, network: Network) -> bool:
    """A switch on the chain: a train that turned beyond it may have come back on another track."""
    return any(len(network.successors[side]) > 1 for oriented in chain.oriented for side in (oriented, oriented ^ 1))


def _looks(gap: Gap, counter: Counter) -> Ints:
    """Instants over the gap, one speed window apart, at which the train's farthest places are looked for."""
    count = int((gap.end_ns - gap.begin_ns) / (counter.odometer.config.speed_window_s * NS_PER_S)) + 2
    return np.linspace(gap.begin_ns, gap.end_ns, count).astype(np.int64)


def _from_one_anchor(gap: Gap, network: Network) -> list[GapChain]:
    """The element of each place of the anchor, run either way round."""
    (anchor,) = gap.anchors
    return [
        # The coordinate is 0 at the anchor, so the element is entered at minus the way to it.
        GapChain(Chain((oriented,), (-network.track.along_m(oriented, place.measure_m),)), (0.0,))
        for place in anchor.places
        for oriented in (2 * place.element, 2 * place.element + 1)
    ]


def _reach_m(gap: Gap, way: GapChain, counter: Counter, config: Configuration) -> tuple[float, float]:
    """Least and largest coordinate that the train may have come to in the gap [m]."""
    t_ns = _looks(gap, counter)
    least = min(way.at_m)
    most = max(way.at_m)
    for anchor, at_m in zip(gap.anchors, way.at_m, strict=True):
        low, high = carried(counter, anchor, at_m, t_ns, config)
        if np.isfinite(low).any():
            least = min(least, float(np.nanmin(low)))
            most = max(most, float(np.nanmax(high)))
    return least, most
