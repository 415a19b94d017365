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
    for (_, a), (b, _) in pairwise(borders):
        gaps += _between(a, b, counter, network, config)
    gaps.append(Gap(last.t_ns, max(counter.odometer.end_ns, last.t_ns), last, None, []))
    gaps = _without_contradicted(gaps)
    sheets = _sheets(gaps, facing, network) or {True, False}
    return [_reaching(gap, sheets, counter, network, config) for gap in gaps]


def without_sign(gaps: Sequence[Gap], facing: Set[int], network: Network) -> bool:
    """The odometer counted up whichever way the train ran."""
    return not _sheets(gaps, facing, network)


def _between(a: TrueAnchor, b: TrueAnchor, counter: Counter, network: Network, config: Configuration) -> list[Gap]:
    """Where the odometer lost distance in a gap, it is two halves that know nothing of each other."""
    if b.t_ns < a.t_ns:
        return []
    end_ns = np.array([b.t_ns])
    length_m = float(counter.between(a.t_ns, end_ns).distance_m[0])
    if np.isnan(length_m):
        return [Gap(a.t_ns, b.t_ns, a, None, []), Gap(a.t_ns, b.t_ns, None, b, [])]
    way_m = float(counter.driven_m(a.t_ns, end_ns)[0])
    hazards = config.hazards
    noise_m = hazards.evidence_factor * (a.sigma_m + b.sigma_m) + a.clock_m + b.clock_m
    slack_m = float(beside_m(np.array(way_m), 0.0, config)) + noise_m
    ways = _ways_of_length(a, b, length_m, slack_m, network, hazards.routes_limit)
    if ways == []:
        slack_m = hazards.slip_m + hazards.slip_share * way_m
        ways = _ways_of_length(a, b, length_m, slack_m, network, hazards.routes_limit)
    if ways is not None:
        ways = [replace(way, closed=closes(counter, (a, b), way.at_m[1] - way.at_m[0], config)) for way in ways]
    return [Gap(a.t_ns, b.t_ns, a, b, ways)]


def unreachable(gaps: Sequence[Gap]) -> list[Gap]:
    """Gaps whose anchors no train can have passed one after the other: one of the two is wrong."""
    return [gap for gap in gaps if gap.begin is not None and gap.end is not None and gap.ways == []]


def _without_contradicted(gaps: list[Gap]) -> list[Gap]:
    """Nothing is carried outward from an anchor none of whose ways closes, nor beside an unreachable gap.

    Which of the two anchors of an unreachable gap is wrong nobody knows.
    """
    weighed = [gap for gap in gaps if len(gap.anchors) == 2 and gap.ways is not None]
    joined = {id(anchor) for gap in weighed for anchor in gap.anchors}
    closed = {id(anchor) for gap in weighed if gap.closed for anchor in gap.anchors}
    wrong = {id(anchor) for gap in unreachable(gaps) for anchor in gap.anchors}

    def doubtful(gap: Gap) -> bool:
        anchors = {id(anchor) for anchor in gap.anchors}
        return bool(anchors & wrong) or (len(anchors) == 1 and bool(anchors & (joined - closed)))

    apart = unreachable(gaps)
    return [replace(gap, ways=None) if gap not in apart and doubtful(gap) else gap for gap in gaps]


def _ways_of_length(
    a: TrueAnchor, b: TrueAnchor, length_m: float, slack_m: float, network: Network, most: int
) -> list[GapChain] | None:
    """Chains from anchor to anchor of the odometer's length +- the slack, either way round."""
    ways: list[GapChain] = []
    for begins, goals, way_m, back in ((a.places, b.places, length_m, False), (b.places, a.places, -length_m, True)):
        lengths = (max(way_m - slack_m, 0.0), way_m + slack_m)
        for begin, side, goal in product(begins, (0, 1), goals):
            chains = chains_between(network, 2 * begin.element + side, begin, goal, lengths, back, most)
            if chains is None:
                return None
            for chain in chains:
                end_m = chain.entry_m[-1] + network.track.along_m(chain.oriented[-1], goal.measure_m)
                ways.append(GapChain(chain, (end_m, 0.0) if back else (0.0, end_m)))
    return _distinct(ways)


def _distinct(ways: list[GapChain]) -> list[GapChain]:
    """Each chain once: a gap of hardly any length is found from both sides."""
    kept: dict[tuple[object, ...], GapChain] = {}
    for way in ways:
        apart_m = way.at_m[-1] - way.at_m[0]
        kept.setdefault((way.chain.oriented, round(apart_m, 2)), way)
    return list(kept.values())


def _sheets(gaps: Sequence[Gap], facing: Set[int], network: Network) -> set[bool]:
    """Which orientation of the network the train keeps over the whole run; both where nothing says it.

    Where a loop turns trains round, or parts of the network are not connected, nothing does. None where the gaps
    contradict each other: the odometer counts up both ways.
    """
    both = {True, False}
    if not network.orientable or not _connected(
        {place.element for gap in gaps for anchor in gap.anchors for place in anchor.places}, network
    ):
        return both
    kept = [
        {network.usable[way.chain.oriented[0]] for way in gap.ways or [] if way.closed} for gap in gaps if gap.closed
    ]
    kept += [{network.usable[oriented]} for oriented in facing]
    return set.intersection(both, *kept)


def _connected(elements: set[int], network: Network) -> bool:
    seen: set[int] = set()
    ahead = [2 * next(iter(elements))] if elements else []
    while ahead:
        oriented = ahead.pop()
        if oriented // 2 not in seen:
            seen.add(oriented // 2)
            ahead += [edge.to for side in (oriented, oriented ^ 1) for edge in network.successors[side]]
    return elements <= seen


def _reaching(gap: Gap, sheets: set[bool], counter: Counter, network: Network, config: Configuration) -> Gap:
    """The gap with the chains of the kept orientation, over every branch as far as the odometer says."""
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
    """The train went to and fro in the gap by more than the odometer's own error."""
    t_ns = _looks(gap, counter)
    for anchor in gap.anchors[:1]:
        way = counter.between(anchor.t_ns, t_ns).distance_m
        known = way[np.isfinite(way)]
        if known.size:
            back = min(float((np.maximum.accumulate(sign * known) - sign * known).max()) for sign in (1.0, -1.0))
            return back > config.lds.odometer_fixed_m
    return False


def _branches(chain: Chain, network: Network) -> bool:
    """A switch on the chain: a train that turned beyond it may have come back on another track."""
    return any(len(network.successors[side]) > 1 for one in chain.oriented for side in (one, one ^ 1))


def _looks(gap: Gap, counter: Counter) -> Ints:
    """Instants at which to look how far the train went before it turned; a speed is a mean over such a time."""
    count = int((gap.end_ns - gap.begin_ns) / (counter.odometer.config.speed_window_s * NS_PER_S)) + 2
    return np.linspace(gap.begin_ns, gap.end_ns, count).astype(np.int64)


def _from_one_anchor(gap: Gap, network: Network) -> list[GapChain]:
    """Both ways round."""
    (anchor,) = gap.anchors
    return [
        GapChain(Chain((one,), (-network.track.along_m(one, place.measure_m),)), (0.0,))
        for place in anchor.places
        for one in (2 * place.element, 2 * place.element + 1)
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
