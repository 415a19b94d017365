"""Where the train was at any instants: every track and interval that the evidence leaves (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.evidence.anchors import (
    Coverage,
    ReferencePlaces,
    coverages,
    disputed_by,
    facing_of,
    lost_spans,
    read_anchors,
)
from pipeline.evidence.carrying import Interval, between_anchors, carried, closes
from pipeline.evidence.gaps import Gap, Way, gaps_of, unreachable
from pipeline.odometry import Odometry
from pipeline.track.network import Network
from pipeline.track.path import Route
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration
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
    """All evidence of a run; `contradicted`: gaps that the odometer of a vehicle file does not close.

    `unknown`: times at which nobody knows, because the reference lay nowhere, or reads contradict it (`disputed`).
    """

    reference: ReferencePlaces | None
    covered: tuple[Coverage, ...]
    gaps: tuple[Gap, ...]
    odometer: Odometry | None
    network: Network
    config: Configuration
    contradicted: int
    unknown: tuple[Span, ...]
    disputed: int

    @property
    def clock_assumed(self) -> bool:
        """The clock of reference or reads against the odometer's could not be measured, and is taken as close."""
        return False

    @property
    def anchored_ns(self) -> Span | None:
        """First and last anchor: beyond them nothing holds the train from the other side; none without anchors."""
        times = [anchor.t_ns for gap in self.gaps for anchor in gap.anchors]
        times += [anchor.t_ns for coverage in self.covered for anchor in (coverage.begin, coverage.end)]
        return (min(times), max(times)) if times else None

    @property
    def unreachable(self) -> int:
        """Pairs of anchors that no train can have passed one after the other."""
        return len(unreachable(self.gaps))

    def at(self, t_ns: Ints, stood: Sequence[Span] = ()) -> EvidenceSet:
        """Evidence at these instants.

        `stood`: when the odometer stood although the train may have moved; there nothing is carried from one side.
        """
        kind, void = np.full(t_ns.size, NOTHING), within_spans(t_ns, self.unknown)
        alternatives: list[Alternative] = []
        rivals: list[tuple[Ints, Ints]] = []
        for coverage in self.covered:
            alternatives += self._covered(coverage, t_ns, void, kind, rivals)
        for gap in self.gaps:
            alternatives += self._carried(gap, t_ns, void, kind, stood)
        rows, elements = (np.concatenate([part[i] for part in rivals] or [np.zeros(0, np.int64)]) for i in (0, 1))
        return EvidenceSet(kind, tuple(alternatives), rows, elements)

    def _covered(
        self, coverage: Coverage, t_ns: Ints, void: Bools, kind: Ints, rivals: list[tuple[Ints, Ints]]
    ) -> list[Alternative]:
        """By the reference: straight lines between samples, each with its own sigma."""
        assert self.reference is not None
        part = slice(coverage.first, coverage.last + 1)
        times, leg = self.reference.t_ns[part], self.reference.leg[part]
        rows = np.flatnonzero((t_ns >= times[0]) & (t_ns <= times[-1]) & ~void)
        after = np.searchsorted(times, t_ns[rows], side="left")
        before = np.where(times[after] == t_ns[rows], after, np.maximum(after - 1, 0))
        whole = leg[before] == leg[after]
        rows, before, after = rows[whole], before[whole], after[whole]
        at_m = np.interp((t_ns[rows] - times[0]).astype(np.float64), times - times[0], self.reference.path_m[part])
        sigma = self.reference.sigma_m[part]
        half = self.config.hazards.evidence_factor * np.maximum(sigma[before], sigma[after])
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

    def _carried(self, gap: Gap, t_ns: Ints, void: Bools, kind: Ints, stood: Sequence[Span]) -> list[Alternative]:
        """By the odometer, from the anchors of a gap."""
        inside = (t_ns >= gap.begin_ns) & (t_ns <= gap.end_ns) & (kind == NOTHING) & ~void
        if len(gap.anchors) == 1:
            inside &= ~_after_standing(t_ns, gap, stood)
        rows, found = np.flatnonzero(inside), []
        for way in gap.ways or [] if rows.size else []:
            low, high = self._interval(gap, way, t_ns[rows])
            reached = np.isfinite(low)
            found.append(Alternative(rows[reached], way.chain.route(self.network), low[reached], high[reached]))
        if found:
            kinds = {anchor.kind for anchor in gap.anchors}
            kind[found[0].rows] = KINDS.index(Kind.BALISE if Kind.BALISE in kinds else Kind.REFERENCE)
        return found

    def _interval(self, gap: Gap, way: Way, t_ns: Ints) -> Interval:
        assert self.odometer is not None
        if gap.begin is not None and gap.end is not None:
            begin_m, end_m = way.at_m
            return between_anchors(self.odometer, (gap.begin, gap.end), (begin_m, end_m), t_ns, self.config)
        (anchor,), (at_m,) = gap.anchors, way.at_m
        return carried(self.odometer, anchor.t_ns, at_m, anchor.sigma_m, t_ns, self.config)


def within_spans(t_ns: Ints, spans: Sequence[Span]) -> Bools:
    """Instants of the spans, their ends left out."""
    inside = np.zeros(t_ns.size, dtype=np.bool_)
    for begin_ns, end_ns in spans:
        inside |= (t_ns >= begin_ns) & (t_ns < end_ns)
    return inside


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
    odometer: Odometry | None,
    network: Network,
    config: Configuration,
) -> Evidence:
    """Everything that is known of where the train was, but from GNSS.

    `reference`: placed on the network by itself; `reads`, `balises`: as in the run and the site; `odometer`: as
    recorded. Anchors are the reads outside the reference's time, and the reference's samples beside its pauses.
    """
    hazards = config.hazards
    read = read_anchors(reads, balises, network.track, hazards)
    covered, disputed, unknown = coverages(reference, odometer, hazards), 0, lost_spans(reference, hazards)
    if reference is not None:
        counts = {one: disputed_by(one, reference, read, hazards) for one in covered}
        disputed = sum(counts.values())
        for one in [one for one in covered if counts[one]]:
            covered.remove(one)
            unknown.append((int(reference.t_ns[one.first]), int(reference.t_ns[one.last]) + 1))
    apart = [one for one in read if not any(c.begin.t_ns <= one.t_ns <= c.end.t_ns for c in covered)]
    borders = sorted(
        [(c.begin, c.end) for c in covered] + [(one, one) for one in apart], key=lambda border: border[0].t_ns
    )
    gaps: list[Gap] = []
    if odometer is not None and borders:
        least_m = config.matching.orientation_distance_m
        facing = set() if reference is None else facing_of(reference, covered, odometer, least_m)
        gaps = gaps_of(borders, facing, odometer, network, config)
    contradicted = sum(_contradicts(gap, odometer, config) for gap in gaps)
    return Evidence(
        reference, tuple(covered), tuple(gaps), odometer, network, config, contradicted, tuple(unknown), disputed
    )


def _contradicts(gap: Gap, odometer: Odometry | None, config: Configuration) -> bool:
    """An odometer with the scale of a vehicle file that closes on none of the chains between two anchors."""
    if gap.begin is None or gap.end is None or not gap.ways or odometer is None or odometer.scale is None:
        return False
    anchors = (gap.begin, gap.end)
    return not any(closes(odometer, anchors, way.at_m[1] - way.at_m[0], config) for way in gap.ways)
