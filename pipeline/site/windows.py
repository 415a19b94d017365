"""Balises of a site that linking cannot tell apart, on every way that a train may run (LOC section III)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import polars as pl

from pipeline.lds.windows import DEFAULTS, minimal_spacing_m, window_m
from pipeline.track.network import Network, network_of
from pipeline.track.survey import track_of
from schemas.config import LdsConfig
from schemas.run import Finding, Site

# Twice the longest spacing of balises (DOMAIN section 4): nothing is announced from farther back.
_REACH_M = 6000.0


@dataclass(frozen=True)
class _Point:
    """An announced balise `at_m` from the entry of an oriented element."""

    balise_id: str
    element: int
    accuracy_m: float
    at_m: float


def window_findings(site: Site, config: LdsConfig = DEFAULTS) -> list[Finding]:
    """One warning per pair of announced balises whose windows overlap, both measured from a balise before them.

    Ways over several net elements and switches count, in each direction that navigability allows. Virtual and
    physical balises are linked apart.
    """
    if site.balises is None:
        return []
    network = network_of(track_of(site.track), site.links)
    found: dict[tuple[str, str], Finding] = {}
    for (_,), balises in site.balises.filter("linked").group_by("kind", maintain_order=True):
        points = _points(balises, network)
        for oriented, on_it in sorted(points.items()):
            for index, reference in enumerate(on_it):
                for near, far in _ahead(network, points, oriented, index):
                    if finding := _judge(reference, near, far, config):
                        found.setdefault(_pair(near[0], far[0]), finding)
    return [found[pair] for pair in sorted(found)]


def _pair(one: _Point, other: _Point) -> tuple[str, str]:
    return min(one.balise_id, other.balise_id), max(one.balise_id, other.balise_id)


def _points(balises: pl.DataFrame, network: Network) -> dict[int, list[_Point]]:
    """Balises of one kind by oriented element, in the order in which a train meets them."""
    points: dict[int, list[_Point]] = {}
    columns = ("balise_id", "netelement_id", "measure_m", "location_accuracy_m")
    for name, netelement_id, measure_m, accuracy_m in balises.select(columns).iter_rows():
        element = network.track.index.get(netelement_id)
        if element is None:
            continue
        measures = network.track.measure_m[network.track.vertices(element)]
        along_m, back_m = measure_m - float(measures[0]), float(measures[-1]) - measure_m
        for oriented, at_m in ((2 * element, along_m), (2 * element + 1, back_m)):
            points.setdefault(oriented, []).append(_Point(name, element, accuracy_m, at_m))
    return {
        oriented: sorted(on_it, key=lambda point: (point.at_m, point.balise_id)) for oriented, on_it in points.items()
    }


_Met = tuple[_Point, float]
"""A balise with its distance from the reference [m]."""


def _ahead(network: Network, points: dict[int, list[_Point]], oriented: int, index: int) -> Iterator[tuple[_Met, _Met]]:
    """The next two balises on each way ahead of one."""
    reference = points[oriented][index]
    waiting: list[tuple[int, float, int, tuple[_Met, ...]]] = [(oriented, -reference.at_m, index + 1, ())]
    seen: set[tuple[int, tuple[str, ...]]] = set()
    while waiting:
        here, entry_m, first, met = waiting.pop()
        key = here, tuple(point.balise_id for point, _ in met)
        if key in seen or entry_m > _REACH_M:
            continue
        seen.add(key)
        met = (*met, *((point, entry_m + point.at_m) for point in points.get(here, [])[first:]))[:2]
        if len(met) == 2:
            yield met[0], met[1]
            continue
        exit_m = entry_m + network.length_m(here)
        waiting += [(edge.to, exit_m + edge.gap_m, 0, met) for edge in network.successors[here] if edge.forward]


def _judge(reference: _Point, near: _Met, far: _Met, config: LdsConfig) -> Finding | None:
    (expected, distance_m), (later, later_m) = near, far
    close_m = window_m(distance_m, expected.accuracy_m, reference.accuracy_m, config).close_m
    open_m = window_m(later_m, later.accuracy_m, reference.accuracy_m, config).open_m
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
