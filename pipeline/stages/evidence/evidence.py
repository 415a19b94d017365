"""Where the train was at any instants: every track and interval that the evidence leaves (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from pipeline.stages.evidence.anchors import (
    KnownStretch,
    Sided,
    known_stretch,
    on_clock,
    outside,
    read_anchors,
    reference_lag,
    sided,
)
from pipeline.stages.evidence.carrying import Counter, Interval, TrueAnchor, between_anchors, carried
from pipeline.stages.evidence.clock import RecorderClock, RecorderLag, clock_of, lag_of
from pipeline.stages.evidence.gaps import Gap, GapChain, gaps_of, unreachable, without_sign
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

    def where(self, kept: Bools) -> Alternative:
        """At some of its instants only."""
        return Alternative(self.rows[kept], self.route, self.low_m[kept], self.high_m[kept])

    def widened(self, factor: float) -> Alternative:
        half_m = 0.5 * factor * (self.high_m - self.low_m)
        return Alternative(self.rows, self.route, self.middle_m - half_m, self.middle_m + half_m)


@dataclass(frozen=True)
class EvidenceSet:
    """Evidence at instants: where there are several alternatives the train was on one of them.

    `kind`: number in `KINDS`, -1 where nothing is known; `disputed`: where reference and reads exclude each other.
    """

    kind: Ints
    alternatives: tuple[Alternative, ...]
    disputed: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


@dataclass(frozen=True)
class Carried:
    """What one odometer carries from anchors, by its gaps."""

    counter: Counter
    gaps: tuple[Gap, ...]


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
    def contradicted(self) -> int:
        """Gaps between anchors whose length by the odometer, scaled by the vehicle file, fits no way on the track."""
        by_file = [carried.gaps for carried in self.carried[:1] if carried.counter.by_file]
        return sum(bool(gap.ways) and len(gap.anchors) == 2 and not gap.closed for gaps in by_file for gap in gaps)

    @property
    def unreachable(self) -> int:
        """Pairs of anchors that no train can have passed one after the other."""
        return sum(len(unreachable(carried.gaps)) for carried in self.carried[:1])

    @property
    def disputed(self) -> int:
        """Reads that exclude the reference at k_T sigmas: at k = 3 noise alone would do so in a long run."""
        t_ns = self.reads_ns
        kind = np.full(self.reads_ns.size, NOTHING)
        factor = self.config.align.sure_sigmas / self.config.hazards.evidence_factor
        by_reference = self._covered(t_ns, kind == NOTHING, kind)
        by_reads = self._carried(self.by_reads, t_ns, kind != NOTHING, kind)
        wide_reference = [alternative.widened(factor) for alternative in by_reference]
        wide_reads = [alternative.widened(factor) for alternative in by_reads]
        return int(common(wide_reference, wide_reads, t_ns.size)[1].size)

    @property
    def clock_assumed(self) -> bool:
        """The clock of reference or reads against the odometer's could not be measured."""
        return any(clock.assumed for clock in self.clocks)

    @property
    def anchored_ns(self) -> Span | None:
        """First and last anchor; None without anchors."""
        times = [anchor.t_ns for carried in self.carried[:1] for gap in carried.gaps for anchor in gap.anchors]
        times += [int(t_ns) for carried in self.stretches for t_ns in carried.t_ns[[0, -1]]]
        return (min(times), max(times)) if times else None

    def at(self, t_ns: Ints) -> EvidenceSet:
        """Evidence at these instants; nothing is carried from one side over a stand of the odometer (`stood`)."""
        kind = np.full(t_ns.size, NOTHING)
        heard = ~within_spans(t_ns, self.silent)
        alternatives = self._covered(t_ns, heard, kind)
        alternatives += self._carried(self.carried, t_ns, heard & (kind == NOTHING), kind)
        if not self.stretches or not self.by_reads:
            return EvidenceSet(kind, tuple(alternatives))
        of_reads = np.full(t_ns.size, NOTHING)
        by_reads = self._carried(self.by_reads, t_ns, heard, of_reads)
        both, disputed = common(alternatives, by_reads, t_ns.size)
        return EvidenceSet(np.where(kind == NOTHING, of_reads, kind), tuple(both), disputed=disputed)

    def _covered(self, t_ns: Ints, heard: Bools, kind: Ints) -> list[Alternative]:
        """By the reference: straight lines between samples, each +- (k sigma + speed times clock)."""
        factor = self.config.hazards.evidence_factor
        alternatives: list[Alternative] = []
        for stretch in self.stretches:
            rows = np.flatnonzero((t_ns >= stretch.t_ns[0]) & (t_ns <= stretch.t_ns[-1]) & heard)
            after = np.searchsorted(stretch.t_ns, t_ns[rows], side="left")
            before = np.where(stretch.t_ns[after] == t_ns[rows], after, np.maximum(after - 1, 0))
            half = factor * stretch.sigma_m + stretch.clock_m
            half = np.maximum(half[before], half[after])
            since = (t_ns[rows] - stretch.t_ns[0]).astype(np.float64)
            for path in stretch.paths:
                leg = path.path.leg
                stamps = stretch.t_ns - stretch.t_ns[0]
                centre = np.interp(since, stamps, path.at_m)
                low = np.minimum((path.low_m - path.at_m)[before], (path.low_m - path.at_m)[after])
                high = np.maximum((path.high_m - path.at_m)[before], (path.high_m - path.at_m)[after])
                # No straight line leads over a contradicted step: its moment is not known.
                stepping = np.where(before != after, path.step_m[before], 0.0)
                low = low - stepping
                high = high + stepping
                for number in np.unique(leg[before]).tolist():
                    on_leg = np.flatnonzero((leg[before] == number) & (leg[after] == number))
                    low_m = (centre + low - half)[on_leg]
                    high_m = (centre + high + half)[on_leg]
                    alternatives.append(Alternative(rows[on_leg], path.path.legs[number], low_m, high_m))
                    kind[rows[on_leg]] = KINDS.index(Kind.REFERENCE)
        return alternatives

    def _carried(self, sources: Sequence[Carried], t_ns: Ints, wanted: Bools, kind: Ints) -> list[Alternative]:
        """By each odometer, from the anchors of its gaps: the train was where one of them says."""
        alternatives: list[Alternative] = []
        for source in sources:
            open_rows = wanted.copy()
            for gap in source.gaps:
                inside = (t_ns >= gap.begin_ns) & (t_ns <= gap.end_ns) & open_rows
                if len(gap.anchors) == 1:
                    inside &= ~_after_standing(t_ns, gap, self.stood)
                rows = np.flatnonzero(inside)
                for way in gap.ways or [] if rows.size else []:
                    low, high = self._interval(source.counter, gap, way, t_ns[rows])
                    reached = np.isfinite(low)
                    route = way.chain.route(self.network)
                    alternatives.append(Alternative(rows[reached], route, low[reached], high[reached]))
                    open_rows[rows[reached]] = False
                    by_read = any(anchor.kind is Kind.BALISE for anchor in gap.anchors)
                    kind[rows[reached]] = KINDS.index(Kind.BALISE if by_read else Kind.REFERENCE)
        return alternatives

    def _interval(self, counter: Counter, gap: Gap, way: GapChain, t_ns: Ints) -> Interval:
        if gap.begin is not None and gap.end is not None:
            begin_m, end_m = way.at_m
            return between_anchors(counter, (gap.begin, gap.end), (begin_m, end_m), t_ns, self.config)
        (anchor,) = gap.anchors
        (at_m,) = way.at_m
        return carried(counter, anchor, at_m, t_ns, self.config)


def common(first: Sequence[Alternative], second: Sequence[Alternative], size: int) -> tuple[list[Alternative], Ints]:
    """Two sources of evidence together, and the instants at which they exclude each other.

    Where they agree: the net elements common to both, with the narrower interval. Where only one speaks, or they
    exclude each other, every alternative of either stays possible.
    """
    spoken = np.zeros((2, size), dtype=np.bool_)
    for source, alternatives in enumerate((first, second)):
        for alternative in alternatives:
            spoken[source, alternative.rows] = True
    narrowed = [_narrowed(left, right) for left in first for right in second]
    agreed = np.zeros(size, dtype=np.bool_)
    for alternative in narrowed:
        agreed[alternative.rows] = True
    alone = [alternative.where(~agreed[alternative.rows]) for alternative in (*first, *second)]
    return narrowed + alone, np.flatnonzero(spoken.all(axis=0) & ~agreed)


def _narrowed(first: Alternative, second: Alternative) -> Alternative:
    """Where the intervals of both overlap, at the instants of both; in coordinates of the first's route."""
    _, in_first, in_second = np.intersect1d(first.rows, second.rows, assume_unique=True, return_indices=True)
    first = Alternative(first.rows[in_first], first.route, first.low_m[in_first], first.high_m[in_first])
    second = Alternative(second.rows[in_second], second.route, second.low_m[in_second], second.high_m[in_second])
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
    sides = [sided(stretch, main, config.matching.orientation_distance_m) for stretch in reference[0]]
    carrier = _Carrier.of(sides, network, config)
    of_reference = clock_of(reference_lag(sides, main), by_file, hazards)
    recorded_reads = read_anchors(reads, balises, network.track, hazards)
    lag_of_reads = RecorderLag() if main is None else _lag_of_reads(carrier.by(main, _points(recorded_reads)))
    of_reads = clock_of(lag_of_reads, by_file, hazards)
    clocked_reads = [] if main is None else on_clock(recorded_reads, of_reads, main)
    reads_ns = np.array([stretch.t_ns for stretch in clocked_reads], dtype=np.int64)
    ahead_m = vehicle.gnss_antenna_ahead_m
    stretches = tuple(known_stretch(side, of_reference, counters, clocked_reads, ahead_m, config) for side in sides)
    reads_apart = outside(clocked_reads, stretches)
    shift_ns = round(of_reference.shift_s * NS_PER_S)
    return TrainEvidence(
        stretches=stretches,
        silent=tuple((begin_ns - shift_ns, end_ns - shift_ns) for begin_ns, end_ns in reference[1]),
        carried=tuple(
            carrier.by(counter, [*(stretch.ends(counter) for stretch in stretches), *_points(reads_apart)])
            for counter in counters
        ),
        by_reads=tuple(carrier.by(counter, _points(clocked_reads)) for counter in counters) if stretches else (),
        reads_ns=reads_ns,
        clocks=(of_reference,) * bool(stretches) + (of_reads,) * bool(reads_apart),
        network=network,
        config=config,
    )


def _points(anchors: Sequence[TrueAnchor]) -> list[tuple[TrueAnchor, TrueAnchor]]:
    return [(anchor, anchor) for anchor in anchors]


@dataclass(frozen=True)
class _Carrier:
    """What every odometer carries over: the network, and which way the train ran as the odometer of the LDS counted up.

    `facing`: oriented net elements; `turned`: it counted up in both directions.
    """

    network: Network
    config: Configuration
    facing: frozenset[int]
    turned: bool

    @classmethod
    def of(cls, sides: Sequence[Sided], network: Network, config: Configuration) -> _Carrier:
        least_m = config.matching.orientation_distance_m
        facing = frozenset(side.facing for side in sides if abs(side.with_m - side.against_m) >= least_m)
        return cls(network, config, facing, any(min(side.with_m, side.against_m) >= least_m for side in sides))

    def by(self, counter: Counter, borders: list[tuple[TrueAnchor, TrueAnchor]]) -> Carried:
        """The gaps between what is known; an odometer that counts up in both directions carries over no stand."""
        if not borders:
            return Carried(counter, ())
        borders = sorted(borders, key=lambda border: border[0].t_ns)
        gaps = gaps_of(borders, self.facing, counter, self.network, self.config)
        if self.turned or without_sign(gaps, self.facing, self.network):
            counter = Counter.of(counter.odometer, without_sign=True)
            gaps = gaps_of(borders, self.facing, counter, self.network, self.config)
        return Carried(counter, tuple(gaps))


def _lag_of_reads(source: Carried) -> RecorderLag:
    """The clock of the reads against the odometer's, by the ways between reads that one closed chain leaves."""
    between = [(gap.begin_ns, gap.end_ns, way.at_m[1] - way.at_m[0]) for gap in source.gaps for way in gap.alone]
    begins, ends, ways = zip(*between, strict=True) if between else ((), (), ())
    return lag_of(np.array(begins, np.int64), np.array(ends, np.int64), np.array(ways, np.float64), source.counter)
