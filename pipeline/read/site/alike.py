"""What looks alike: balises to linking (LOC section III), and tracks to positions alone (DOMAIN section 2)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.lds.crossings import DEFAULTS, expectation_window, minimal_spacing_m
from pipeline.stages.paths.candidates import candidates_of, search_about
from pipeline.stages.paths.path_tests import offset_resolution_m, switch_resolution_m
from pipeline.stages.track.geodesy import points_of
from pipeline.stages.track.network import Edge, Network, network_of, surveyed_track
from pipeline.stages.track.path import Chain, search_chains, valid_along_measure
from pipeline.stages.track.segments import SAMPLE_SPACING_M
from pipeline.stages.track.survey import SurveyedTrack, places_along
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, LdsConfig, MatchingConfig, SiteConfig
from schemas.enums import BaliseKind
from schemas.frozen import frozen
from schemas.run import Finding, Site

_DEFAULTS = SiteConfig()
_WHOLE = Configuration()


@frozen
class _Point:
    """An announced balise `at_m` from the entry of an oriented element."""

    balise_id: str
    element: int
    accuracy_m: float
    at_m: float


_SHOWN = 3
"""So many warnings stand in a few lines."""


def ambiguities(site: Site, config: Configuration = _WHOLE) -> tuple[Finding, ...]:
    """What costs availability wherever trains run on this site: tracks, then balises, that look alike."""
    return (*parallel_findings(site, config), *window_findings(site, config.lds, config.site))


def summarise_findings(findings: Iterable[Finding], where: str) -> list[str]:
    """The first warnings, each a line; `where`: what lists them all."""
    warnings = [finding for finding in findings if finding.severity == "warning"]
    lines = [f"{one.place}: {one.message}. {one.remedy}".rstrip() for one in warnings[:_SHOWN]]
    more = len(warnings) - _SHOWN
    return lines + ([f"and {more} more warnings: {where}"] if more > 0 else [])


def window_findings(site: Site, config: LdsConfig = DEFAULTS, limits: SiteConfig = _DEFAULTS) -> list[Finding]:
    """One warning per pair of announced balises whose windows overlap, both measured from a balise before them.

    Routes over several net elements and switches count, in each direction that navigability allows. Virtual and
    physical balises are linked apart.
    """
    if site.balises is None:
        return []
    network = network_of(surveyed_track(site), site.links)
    findings: dict[tuple[str, str], Finding] = {}
    for (_,), balises in site.balises.filter("linked").group_by("kind", maintain_order=True):
        points = _balises_by_element(balises, network)
        for oriented, on_it in sorted(points.items()):
            for index, reference in enumerate(on_it):
                for near, far in _next_balises(network, points, oriented, index, limits.announced_m):
                    if finding := _overlap_finding(reference, near, far, config):
                        first, second = sorted((near[0].balise_id, far[0].balise_id))
                        findings.setdefault((first, second), finding)
    return [findings[pair] for pair in sorted(findings)]


def _balises_by_element(balises: pl.DataFrame, network: Network) -> dict[int, list[_Point]]:
    """Balises of one kind by oriented element, in the order in which a train meets them."""
    points: dict[int, list[_Point]] = {}
    columns = ("balise_id", "netelement_id", "measure_m", "location_accuracy_m")
    valid = valid_along_measure(balises)
    for (name, netelement_id, measure_m, accuracy_m), along in zip(balises.select(columns).rows(), valid, strict=True):
        if (element := network.track.element_at(netelement_id, measure_m)) is None:
            continue
        # Even runs with the measure, odd against it.
        for oriented in (2 * element + side for side, sense in ((0, 1), (1, -1)) if along in (0, sense)):
            at_m = network.track.distance_from_entry_m(oriented, measure_m)
            points.setdefault(oriented, []).append(_Point(name, element, accuracy_m, at_m))
    return {
        oriented: sorted(on_it, key=lambda point: (point.at_m, point.balise_id)) for oriented, on_it in points.items()
    }


_OnChain = tuple[_Point, float]
"""A balise with its distance from the reference [m]."""


def _next_balises(
    network: Network, points: dict[int, list[_Point]], oriented: int, index: int, announced_m: float
) -> Iterator[tuple[_OnChain, _OnChain]]:
    """The next two balises on each way ahead of one, as far as it is announced."""
    reference = points[oriented][index]

    def balises_on_chain(chain: Chain) -> tuple[_OnChain, ...]:
        """The first two balises on a chain beyond the one asked for."""
        entered = zip(chain.oriented, chain.entry_m, strict=True)
        ahead = (
            (point, entry_m + point.at_m)
            for number, (here, entry_m) in enumerate(entered)
            for point in points.get(here, [])[0 if number else index + 1 :]
        )
        return tuple(islice(ahead, 2))

    def onward(chain: Chain) -> list[Edge]:
        """Relations that lead on, until two balises are met."""
        return [
            edge for edge in network.successors[chain.oriented[-1]] if edge.forward and len(balises_on_chain(chain)) < 2
        ]

    def chain_key(chain: Chain) -> tuple[int, tuple[str, ...]]:
        """What makes two chains the chain_key: their last element and their balises."""
        return chain.oriented[-1], tuple(point.balise_id for point, _ in balises_on_chain(chain))

    begin = Chain((oriented,), (-reference.at_m,))
    for found in search_chains(network, begin, announced_m, onward, chain_key):
        if len(pair := balises_on_chain(found.chain)) == 2:
            yield pair[0], pair[1]


def _overlap_finding(reference: _Point, near: _OnChain, far: _OnChain, config: LdsConfig) -> Finding | None:
    """A warning if the expectation windows of two balises on a chain overlap."""
    (expected, distance_m) = near
    (later, later_m) = far
    close_m = expectation_window(distance_m, expected.accuracy_m, reference.accuracy_m, config).close_m
    open_m = expectation_window(later_m, later.accuracy_m, reference.accuracy_m, config).open_m
    if open_m > close_m:
        return None
    needed_m = minimal_spacing_m(distance_m, expected.accuracy_m, later.accuracy_m, reference.accuracy_m, config)
    return Finding(
        "warning",
        f"balises {expected.balise_id}, {later.balise_id}",
        f"expectation windows measured from {reference.balise_id} overlap: {later_m - distance_m:.1f} m apart, "
        f"{needed_m:.1f} m needed",
        "Linking alone cannot tell them apart; place them farther apart, or rely on the monitors between them.",
    )


@frozen
class _ParallelStretch:
    """A part of an element beside another one, by measure."""

    element: int
    other: int
    begin_m: float
    end_m: float
    apart_m: float


def parallel_findings(site: Site, config: Configuration = _WHOLE) -> list[Finding]:
    """One warning per pair of elements and stretch; nothing where a route is given.

    The bias of the run and the survey alone decide here, as for a receiver without any noise: offsets tell tracks apart
    that lie farther apart than the bound of a lasting offset, a switch taken those beyond the bound of a movement.
    """
    if site.route is not None:
        return []
    network = network_of(surveyed_track(site), site.links)
    return [
        _parallel_finding(site, network, stretch, config.matching)
        for stretch in _parallel_stretches(network, config.matching)
        if stretch.end_m - stretch.begin_m >= config.site.parallel_least_m
    ]


class TrackResolution(NamedTuple):
    """Per net element how far aside another track has to lie to be distinguished from it with exact positions [m]."""

    survey_m: Floats
    by_offset_m: Floats
    by_switch_m: Floats


def track_resolution(track: SurveyedTrack, config: MatchingConfig) -> TrackResolution:
    """Distance between tracks that a lasting offset, and that a switch taken can resolve [m]."""
    survey_m = _survey_sigmas_m(track, config)
    return TrackResolution(
        survey_m,
        offset_resolution_m(survey_m, config.paths_alpha, config.cross_bias_sigma_m),
        switch_resolution_m(survey_m, config.paths_alpha, config.paths_alike_m),
    )


class NeighbourPairs(NamedTuple):
    """Places along elements with another one beside them, by pair of elements and then along the first."""

    pair: Ints
    row: Ints
    measure_m: Floats
    apart_m: Floats

    def parts(self) -> Iterator[NeighbourPairs]:
        """Stretches of one pair without a place missing."""
        cuts = np.flatnonzero((np.diff(self.pair) != 0) | (np.diff(self.row) > 1)) + 1
        for rows in np.split(np.arange(self.row.size), cuts) if self.row.size else ():
            yield NeighbourPairs(self.pair[rows], self.row[rows], self.measure_m[rows], self.apart_m[rows])


def neighbouring_tracks(network: Network, limit_m: Floats, config: MatchingConfig) -> NeighbourPairs:
    """Places where another track lies nearer than the limit of an element; each pair once, as of the first."""
    along = places_along(network.track, SAMPLE_SPACING_M)
    element = along.element
    points = points_of(along.latitude_deg, along.longitude_deg)
    reach_m = float(limit_m.max())
    near_track = candidates_of(points, network, search_about(points.surface, network, reach_m), reach_m)
    of_sample = element[near_track.step]
    # Two surveys never end at the same place.
    near = (near_track.beyond_m <= config.survey_sigma_default_m) & (of_sample < near_track.element)
    near &= near_track.distance_m < limit_m[of_sample]
    pairs = of_sample[near] * network.count + near_track.element[near]
    row = near_track.step[near]
    order = np.lexsort((row, pairs))
    row = row[order]
    return NeighbourPairs(pairs[order], row, along.measure_m[row], near_track.distance_m[near][order])


def _parallel_stretches(network: Network, config: MatchingConfig) -> Iterator[_ParallelStretch]:
    """Parts of the first of each pair of elements that lie too near the second."""
    resolution = track_resolution(network.track, config)
    for part in neighbouring_tracks(network, np.fmax(resolution.by_offset_m, resolution.by_switch_m), config).parts():
        one, other = divmod(int(part.pair[0]), network.count)
        ends_m = float(part.measure_m[0]), float(part.measure_m[-1])
        yield _ParallelStretch(one, other, *ends_m, float(np.median(part.apart_m)))


def _parallel_finding(site: Site, network: Network, stretch: _ParallelStretch, config: MatchingConfig) -> Finding:
    """The warning on a stretch of parallel track, with what would tell the tracks apart."""
    name = network.track.ids[stretch.element]
    parallel = network.track.ids[stretch.other]
    survey_m = _survey_sigmas_m(network.track, config)[stretch.element]
    needed_m = float(switch_resolution_m(survey_m, config.paths_alpha, config.paths_alike_m))
    by_a_switch = (
        f"a switch taken tells them apart at a survey of {survey_m:.2g} m"
        if stretch.apart_m > needed_m
        else f"nor does a switch taken at a survey of {survey_m:.2g} m, which takes {needed_m:.1f} m"
    )
    text = (
        f"{stretch.begin_m:.0f} to {stretch.end_m:.0f} m: {parallel} lies {stretch.apart_m:.1f} m beside it; offsets "
        f"alone do not tell them apart, so that virtual balises there are ambiguous; {by_a_switch}"
    )
    return Finding("warning", f"element {name}", text, _remedy_words(site, network, stretch))


def _remedy_words(site: Site, network: Network, stretch: _ParallelStretch) -> str:
    """What would tell: a route always, reads and switches where there are some."""
    means = ["a route (`balise replay --write-route`, `--route`)"]
    names = [network.track.ids[stretch.element], network.track.ids[stretch.other]]
    balises = [] if site.balises is None else site.balises.select("balise_id", "netelement_id", "kind").rows()
    reads = [balise for balise, name, kind in balises if name in names and str(kind) == BaliseKind.PHYSICAL.value]
    if reads:
        means.append(f"a read of {', '.join(reads[:3])}")
    oriented = [2 * element + sense for element in (stretch.element, stretch.other) for sense in (0, 1)]
    if any(len(network.successors[side]) > 1 for side in oriented):
        means.append("a switch taken at its end")
    return f"To tell the two apart: {', '.join(means)}."


def _survey_sigmas_m(track: SurveyedTrack, config: MatchingConfig) -> Floats:
    """Survey sigma of each element, the least of its points [m]; the configured one where it states none."""
    stated = np.where(np.isfinite(track.sigma_m), track.sigma_m, config.survey_sigma_default_m)
    return np.asarray(np.minimum.reduceat(stated, track.first[:-1]))
