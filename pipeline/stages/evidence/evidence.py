"""Where the train was at any instants: every track and interval that the evidence leaves (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.evidence import anchors
from pipeline.stages.evidence.anchors import KnownPath, KnownStretch
from pipeline.stages.evidence.carrying import Counter, Interval, TrueAnchor, between_anchors, carried
from pipeline.stages.evidence.clock import RecorderClock, RecorderLag, clock_of, lag_of
from pipeline.stages.evidence.gaps import Carried, Gap, GapChain, GapSearch
from pipeline.stages.odometry import Odometry
from pipeline.stages.reference import ReferenceStretch
from pipeline.stages.track.network import Network
from pipeline.stages.track.path import RoutePath
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.enums import Evidence as Kind

KINDS = tuple(Kind)
NOTHING = -1
Span = tuple[int, int]


@dataclass(frozen=True)
class Alternative:
    """One track that the train may have been on at some of the instants, and where on it [m]."""

    rows: Ints
    route: RoutePath
    low_m: Floats
    high_m: Floats

    @property
    def middle_m(self) -> Floats:
        return 0.5 * (self.low_m + self.high_m)

    def where(self, kept: Bools | Ints) -> Alternative:
        """At some of its instants only."""
        return Alternative(self.rows[kept], self.route, self.low_m[kept], self.high_m[kept])

    def widened(self, factor: float) -> Alternative:
        half_m = 0.5 * factor * (self.high_m - self.low_m)
        return Alternative(self.rows, self.route, self.middle_m - half_m, self.middle_m + half_m)


@dataclass(frozen=True)
class EvidenceSet:
    """Evidence at instants: where there are several alternatives the train was on one of them.

    `kind`: number in `KINDS`, -1 where nothing is known.
    """

    kind: Ints
    alternatives: tuple[Alternative, ...]


@dataclass(frozen=True)
class TrainEvidence:
    """All evidence of a run.

    `silent`: times with reference samples that lie on no track. `carried`: by each odometer from reads and the ends of
    the reference, outside its time; `by_reads`: from reads alone, over the whole run. `stood`: times over which the
    odometer carries nothing from one side.
    """

    stretches: tuple[KnownStretch, ...]
    silent: tuple[Span, ...]
    carried: tuple[Carried, ...]
    by_reads: tuple[Carried, ...]
    reads_ns: Ints
    clocks: tuple[RecorderClock, ...]
    network: Network
    config: Configuration
    stood: tuple[Span, ...] = ()

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Those of the odometer of the LDS."""
        return self.carried[0].gaps if self.carried else ()

    @property
    def contradicted(self) -> int:
        """Gaps between anchors whose length by the odometer, scaled by the vehicle file, fits no way on the track."""
        by_file = bool(self.carried) and self.carried[0].counter.by_file
        return sum(bool(gap.ways) and len(gap.anchors) == 2 and not gap.closed for gap in self.gaps if by_file)

    @property
    def unreachable(self) -> int:
        """Pairs of anchors that no train can have passed one after the other."""
        return sum(gap.unreachable for gap in self.gaps)

    @property
    def disputed(self) -> int:
        """Reads that exclude the reference at k_T sigmas: at k = 3 noise alone would do so in a long run."""
        t_ns = self.reads_ns
        anywhere = np.ones(t_ns.size, dtype=np.bool_)
        factor = self.config.align.sure_sigmas / self.config.hazards.evidence_factor
        kind = np.full(t_ns.size, NOTHING)
        by_reference = [there.widened(factor) for there in self._covered(t_ns, anywhere, kind)]
        # Outside the time of the reference there is nothing to exclude.
        by_reads = [there.widened(factor) for there in self._carried(self.by_reads, t_ns, kind != NOTHING, kind)]
        return int(common(by_reference, by_reads, t_ns.size)[1].size)

    @property
    def clock_assumed(self) -> bool:
        """The clock of reference or reads against the odometer's could not be measured."""
        return any(clock.assumed for clock in self.clocks)

    @property
    def anchored_ns(self) -> Span | None:
        """First and last anchor; None without anchors."""
        times = [anchor.t_ns for gap in self.gaps for anchor in gap.anchors]
        times += [int(t_ns) for stretch in self.stretches for t_ns in stretch.t_ns[[0, -1]]]
        return (min(times), max(times)) if times else None

    def at(self, t_ns: Ints) -> EvidenceSet:
        """Evidence at these instants; nothing is carried from one side over a stand of the odometer (`stood`)."""
        kind = np.full(t_ns.size, NOTHING)
        heard = ~within_spans(t_ns, self.silent)
        alternatives = self._covered(t_ns, heard, kind)
        alternatives += self._carried(self.carried, t_ns, heard & (kind == NOTHING), kind)
        if self.stretches and self.by_reads:
            of_reads = np.full(t_ns.size, NOTHING)
            by_reads = self._carried(self.by_reads, t_ns, heard, of_reads)
            alternatives, _ = common(alternatives, by_reads, t_ns.size)
            kind = np.where(kind == NOTHING, of_reads, kind)
        return EvidenceSet(kind, tuple(alternatives))

    def _covered(self, t_ns: Ints, heard: Bools, kind: Ints) -> list[Alternative]:
        """By the reference; writes into `kind` where it speaks."""
        alternatives: list[Alternative] = []
        for stretch in self.stretches:
            rows = np.flatnonzero((t_ns >= stretch.t_ns[0]) & (t_ns <= stretch.t_ns[-1]) & heard)
            for path in stretch.paths:
                for there in _on_path(stretch, path, rows, t_ns[rows], self.config.hazards.evidence_factor):
                    alternatives.append(there)
                    kind[there.rows] = KINDS.index(Kind.REFERENCE)
        return alternatives

    def _carried(self, sources: Sequence[Carried], t_ns: Ints, wanted: Bools, kind: Ints) -> list[Alternative]:
        """By each odometer, from the anchors of its gaps: the train was where one of them says; writes into `kind`."""
        alternatives: list[Alternative] = []
        for source in sources:
            open_rows = wanted.copy()
            for gap in source.gaps:
                inside = (t_ns >= gap.begin_ns) & (t_ns <= gap.end_ns) & open_rows
                if len(gap.anchors) == 1:
                    inside &= ~_after_standing(t_ns, gap, self.stood)
                rows = np.flatnonzero(inside)
                for way in gap.ways or [] if rows.size else []:
                    low_m, high_m = self._interval(source.counter, gap, way, t_ns[rows])
                    there = Alternative(rows, way.chain.route(self.network), low_m, high_m).where(np.isfinite(low_m))
                    alternatives.append(there)
                    open_rows[there.rows] = False
                    by_read = any(anchor.kind is Kind.BALISE for anchor in gap.anchors)
                    kind[there.rows] = KINDS.index(Kind.BALISE if by_read else Kind.REFERENCE)
        return alternatives

    def _interval(self, counter: Counter, gap: Gap, way: GapChain, t_ns: Ints) -> Interval:
        if gap.begin is not None and gap.end is not None:
            return between_anchors(counter, (gap.begin, gap.end), (way.at_m[0], way.at_m[1]), t_ns, self.config)
        return carried(counter, gap.anchors[0], way.at_m[0], t_ns, self.config)


def _on_path(stretch: KnownStretch, path: KnownPath, rows: Ints, t_ns: Ints, factor: float) -> list[Alternative]:
    """Straight lines between samples, each +- (k sigma + speed times clock), leg by leg; `rows`: of the instants."""
    after = np.searchsorted(stretch.t_ns, t_ns, side="left")
    before = np.where(stretch.t_ns[after] == t_ns, after, np.maximum(after - 1, 0))
    half_m = factor * stretch.sigma_m + stretch.clock_m
    since_ns = (t_ns - stretch.t_ns[0]).astype(np.float64)
    centre_m = np.interp(since_ns, stretch.t_ns - stretch.t_ns[0], path.at_m)
    behind_m = path.low_m - path.at_m
    ahead_m = path.high_m - path.at_m
    # No straight line leads over a contradicted step: its moment is not known.
    stepping_m = np.where(before != after, path.step_m[before], 0.0)
    widest_m = np.maximum(half_m[before], half_m[after])
    low_m = centre_m + (np.minimum(behind_m[before], behind_m[after]) - stepping_m) - widest_m
    high_m = centre_m + (np.maximum(ahead_m[before], ahead_m[after]) + stepping_m) + widest_m
    leg = path.path.leg
    return [
        Alternative(rows, path.path.legs[number], low_m, high_m).where((leg[before] == number) & (leg[after] == number))
        for number in np.unique(leg[before]).tolist()
    ]


def common(first: Sequence[Alternative], second: Sequence[Alternative], size: int) -> tuple[list[Alternative], Ints]:
    """Two sources of evidence together, and the instants at which they exclude each other.

    Where they agree: the net elements common to both, with the narrower interval. Where only one speaks, or they
    exclude each other, every alternative of either stays possible.
    """
    narrowed = [_narrowed(left, right) for left in first for right in second]
    agreed = _spoken(narrowed, size)
    alone = [alternative.where(~agreed[alternative.rows]) for alternative in (*first, *second)]
    return narrowed + alone, np.flatnonzero(_spoken(first, size) & _spoken(second, size) & ~agreed)


def _spoken(alternatives: Sequence[Alternative], size: int) -> Bools:
    spoken = np.zeros(size, dtype=np.bool_)
    for alternative in alternatives:
        spoken[alternative.rows] = True
    return spoken


def _narrowed(first: Alternative, second: Alternative) -> Alternative:
    """Where the intervals of both overlap, at the instants of both; in coordinates of the first's route."""
    _, in_first, in_second = np.intersect1d(first.rows, second.rows, assume_unique=True, return_indices=True)
    first = first.where(in_first)
    second = second.where(in_second)
    element, measure_m, sense = first.route.locate(first.middle_m)
    at_m, along = second.route.coordinate(element, measure_m, second.middle_m)
    ends_m = [first.middle_m + sense * along * (end_m - at_m) for end_m in (second.low_m, second.high_m)]
    low_m = np.maximum(first.low_m, np.minimum(*ends_m))
    high_m = np.minimum(first.high_m, np.maximum(*ends_m))
    return Alternative(first.rows, first.route, low_m, high_m).where(low_m <= high_m)


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
    reference: tuple[Sequence[ReferenceStretch], Sequence[Span]],
    reads: pl.DataFrame | None,
    balises: pl.DataFrame | None,
    odometers: Sequence[Odometry],
    network: Network,
    vehicle: Vehicle,
    config: Configuration,
) -> TrainEvidence:
    """Everything that is known of where the train was, except from GNSS.

    `reference`: as from `reference_stretches`; `odometers`: that of the LDS first.
    """
    hazards = config.hazards
    by_file = vehicle.gnss_latency_s is not None
    counters = [Counter.of(odometer) for odometer in odometers]
    main = counters[0] if counters else None
    least_m = config.matching.orientation_distance_m
    sides = [anchors.sided(stretch, main, least_m) for stretch in reference[0]]
    facing = frozenset(side.facing for side in sides if abs(side.with_m - side.against_m) >= least_m)
    turned = any(min(side.with_m, side.against_m) >= least_m for side in sides)
    searches = [GapSearch(counter, network, config, facing, turned) for counter in counters]
    of_reference = clock_of(anchors.reference_lag(sides, main), by_file, hazards)
    recorded = anchors.read_anchors(reads, balises, network.track, hazards)
    lag_of_reads = RecorderLag() if main is None else _lag_of_reads(searches[0].carried(_points(recorded)))
    of_reads = clock_of(lag_of_reads, by_file, hazards)
    clocked = [] if main is None else anchors.on_clock(recorded, of_reads, main)
    ahead_m = vehicle.gnss_antenna_ahead_m
    stretches = tuple(anchors.known_stretch(side, of_reference, counters, clocked, ahead_m, config) for side in sides)
    apart = anchors.outside(clocked, stretches)
    shift_ns = round(of_reference.shift_s * NS_PER_S)
    return TrainEvidence(
        stretches=stretches,
        silent=tuple((begin_ns - shift_ns, end_ns - shift_ns) for begin_ns, end_ns in reference[1]),
        carried=tuple(
            search.carried([*(stretch.ends(search.counter) for stretch in stretches), *_points(apart)])
            for search in searches
        ),
        by_reads=tuple(search.carried(_points(clocked)) for search in searches) if stretches else (),
        reads_ns=np.array([anchor.t_ns for anchor in clocked], dtype=np.int64),
        clocks=(of_reference,) * bool(stretches) + (of_reads,) * bool(apart),
        network=network,
        config=config,
    )


def _points(known: Sequence[TrueAnchor]) -> list[tuple[TrueAnchor, TrueAnchor]]:
    return [(anchor, anchor) for anchor in known]


def _lag_of_reads(source: Carried) -> RecorderLag:
    """The clock of the reads against the odometer's, by the ways between reads that one closed chain leaves."""
    ways = [(gap.begin_ns, gap.end_ns, way.apart_m) for gap in source.gaps for way in gap.alone]
    begins, ends, lengths = zip(*ways, strict=True) if ways else ((), (), ())
    return lag_of(np.array(begins, np.int64), np.array(ends, np.int64), np.array(lengths, np.float64), source.counter)
