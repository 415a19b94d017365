"""Gaps between anchors: which chains of net elements the train may have run there (DOMAIN section 5.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.evidence.carrying import Anchor, Figures, OdometerReadings, Readings, joined, way_m
from pipeline.evidence.routes import Chain, Place, Route, along_m, chains_between, extended
from pipeline.track.network import Network
from schemas.arrays import NS_PER_S

# How finely the odometer is looked at for how far the train went beyond an anchor before it turned.
_LOOK_S = 1.0
_SAME_M = 0.01
# A search bound, no limit of trust: an odometer that slipped by more leaves the gap without a chain, so unknown.
_SLIPPED_M, _SLIPPED_SHARE = 200.0, 0.5


Facing = dict[Anchor, int]
"""Oriented net element of an anchor, in the sense in which the odometer counts up."""


@dataclass(frozen=True)
class Way:
    """A chain through a gap, with the coordinates of its anchors and how it runs over their net elements."""

    chain: Chain
    begin_m: float | None
    end_m: float | None
    begin_oriented: int | None
    end_oriented: int | None


@dataclass(frozen=True)
class Gap:
    """Time between two anchors, or before the first and after the last.

    `ways` is None where there are more than can be weighed: then nothing is said of place or track.
    """

    begin_ns: int
    end_ns: int
    begin: Anchor | None
    end: Anchor | None
    ways: list[Way] | None

    @property
    def anchors(self) -> list[Anchor]:
        return [anchor for anchor in (self.begin, self.end) if anchor is not None]


def gap_between(a: Anchor, b: Anchor, network: Network, figures: Figures) -> list[Gap]:
    """The gap; where the odometer lost distance in it, two halves that know nothing of each other."""
    if not joined(a, b):
        return [Gap(a.t_ns, b.t_ns, a, None, []), Gap(a.t_ns, b.t_ns, None, b, [])]
    return [Gap(a.t_ns, b.t_ns, a, b, _ways_between(a, b, network, figures))]


def _ways_between(a: Anchor, b: Anchor, network: Network, figures: Figures) -> list[Way] | None:
    """Chains from anchor to anchor, either way round, of a length that the odometer allows.

    Where it allows none it slipped, and lost or gained the difference: then every chain that is not much longer.
    """
    driven_m = abs(b.travelled_m - a.travelled_m)
    slack_m = figures.fixed_m + figures.factor * (a.sigma_m + b.sigma_m)
    ways = _chains_of_length(a, b, slack_m + figures.share * driven_m, network, figures)
    return _chains_of_length(a, b, _SLIPPED_M + _SLIPPED_SHARE * driven_m, network, figures) if ways == [] else ways


def _chains_of_length(a: Anchor, b: Anchor, slack_m: float, network: Network, figures: Figures) -> list[Way] | None:
    length_m = figures.scale * (b.distance_m - a.distance_m)
    ways: list[Way] = []
    for start in (2 * a.place.element, 2 * a.place.element + 1):
        found = chains_between(network, start, a.place, b.place, _lengths(length_m, slack_m), back=False)
        if found is None:
            return None
        ways += [_way(network, chain, 0.0, b.place, forward=True) for chain in found]
    for start in (2 * b.place.element, 2 * b.place.element + 1):
        found = chains_between(network, start, b.place, a.place, _lengths(-length_m, slack_m), back=True)
        if found is None:
            return None
        ways += [_way(network, chain, 0.0, a.place, forward=False) for chain in found]
    return _distinct(ways)


def _lengths(length_m: float, slack_m: float) -> tuple[float, float]:
    return max(length_m - slack_m, 0.0), length_m + slack_m


def _way(network: Network, chain: Chain, at_m: float, goal: Place, forward: bool) -> Way:
    """The chain begins at one anchor (coordinate 0) and ends at the goal."""
    goal_m = chain.entry_m[-1] + along_m(network, chain.oriented[-1], goal.measure_m)
    first, last = chain.oriented[0], chain.oriented[-1]
    return Way(chain, at_m, goal_m, first, last) if forward else Way(chain, goal_m, at_m, last, first)


def _distinct(ways: list[Way]) -> list[Way]:
    """Each chain once: a gap of hardly any length is found from both sides."""
    kept: dict[tuple[object, ...], Way] = {}
    for way in ways:
        apart_m = (way.end_m or 0.0) - (way.begin_m or 0.0)
        kept.setdefault((way.chain.oriented, round(apart_m / _SAME_M)), way)
    return list(kept.values())


def oriented_alike(gaps: list[Gap], facing: Facing, network: Network) -> list[Gap]:
    """Ways that go through each anchor as those of the gap before and after it do: a train keeps its front.

    Where no loop turns trains round, it keeps it over the whole run. `facing`: what the reference tells of anchors.
    """
    gaps = [_as_faced(gap, facing) for gap in gaps]
    gaps = _on_one_sheet(gaps, facing, network) if _keeps_its_front(gaps, network) else gaps
    for _ in range(2):
        for order in (range(1, len(gaps)), range(len(gaps) - 2, -1, -1)):
            for here in order:
                there = here - 1 if order.step > 0 else here + 1
                gaps[here] = _agreeing(gaps[here], gaps[there])
    return gaps


def _keeps_its_front(gaps: list[Gap], network: Network) -> bool:
    """No loop turns trains round, and all anchors lie on one connected network."""
    elements = {anchor.place.element for gap in gaps for anchor in gap.anchors}
    if not network.orientable or not elements:
        return False
    seen: set[int] = set()
    ahead = [2 * next(iter(elements))]
    while ahead:
        oriented = ahead.pop()
        if oriented // 2 not in seen:
            seen.add(oriented // 2)
            ahead += [edge.to for side in (oriented, oriented ^ 1) for edge in network.successors[side]]
    return elements <= seen


def _as_faced(gap: Gap, facing: Facing) -> Gap:
    """Ways that go through the anchors as the reference says that the train did."""
    known = [anchor for anchor in gap.anchors if anchor in facing]
    if gap.ways is None or not known:
        return gap
    kept = [way for way in gap.ways if all(_oriented_at(way, gap, anchor) == facing[anchor] for anchor in known)]
    return replace(gap, ways=kept)


def _on_one_sheet(gaps: list[Gap], facing: Facing, network: Network) -> list[Gap]:
    """Ways of one orientation, where all that tells leaves but one."""
    told = [{network.usable[way.chain.oriented[0]] for way in gap.ways} for gap in gaps if gap.ways]
    told += [{network.usable[oriented]} for oriented in facing.values()]
    common = set.intersection(*told) if told else set()
    if len(common) != 1:
        return list(gaps)
    kept = [[way for way in gap.ways or [] if network.usable[way.chain.oriented[0]] in common] for gap in gaps]
    return [gap if gap.ways is None else replace(gap, ways=ways) for gap, ways in zip(gaps, kept, strict=True)]


def _agreeing(gap: Gap, beside: Gap) -> Gap:
    shared = [anchor for anchor in gap.anchors if anchor in beside.anchors]
    if not shared or not gap.ways or not beside.ways:
        return gap
    allowed = {_oriented_at(way, beside, shared[0]) for way in beside.ways} - {None}
    if not allowed:
        return gap
    kept = [way for way in gap.ways if _oriented_at(way, gap, shared[0]) in allowed]
    return replace(gap, ways=kept)


def _oriented_at(way: Way, gap: Gap, anchor: Anchor) -> int | None:
    return way.begin_oriented if anchor == gap.begin else way.end_oriented


def with_open_ends(
    gaps: list[Gap], facing: Facing, odometry: OdometerReadings | None, network: Network, figures: Figures
) -> list[Gap]:
    """Every gap with chains that reach as far as the odometer says that the train went, over every branch."""
    orientations = _orientations(gaps, facing, network)
    return [_reaching(gap, orientations, odometry, network, figures) for gap in gaps]


def _orientations(gaps: list[Gap], facing: Facing, network: Network) -> dict[Anchor, set[int]]:
    """How the train ran over the net element of each anchor, where the reference or chains between anchors tell."""
    known = {anchor: {oriented} for anchor, oriented in facing.items()}
    sheets = {network.usable[way.chain.oriented[0]] for gap in gaps for way in gap.ways or []}
    sheets |= {network.usable[oriented] for oriented in facing.values()}
    if len(sheets) == 1 and _keeps_its_front(gaps, network):
        for anchor in (anchor for gap in gaps for anchor in gap.anchors):
            both = (2 * anchor.place.element, 2 * anchor.place.element + 1)
            known[anchor] = {oriented for oriented in both if network.usable[oriented] in sheets}
        return known
    for gap in gaps:
        for way in gap.ways or []:
            for anchor in gap.anchors:
                oriented = _oriented_at(way, gap, anchor)
                if oriented is not None and anchor not in facing:
                    known.setdefault(anchor, set()).add(oriented)
    return known


def _reaching(
    gap: Gap,
    orientations: dict[Anchor, set[int]],
    odometry: OdometerReadings | None,
    network: Network,
    figures: Figures,
) -> Gap:
    if gap.ways is None:
        return gap
    ways = gap.ways if gap.begin is not None and gap.end is not None else _from_one_anchor(gap, orientations, network)
    reached: list[Way] = []
    for way in ways:
        chains = extended(network, way.chain, *_reach_m(gap, way, odometry, figures))
        if chains is None:
            return replace(gap, ways=None)
        reached += [replace(way, chain=chain) for chain in chains]
    return replace(gap, ways=reached)


def _from_one_anchor(gap: Gap, orientations: dict[Anchor, set[int]], network: Network) -> list[Way]:
    """Both ways round where nothing tells which way the train faced."""
    (anchor,) = gap.anchors
    both = {2 * anchor.place.element, 2 * anchor.place.element + 1}
    ways = []
    for oriented in sorted(orientations.get(anchor, both)):
        chain = Chain((oriented,), (-along_m(network, oriented, anchor.place.measure_m),))
        begin = anchor == gap.begin
        ways.append(Way(chain, 0.0, None, oriented, None) if begin else Way(chain, None, 0.0, None, oriented))
    return ways


def _reach_m(gap: Gap, way: Way, odometry: OdometerReadings | None, figures: Figures) -> tuple[float, float]:
    """Least and largest coordinate that the train may have come to in the gap [m]."""
    count = int((gap.end_ns - gap.begin_ns) / (_LOOK_S * NS_PER_S)) + 2
    t_ns = np.linspace(gap.begin_ns, gap.end_ns, count).astype(np.int64)
    readings = Readings.of(odometry, t_ns)
    places = [0.0 if value is None else value for value in (way.begin_m, way.end_m)]
    least, most = min(places), max(places)
    for anchor, at_m in ((gap.begin, way.begin_m), (gap.end, way.end_m)):
        if anchor is None or at_m is None:
            continue
        own = readings.take(np.flatnonzero((readings.segment == anchor.segment) & anchor.counted))
        if own.t_ns.size:
            at = at_m + way_m(anchor, own, figures)
            slack = figures.fixed_m + figures.share * np.abs(own.travelled_m - anchor.travelled_m)
            least, most = min(least, float((at - slack).min())), max(most, float((at + slack).max()))
    return least, most


def routes_of(gap: Gap, network: Network) -> list[tuple[Way, Route]]:
    return [(way, way.chain.route(network)) for way in gap.ways or []]
