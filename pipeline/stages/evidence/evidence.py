"""Where the train was at any instants: every track and interval that the evidence leaves (DOMAIN section 5.1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from pipeline.stages.evidence.anchors import FinalStand, KnownStretch, held_at_stands
from pipeline.stages.evidence.carrying import (
    Interval,
    RecorderClock,
    SignedOdometer,
    carry_between_anchors,
    carry_from_anchor,
)
from pipeline.stages.evidence.contradictions import KnownPath
from pipeline.stages.evidence.gaps import CarriedGaps, Gap, GapChain
from pipeline.stages.track.network import Network
from pipeline.stages.track.path import RoutePath
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration
from schemas.enums import Evidence as Kind
from schemas.frozen import frozen

KINDS = tuple(Kind)
NOTHING = -1
Span = tuple[int, int]
# Clocks within this of each other are no whole seconds apart [s].
_IN_STEP_S = 0.5
# Two intervals agree from this share of the narrower one on.
_AGREES = 1.0 - 1.0 / np.sqrt(2.0)


@frozen
class Alternative:
    """One track that the train may have been on at some of the instants, and where on it [m]; `rows` in order."""

    rows: Ints
    route: RoutePath
    low_m: Floats
    high_m: Floats

    @property
    def middle_m(self) -> Floats:
        """Middle of the interval at each instant [m]."""
        return 0.5 * (self.low_m + self.high_m)

    def some_rows(self, kept: Bools | Ints | slice) -> Alternative:
        """The alternative at some of its instants only."""
        return Alternative(self.rows[kept], self.route, self.low_m[kept], self.high_m[kept])

    def between_rows(self, first: int, last: int) -> Alternative:
        """The alternative at its rows from one to another, both included."""
        return self.some_rows(slice(*np.searchsorted(self.rows, [first, last + 1]).tolist()))

    def wider_by(self, slack_m: Floats) -> Alternative:
        """The alternative, wider on both sides by a length at each instant [m]; `slack_m` by instant."""
        slack_m = slack_m[self.rows]
        return Alternative(self.rows, self.route, self.low_m - slack_m, self.high_m + slack_m)

    def wider_by_factor(self, factor: float) -> Alternative:
        """The alternative, its intervals so many times as wide."""
        half_m = 0.5 * factor * (self.high_m - self.low_m)
        return Alternative(self.rows, self.route, self.middle_m - half_m, self.middle_m + half_m)


@frozen
class EvidenceSet:
    """Evidence at instants: where there are several alternatives the train was on one of them.

    `kind`: number in `KINDS`, -1 where nothing is known. `proves`: by witnesses that are independent of the GNSS;
    `on_survey`: and that show that the track is one of the survey (DOMAIN section 5.0).
    """

    kind: Ints
    alternatives: tuple[Alternative, ...]
    proves: Bools
    on_survey: Bools


@frozen
class _Shown:
    """What the sources of evidence write per instant, as in `EvidenceSet`."""

    kind: Ints
    proves: Bools
    on_survey: Bools


@frozen
class TrainEvidence:
    """All evidence of a run.

    `off_track`: times with reference samples that lie on no track. `carried`: by each odometer from reads and the ends
    of the reference, outside its time; `by_reads`: from reads alone, over the whole run. `standstills`: times over
    which the odometer carries nothing from one side. `stands`: ends of recordings at which the train stood;
    `odometers_disagree`: one of unknown origin parts from an independent one; `contradiction_count`: steps and drifts
    of the reference that an odometer or a read contradicts, and clocks that change; `unsure`: times in which nobody
    knows which of the two failed; `disputes`: times about reads that exclude the reference; `true_clocks_s`: by how
    much the odometer's stamps may be early.
    """

    stretches: tuple[KnownStretch, ...]
    off_track: tuple[Span, ...]
    carried: tuple[CarriedGaps, ...]
    by_reads: tuple[CarriedGaps, ...]
    reads_ns: Ints
    clocks: tuple[RecorderClock, ...]
    network: Network
    config: Configuration
    standstills: tuple[Span, ...] = ()
    stands: tuple[FinalStand, ...] = ()
    odometers_disagree: bool = False
    contradiction_count: int = 0
    unsure: tuple[Span, ...] = ()
    disputes: tuple[Span, ...] = ()
    true_clocks_s: tuple[float, ...] = (0.0,)

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """The gaps of the odometer that the LDS uses."""
        return self.carried[0].gaps if self.carried else ()

    @property
    def count_contradicted_gaps(self) -> int:
        """Gaps between anchors whose length by the odometer, scaled by the vehicle file, fits no route on the track."""
        by_file = bool(self.carried) and self.carried[0].counter.has_known_scale
        return sum(bool(gap.routes) and len(gap.anchors) == 2 and not gap.closed_routes for gap in self.gaps if by_file)

    @property
    def count_unreachable(self) -> int:
        """Pairs of anchors that no train can have passed one after the other."""
        return sum(gap.is_unreachable for gap in self.gaps)

    @property
    def count_disputed_reads(self) -> int:
        """Reads that exclude the reference at k_T sigmas: at k = 3 noise alone would do so in a long run."""
        t_ns = self.reads_ns
        instants = _Instants(t_ns)
        anywhere = np.ones(t_ns.size, dtype=np.bool_)
        factor = self.config.align.sure_sigmas / self.config.hazards.evidence_factor
        kind = np.full(t_ns.size, NOTHING)
        shown = _Shown(kind, *np.zeros((2, t_ns.size), dtype=np.bool_))
        by_reference = [there.wider_by_factor(factor) for there in self._by_reference(instants, anywhere, shown)]
        # Outside the time of the reference there is nothing to exclude.
        by_reads = [
            there.wider_by_factor(factor)
            for there in self._by_odometers(self.by_reads, instants, kind != NOTHING, shown)
        ]
        return int(combine(by_reference, by_reads, t_ns.size)[1].size)

    @property
    def clock_assumed(self) -> bool:
        """Whether the clock of reference or reads against the odometer's could not be measured."""
        return any(clock.assumed for clock in self.clocks)

    @property
    def clock_open_s(self) -> float:
        """Time between the instants at which, by the clocks of all recorders, a place may have been passed [s]."""
        return float(np.ptp(self.true_clocks_s)) + 2.0 * max((clock.delta_s for clock in self.clocks), default=0.0)

    @property
    def shares_odometer_clock(self) -> bool:
        """Whether all recorders have the clock of the odometer, as measured to half a second."""
        near = (not of.assumed and abs(of.shift_s) + of.delta_s < _IN_STEP_S for of in self.clocks)
        return bool(self.clocks) and all(near)

    @property
    def anchored_span_ns(self) -> Span | None:
        """First and last anchor; None without anchors."""
        times = [anchor.t_ns for gap in self.gaps for anchor in gap.anchors]
        times += [int(t_ns) for stretch in self.stretches for t_ns in stretch.t_ns[[0, -1]]]
        return (min(times), max(times)) if times else None

    def at(self, t_ns: Ints) -> EvidenceSet:
        """Evidence at these instants of the GNSS's stamps, whichever of the clocks is the true one.

        Nothing is carried from one side over a stand of the odometer (`standstills`). Up to a second after a recording
        that ended in a stand the train is taken to stand on.

        Args:
            t_ns: instants in any order [ns], shape (n,).

        Returns:
            Net elements and intervals at each of them.
        """
        return unite([self._at_by_clock(t_ns, early_s) for early_s in self.true_clocks_s])

    def _at_by_clock(self, t_ns: Ints, early_s: float) -> EvidenceSet:
        """Where the train may be if stamps are `early_s` early, widened by its movement within an uncertain clock."""
        at_ns, beyond_m = t_ns, np.zeros(t_ns.size)
        if early_s and self.carried:
            at_ns, beyond_m = self.carried[0].counter.hold_to_recording(t_ns - round(early_s * NS_PER_S), abs(early_s))
        held_ns, slack_m = held_at_stands(at_ns, self.stands, self.config)
        slack_m = slack_m + beyond_m
        found = self._at(held_ns)
        widened = tuple(there.wider_by(slack_m) for there in found.alternatives)
        return replace(found, alternatives=widened) if slack_m.any() else found

    def _at(self, t_ns: Ints) -> EvidenceSet:
        """Where the train may be at instants, as the clock of the evidence stamps them."""
        instants = _Instants(t_ns)
        kind = np.full(t_ns.size, NOTHING)
        proves, on_survey = np.zeros((2, t_ns.size), dtype=np.bool_)
        shown = _Shown(kind, proves, on_survey)
        on_track = ~inside_spans(t_ns, self.off_track)
        heard = on_track & ~inside_spans(t_ns, self.unsure)
        alternatives = self._by_reference(instants, heard, shown)
        alternatives += self._by_odometers(self.carried, instants, heard & (kind == NOTHING), shown)
        # Its clock puts the ends of a stretch anywhere within what is not known of it.
        alternatives += self._by_reference(instants, heard & (kind == NOTHING), shown, beyond=True)
        if self.by_reads:
            of_reads = _Shown(np.full(t_ns.size, NOTHING), *np.zeros((2, t_ns.size), dtype=np.bool_))
            # A reference that drifted by nobody knows how much leaves the reads what they prove without it.
            by_reads = self._by_odometers(self.by_reads, instants, on_track, of_reads)
            disputed = inside_spans(t_ns, self.disputes)
            both = (kind != NOTHING) & (of_reads.kind != NOTHING)
            narrows = self.by_reads[0].counter.odometer.independent
            alternatives = _combine_with_reads(alternatives, by_reads, (both, disputed), narrows)
            kind = np.where(disputed & ~both, NOTHING, np.where(kind == NOTHING, of_reads.kind, kind))
            proves |= of_reads.proves
            on_survey |= of_reads.on_survey
        complete = self.config.evidence.survey_complete
        return EvidenceSet(kind, tuple(alternatives), proves, on_survey | (complete & (kind != NOTHING)))

    def _by_reference(
        self, instants: _Instants, heard: Bools, shown: _Shown, beyond: bool = False
    ) -> list[Alternative]:
        """Where the reference says the train was; writes into `shown`. `beyond`: past its ends, as its clock may be."""
        alternatives: list[Alternative] = []
        for stretch in self.stretches:
            first_ns = stretch.t_ns[0]
            last_ns = stretch.t_ns[-1]
            # One sample shows no speed, and so not how far the train came meanwhile.
            margin_ns = stretch.clock_ns if beyond and stretch.t_ns.size > 1 else 0
            rows = instants.rows_between(int(first_ns) - margin_ns, int(last_ns) + margin_ns)
            rows = rows[heard[rows] & (shown.kind[rows] == NOTHING)]
            if rows.size == 0:
                continue
            shown.proves[rows] = True
            at_ns = np.clip(instants.t_ns[rows], first_ns, last_ns)
            shown.on_survey[rows] = stretch.proved_at(at_ns)
            for path in stretch.paths:
                for there in _alternatives_on_path(stretch, path, rows, at_ns, self.config.hazards.evidence_factor):
                    alternatives.append(there)
                    shown.kind[there.rows] = KINDS.index(Kind.REFERENCE)
        return alternatives

    def _by_odometers(
        self, sources: Sequence[CarriedGaps], instants: _Instants, wanted: Bools, shown: _Shown
    ) -> list[Alternative]:
        """Where each odometer says the train was, carried from the anchors of its gaps; writes into `shown`.

        Of each instant the first odometer that says anything. Between two anchors of one surveyed route that the
        odometer closes the train was on that route; a read itself needs no odometer.
        """
        t_ns = instants.t_ns
        alternatives: list[Alternative] = []
        for source in sources:
            open_rows = wanted.copy()
            for gap in source.gaps:
                rows = instants.rows_between(gap.begin_ns, gap.end_ns)
                rows = rows[open_rows[rows]]
                # A gap with one anchor is open at one side: nothing is carried beyond a standstill.
                if len(gap.anchors) == 1:
                    rows = rows[~_are_beyond_stand(instants.t_ns[rows], gap, self.standstills)]
                for route in gap.routes or [] if rows.size else []:
                    low_m, high_m = self._interval_in_gap(source.counter, gap, route, t_ns[rows])
                    there = Alternative(rows, route.chain.as_route(self.network), low_m, high_m).some_rows(
                        np.isfinite(low_m)
                    )
                    alternatives.append(there)
                    open_rows[there.rows] = False
                    shown.kind[there.rows] = max(KINDS.index(anchor.kind) for anchor in gap.anchors)
                    at_anchor = np.isin(t_ns[there.rows], [anchor.t_ns for anchor in gap.anchors if anchor.proved])
                    shown.proves[there.rows] = source.counter.odometer.independent | at_anchor
                    shown.on_survey[there.rows] = gap.is_on_survey(self.network) | at_anchor
        return alternatives

    def _interval_in_gap(self, counter: SignedOdometer, gap: Gap, route: GapChain, t_ns: Ints) -> Interval:
        """Coordinates on a route through a gap [m], by both of its anchors or the only one."""
        if gap.begin is not None and gap.end is not None:
            return carry_between_anchors(
                counter, (gap.begin, gap.end), (route.at_m[0], route.at_m[1]), t_ns, self.config
            )
        return carry_from_anchor(counter, gap.anchors[0], route.at_m[0], t_ns, self.config)


def _alternatives_on_path(
    stretch: KnownStretch, path: KnownPath, rows: Ints, t_ns: Ints, factor: float
) -> list[Alternative]:
    """Straight lines between samples, each +- (k sigma + speed times clock), leg by leg."""
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
        Alternative(rows, path.path.legs[number], low_m, high_m).some_rows(
            (leg[before] == number) & (leg[after] == number)
        )
        for number in np.unique(leg[before]).tolist()
    ]


def combine(
    first: Sequence[Alternative], second: Sequence[Alternative], size: int, narrows: bool = True
) -> tuple[list[Alternative], Ints]:
    """Two sources of evidence together, and the instants at which they exclude each other."""
    # Where they agree: the net elements common to both, with the narrower interval, or that of `first`; else all stay.
    narrowed = [_intersection(left, right) for left, right in _overlapping_pairs(first, second)]
    agreed = _have_alternative(narrowed, size)
    together = narrowed if narrows else [alternative.some_rows(agreed[alternative.rows]) for alternative in first]
    alone = [alternative.some_rows(~agreed[alternative.rows]) for alternative in (*first, *second)]
    return together + alone, np.flatnonzero(_have_alternative(first, size) & _have_alternative(second, size) & ~agreed)


def _combine_with_reads(
    alternatives: list[Alternative], by_reads: list[Alternative], where: tuple[Bools, Bools], narrows: bool
) -> list[Alternative]:
    """The reference and what is carried, with the reads; `where`: both have alternatives, and they are in dispute."""
    both, disputed = where
    if not disputed.any():
        return combine(alternatives, by_reads, both.size, narrows)[0]
    left = [there.some_rows(~disputed[there.rows]) for there in alternatives]
    right = [there.some_rows(~disputed[there.rows]) for there in by_reads]
    together, _ = combine(left, right, both.size, narrows)
    apart = both & disputed  # either may be right, and one alone says nothing: as if the reference had stepped
    return together + [there.some_rows(apart[there.rows]) for there in (*alternatives, *by_reads)]


def _overlapping_pairs(
    first: Sequence[Alternative], second: Sequence[Alternative]
) -> Iterator[tuple[Alternative, Alternative]]:
    """Pairs of either, over the rows from the first to the last that they may share."""
    rights = [right for right in second if right.rows.size]
    if not rights:
        return
    begins, ends = (np.array([right.rows[at] for right in rights]) for at in (0, -1))
    for left in first:
        if left.rows.size == 0:
            continue
        for number in np.flatnonzero((ends >= left.rows[0]) & (begins <= left.rows[-1])).tolist():
            low, high = max(int(left.rows[0]), int(begins[number])), min(int(left.rows[-1]), int(ends[number]))
            yield left.between_rows(low, high), rights[number].between_rows(low, high)


def _have_alternative(alternatives: Sequence[Alternative], size: int) -> Bools:
    """Instants at which there is an alternative."""
    spoken = np.zeros(size, dtype=np.bool_)
    for alternative in alternatives:
        spoken[alternative.rows] = True
    return spoken


def _intersection(first: Alternative, second: Alternative) -> Alternative:
    """Where the intervals of both agree, at the instants of both; in coordinates of the first's route.

    What hardly touches excludes the other: of two intervals alike, each +- k sigma, middles k sigmas of their
    difference apart leave a share of 1 - 1/sqrt(2).
    """
    _, in_first, in_second = np.intersect1d(first.rows, second.rows, assume_unique=True, return_indices=True)
    first = first.some_rows(in_first)
    second = second.some_rows(in_second)
    element, measure_m, sense = first.route.locate(first.middle_m)
    at_m, along = second.route.coordinates_of(element, measure_m, second.middle_m)
    ends_m = [first.middle_m + sense * along * (end_m - at_m) for end_m in (second.low_m, second.high_m)]
    low_m = np.maximum(first.low_m, np.minimum(*ends_m))
    high_m = np.minimum(first.high_m, np.maximum(*ends_m))
    narrower_m = np.minimum(first.high_m - first.low_m, np.abs(ends_m[1] - ends_m[0]))
    agree: Bools = (low_m <= high_m) & (high_m - low_m >= _AGREES * narrower_m)
    return Alternative(first.rows, first.route, low_m, high_m).some_rows(agree)


def unite(sets: Sequence[EvidenceSet]) -> EvidenceSet:
    """The union of several sets of which one holds, nobody knows which; proved is what all prove.

    Where one says nothing, so do all: it could have said anything.

    Args:
        sets: evidence at the same n instants, at least one.

    Returns:
        Evidence at these instants.
    """
    if len(sets) == 1:
        return sets[0]
    kinds = np.array([one.kind for one in sets])
    spoken = (kinds != NOTHING).all(axis=0)
    every = [there for one in sets for there in one.alternatives]
    return EvidenceSet(
        kind=np.where(spoken, kinds.max(axis=0), NOTHING),
        alternatives=tuple(every if spoken.all() else [there.some_rows(spoken[there.rows]) for there in every]),
        proves=np.logical_and.reduce([one.proves for one in sets]),
        on_survey=np.logical_and.reduce([one.on_survey for one in sets]),
    )


@frozen
class _Instants:
    """Instants in any order."""

    t_ns: Ints

    @cached_property
    def _order(self) -> Ints:
        """Rows in order of time."""
        return np.argsort(self.t_ns, kind="stable")

    @cached_property
    def _sorted_ns(self) -> Ints:
        """Instants in order of time."""
        return self.t_ns[self._order]

    def rows_between(self, first_ns: int, last_ns: int) -> Ints:
        """Rows of those from one instant to another one, both included, in order of rows."""
        low = int(np.searchsorted(self._sorted_ns, first_ns, side="left"))
        high = int(np.searchsorted(self._sorted_ns, last_ns, side="right"))
        return np.sort(self._order[low:high])


def inside_spans(t_ns: Ints, spans: Sequence[Span]) -> Bools:
    """Whether each instant lies inside one of the spans, their ends left out."""
    spans = [span for span in spans if span[0] < span[1]]
    begins, ends = (np.sort(np.array([span[at] for span in spans], dtype=np.int64)) for at in (0, 1))
    begun = np.searchsorted(begins, t_ns, side="right")
    inside: Bools = begun > np.searchsorted(ends, t_ns, side="right")
    return inside


def _are_beyond_stand(t_ns: Ints, gap: Gap, standstills: Sequence[Span]) -> Bools:
    """Instants to which nothing can be carried, because the odometer stood still since the anchor."""
    void = np.zeros(t_ns.size, dtype=np.bool_)
    for begin_ns, end_ns in standstills:
        if gap.begin is not None and end_ns > gap.begin_ns:
            void |= t_ns >= begin_ns
        if gap.end is not None and begin_ns < gap.end_ns:
            void |= t_ns <= end_ns
    return void
