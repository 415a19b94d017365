"""Stretches of a site where positions alone can never tell two tracks apart (DOMAIN section 2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.matching.candidates import candidates_of, segments_of
from pipeline.track.geodesy import points_of
from pipeline.track.network import Network, network_of
from pipeline.track.segments import SAMPLE_SPACING_M
from pipeline.track.survey import Track, places_along, track_of
from schemas.arrays import Floats
from schemas.config import MatchingConfig
from schemas.enums import BaliseKind
from schemas.run import Finding, Site

# Where tracks part or cross, a shorter stretch is no parallel track [m].
_SHORTEST_M = 100.0


@dataclass(frozen=True)
class _Stretch:
    """A part of an element beside another one, by measure."""

    element: int
    other: int
    begin_m: float
    end_m: float
    apart_m: float


def parallel_findings(site: Site, config: MatchingConfig) -> list[Finding]:
    """One warning per pair of elements and stretch; nothing where a route is given.

    The bias of the run and the survey alone decide here, as for a receiver without any noise: a run right on its own
    track claims 1 / (1 + exp(-d² / 2V)) for tracks d apart, V the sum of both variances.
    """
    if site.route is not None:
        return []
    network = network_of(track_of(site.track), site.links)
    return [
        _finding(site, network, stretch, config)
        for stretch in _stretches(network, config)
        if stretch.end_m - stretch.begin_m >= _SHORTEST_M
    ]


def most_claimed(apart_m: float, survey_m: float, config: MatchingConfig) -> float:
    """What a run right on one of two tracks claims for it at most, by positions alone."""
    variance_m2 = config.cross_bias_sigma_m**2 + survey_m**2
    return float(1.0 / (1.0 + np.exp(-(apart_m**2) / (2.0 * variance_m2))))


def _stretches(network: Network, config: MatchingConfig) -> Iterator[_Stretch]:
    """Per pair of elements the parts of the first that lie too near the second."""
    track = network.track
    along = places_along(track, SAMPLE_SPACING_M)
    element, measure_m = along.element, along.measure_m
    survey_m = _survey_m(track, config)
    odds = np.log(config.ambiguity_probability / (1.0 - config.ambiguity_probability))
    limit_m = np.sqrt(2.0 * odds * (config.cross_bias_sigma_m**2 + survey_m**2))
    points = points_of(along.latitude_deg, along.longitude_deg)
    found = candidates_of(points, network, segments_of(track), float(limit_m.max()))
    own = element[found.step]
    # Two surveys never end at the same place.
    near = (found.beyond_m <= config.survey_sigma_default_m) & (own < found.element)
    near &= found.distance_m < limit_m[own]
    pairs, row = own[near] * network.count + found.element[near], found.step[near]
    apart_m = found.distance_m[near]
    order = np.lexsort((row, pairs))
    pairs, row, apart_m = pairs[order], row[order], apart_m[order]
    cuts = np.flatnonzero((np.diff(pairs) != 0) | (np.diff(row) > 1)) + 1
    for part in np.split(np.arange(len(row)), cuts):
        if len(part):
            one, other = divmod(int(pairs[part[0]]), network.count)
            at_m = measure_m[row[part]]
            yield _Stretch(one, other, float(at_m[0]), float(at_m[-1]), float(np.median(apart_m[part])))


def _finding(site: Site, network: Network, stretch: _Stretch, config: MatchingConfig) -> Finding:
    name, other = network.track.ids[stretch.element], network.track.ids[stretch.other]
    claim = most_claimed(stretch.apart_m, float(_survey_m(network.track, config)[stretch.element]), config)
    text = (
        f"{stretch.begin_m:.0f} to {stretch.end_m:.0f} m: {other} lies {stretch.apart_m:.1f} m beside it; positions "
        f"alone give one of them a probability of {claim:.2f} at most, so that virtual balises there are ambiguous"
    )
    return Finding("warning", f"element {name}", text, _remedy(site, network, stretch))


def _remedy(site: Site, network: Network, stretch: _Stretch) -> str:
    """What would tell: a route always, reads and switches where there are some."""
    told = ["a route (`balise replay --write-route`, `--route`)"]
    names = [network.track.ids[stretch.element], network.track.ids[stretch.other]]
    balises = [] if site.balises is None else site.balises.select("balise_id", "netelement_id", "kind").rows()
    reads = [balise for balise, name, kind in balises if name in names and str(kind) == BaliseKind.PHYSICAL.value]
    if reads:
        told.append(f"a read of {', '.join(reads[:3])}")
    oriented = [2 * element + sense for element in (stretch.element, stretch.other) for sense in (0, 1)]
    if any(len(network.successors[one]) > 1 for one in oriented):
        told.append("a switch taken at its end")
    return f"To tell the two apart: {', '.join(told)}."


def _survey_m(track: Track, config: MatchingConfig) -> Floats:
    """Per element the survey's sigma, the least of its points; the configured one where it states none."""
    stated = np.where(np.isfinite(track.sigma_m), track.sigma_m, config.survey_sigma_default_m)
    return np.asarray(np.minimum.reduceat(stated, track.first[:-1]))
