"""Where the train was at any instants: every track and interval that the evidence leaves (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import polars as pl

from pipeline.evidence.anchors import Coverage, ReferencePlaces, coverages, read_anchors
from pipeline.evidence.carrying import (
    Anchor,
    Figures,
    OdometerReadings,
    Readings,
    beside_anchor,
    between_anchors,
    closes,
)
from pipeline.evidence.gaps import Gap, Way, gap_between, oriented_alike, routes_of, with_open_ends
from pipeline.evidence.routes import Route
from pipeline.track.network import Network
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.enums import Evidence as Kind

KINDS = tuple(Kind)
NOTHING = -1
Span = tuple[int, int]


@dataclass(frozen=True)
class Alternative:
    """One track that the train may have been on at some of the instants, and where on it [m]."""

    rows: Ints
    route: Route
    low_m: Floats
    high_m: Floats


@dataclass(frozen=True)
class EvidenceSet:
    """Evidence at instants: `kind` is the number in `KINDS`, -1 where nothing is known.

    Where there are several alternatives at an instant the train was on one of them. `rival_row`, `rival_element`:
    further net elements that it may have been on, whose place along the track is not known.
    """

    kind: Ints
    alternatives: tuple[Alternative, ...]
    rival_row: Ints
    rival_element: Ints


@dataclass(frozen=True)
class Evidence:
    """All evidence of a run; `contradicted`: gaps that the odometer of a vehicle file does not close."""

    reference: ReferencePlaces | None
    covered: tuple[Coverage, ...]
    gaps: tuple[Gap, ...]
    odometry: OdometerReadings | None
    network: Network
    figures: Figures
    contradicted: int

    def at(self, t_ns: Ints, stood: Sequence[Span] = ()) -> EvidenceSet:
        """Evidence at these instants, in order of time.

        `stood`: when the odometer stood although the train may have moved; there nothing is carried from one side.
        """
        kind = np.full(t_ns.size, NOTHING)
        alternatives: list[Alternative] = []
        rivals: list[tuple[Ints, Ints]] = []
        for coverage in self.covered:
            alternatives += self._covered(coverage, t_ns, kind, rivals)
        readings = Readings.of(self.odometry, t_ns)
        for gap in self.gaps:
            alternatives += self._carried(gap, readings, kind, stood)
        rows, elements = (np.concatenate([part[i] for part in rivals] or [np.zeros(0, np.int64)]) for i in (0, 1))
        return EvidenceSet(kind, tuple(alternatives), rows, elements)

    def _covered(
        self, coverage: Coverage, t_ns: Ints, kind: Ints, rivals: list[tuple[Ints, Ints]]
    ) -> list[Alternative]:
        """By the reference: straight lines between samples, each with its own sigma."""
        assert self.reference is not None
        part = slice(coverage.first, coverage.last + 1)
        times, leg = self.reference.t_ns[part], self.reference.leg[part]
        rows = np.flatnonzero((t_ns >= times[0]) & (t_ns <= times[-1]))
        after = np.searchsorted(times, t_ns[rows], side="left")
        before = np.where(times[after] == t_ns[rows], after, np.maximum(after - 1, 0))
        whole = leg[before] == leg[after]
        rows, before, after = rows[whole], before[whole], after[whole]
        at_m = np.interp((t_ns[rows] - times[0]).astype(np.float64), times - times[0], self.reference.path_m[part])
        sigma = self.reference.sigma_m[part]
        half = self.figures.factor * np.maximum(sigma[before], sigma[after])
        kind[rows] = KINDS.index(Kind.REFERENCE)
        rivals.append(self._rivals(coverage.first + before, coverage.first + after, rows))
        legs = leg[before]
        return [
            Alternative(rows[own], self.reference.legs[number], (at_m - half)[own], (at_m + half)[own])
            for number in np.unique(legs).tolist()
            if (own := np.flatnonzero(legs == number)).size
        ]

    def _rivals(self, before: Ints, after: Ints, rows: Ints) -> tuple[Ints, Ints]:
        """Further elements of both samples around each instant."""
        assert self.reference is not None
        found = [np.zeros((2, 0), dtype=np.int64)]
        for sample in (before, after):
            begin = np.searchsorted(self.reference.rival_sample, sample, side="left")
            count = np.searchsorted(self.reference.rival_sample, sample, side="right") - begin
            index = np.repeat(begin - np.concatenate([[0], np.cumsum(count)[:-1]]), count) + np.arange(count.sum())
            found.append(np.stack([np.repeat(rows, count), self.reference.rival_element[index]]))
        pairs = np.unique(np.concatenate(found, axis=1), axis=1)
        return pairs[0], pairs[1]

    def _carried(self, gap: Gap, readings: Readings, kind: Ints, stood: Sequence[Span]) -> list[Alternative]:
        """By the odometer, from the anchors of a gap."""
        inside = (readings.t_ns >= gap.begin_ns) & (readings.t_ns <= gap.end_ns) & (readings.segment != NOTHING)
        inside &= kind == NOTHING
        for anchor in gap.anchors:
            inside &= readings.segment == anchor.segment
        if gap.begin is None or gap.end is None:
            inside &= ~_after_standing(readings.t_ns, gap, stood)
        rows = np.flatnonzero(inside)
        if rows.size == 0 or not gap.ways:
            return []
        kinds = {anchor.kind for anchor in gap.anchors}
        kind[rows] = KINDS.index(Kind.BALISE if Kind.BALISE in kinds else Kind.REFERENCE)
        own = readings.take(rows)
        return [
            Alternative(rows, route, *_interval(gap, way, own, self.figures))
            for way, route in routes_of(gap, self.network)
        ]


def _interval(gap: Gap, way: Way, readings: Readings, figures: Figures) -> tuple[Floats, Floats]:
    if gap.begin is not None and gap.end is not None and way.begin_m is not None and way.end_m is not None:
        return between_anchors(gap.begin, gap.end, (way.begin_m, way.end_m), readings, figures)
    if gap.begin is not None and way.begin_m is not None:
        return beside_anchor(gap.begin, way.begin_m, readings, figures)
    assert gap.end is not None
    assert way.end_m is not None
    return beside_anchor(gap.end, way.end_m, readings, figures)


def _after_standing(t_ns: Ints, gap: Gap, stood: Sequence[Span]) -> Bools:
    """Instants to which nothing can be carried, because the odometer stood on the way from the anchor."""
    void = np.zeros(t_ns.size, dtype=np.bool_)
    for begin_ns, end_ns in stood:
        if gap.begin is not None and end_ns > gap.begin_ns:
            void |= t_ns >= begin_ns
        if gap.end is not None and begin_ns < gap.end_ns:
            void |= t_ns <= end_ns
    return void


def evidence_of(
    reference: ReferencePlaces | None,
    reads: pl.DataFrame | None,
    balises: pl.DataFrame | None,
    odometry: OdometerReadings | None,
    network: Network,
    vehicle: Vehicle,
    config: Configuration,
) -> Evidence:
    """Everything that is known of where the train was, but from GNSS.

    `reference`: placed on the network by itself; `reads`, `balises`: as in the run and the site; `odometry`: as
    recorded. Anchors are the reads outside the reference's time, and the reference's samples beside its pauses.
    """
    figures = Figures.of(vehicle, config)
    covered = coverages(reference, odometry, config.hazards)
    reads_apart = [
        anchor
        for anchor in read_anchors(reads, balises, network.track, odometry, config.hazards)
        if not any(one.begin.t_ns <= anchor.t_ns <= one.end.t_ns for one in covered)
    ]
    borders = sorted([(one.begin, one.end) for one in covered] + [(one, one) for one in reads_apart], key=_begin_ns)
    span_ns = (odometry.begin_ns, odometry.end_ns) if odometry is not None and borders else (0, 0)
    facing = {
        anchor: oriented
        for one in covered
        if one.facing is not None
        for anchor, oriented in zip((one.begin, one.end), one.facing, strict=True)
    }
    gaps = oriented_alike(_gaps(borders, span_ns, network, figures), facing, network) if odometry is not None else []
    contradicted = sum(_contradicts(gap, figures) for gap in gaps)
    reaching = with_open_ends(gaps, facing, odometry, network, figures)
    return Evidence(reference, tuple(covered), tuple(reaching), odometry, network, figures, contradicted)


def _begin_ns(border: tuple[Anchor, Anchor]) -> int:
    return border[0].t_ns


def _gaps(borders: list[tuple[Anchor, Anchor]], span_ns: Span, network: Network, figures: Figures) -> list[Gap]:
    """From the odometer's first instant to its last."""
    if not borders:
        return []
    first, last = borders[0][0], borders[-1][1]
    inner = [
        gap for (_, a), (b, _) in pairwise(borders) if b.t_ns > a.t_ns for gap in gap_between(a, b, network, figures)
    ]
    begin_ns, end_ns = span_ns
    before = Gap(min(begin_ns, first.t_ns), first.t_ns, None, first, [])
    return [before, *inner, Gap(last.t_ns, max(end_ns, last.t_ns), last, None, [])]


def _contradicts(gap: Gap, figures: Figures) -> bool:
    """An odometer with the figures of a vehicle file that closes on none of the chains between two anchors."""
    if gap.begin is None or gap.end is None or gap.ways is None or not figures.by_file:
        return False
    return not any(
        closes(gap.begin, gap.end, way.end_m - way.begin_m, figures)
        for way in gap.ways
        if way.begin_m is not None and way.end_m is not None
    )
