"""Places that are known of the train: stretches of a reference, balise reads, standstills at the end of a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.evidence.carrying import RecorderClock, SignedOdometer, TrueAnchor
from pipeline.stages.evidence.contradictions import KnownPath, Levels, running_median
from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.polarity import relative_sense, shared_movement_m
from pipeline.stages.odometry.scale_lag import spans_of_rows
from pipeline.stages.reference import ReferenceStretch
from pipeline.stages.track.path import Place
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, spans_of, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.enums import BaliseKind, Evidence
from schemas.frozen import frozen

# DOMAIN section 5.1: a train that stood for so long at the last row stands for up to so much more [s].
_STANDSTILL_S = 2.0
_STANDS_S = 1.0


class FinalStand(NamedTuple):
    """The last instant of a recording at which the train stood [ns]."""

    last_ns: int


def final_stands(
    reference: Sequence[ReferenceStretch], odometers: Sequence[Odometry], config: Configuration
) -> tuple[FinalStand, ...]:
    """The ends of independent odometers and of the reference at which the train had stood for two seconds.

    Of several recordings the one that ends last counts: the others may have lost a train that drove on. One or none.
    """
    ends: list[tuple[int, bool]] = []
    for odometer in odometers:
        end_ns = np.array([odometer.epoch_ns + round(float(odometer.t_s[-1]) * 1e9)])
        ends.append(
            (int(end_ns[0]), bool(odometer.was_at_standstill(end_ns - round(_STANDSTILL_S * NS_PER_S), end_ns)[0]))
        )
    for stretch in reference:
        last_ns = int(stretch.t_ns[-1])
        path = stretch.paths[0]
        rows = slice(int(np.searchsorted(stretch.t_ns, last_ns - round(_STANDSTILL_S * NS_PER_S))), None)
        spread_m = float(np.ptp(path.at_m[rows]))
        noise_m = 2.0 * config.hazards.evidence_factor * float(stretch.sigma_m[-1])
        ends.append((last_ns, spread_m <= config.matching.deadband_mps * _STANDSTILL_S + noise_m))
    if not ends:
        return ()
    last_ns, standing = max(ends)
    return (FinalStand(last_ns),) if standing else ()


def held_at_stands(t_ns: Ints, stands: Sequence[FinalStand], config: Configuration) -> tuple[Ints, Floats]:
    """The instants, those within a second after a stand put at its end, and how far the train may have come [m]."""
    held_ns = t_ns.copy()
    slack_m = np.zeros(t_ns.size)
    for stand in stands:
        since_s = (t_ns - stand.last_ns) / NS_PER_S
        rows = (since_s > 0.0) & (since_s <= _STANDS_S)
        held_ns[rows] = stand.last_ns
        slack_m[rows] = 0.5 * config.align.braking_mps2 * since_s[rows] ** 2
    return held_ns, slack_m


# Numerics: so many sigmas show a direction.
_DIRECTION_SIGMAS = 4.0


@frozen
class KnownStretch:
    """A stretch of the reference on the odometer's clock; the train was on one of its paths.

    `proved`: samples that lie on no track that the survey lacks; `levels`: between its steps, as the odometer counts;
    `clock_ns`: by so much its clock may be off, and so far beyond its ends the samples there may have been made;
    `disputed`: times from read to read about one that excludes it.
    """

    t_ns: Ints
    sigma_m: Floats
    clock_m: Floats
    paths: tuple[KnownPath, ...]
    proved: Bools
    reference: ReferenceStretch
    levels: Levels
    clock_ns: int = 0
    disputed: tuple[tuple[int, int], ...] = ()

    def proved_at(self, t_ns: Ints) -> Bools:
        """Whether the samples about each instant show that the track is one of the survey."""
        after = np.searchsorted(self.t_ns, t_ns).clip(0, self.t_ns.size - 1)
        before = np.maximum(after - 1, 0)
        proved: Bools = self.proved[after] & (self.proved[before] | (self.t_ns[after] == t_ns))
        return proved

    def anchor(self, sample: int) -> TrueAnchor:
        """The places of one sample as an anchor; what a step left open widens it like the clock."""
        open_m = max(float((known.high_m - known.low_m)[sample]) for known in self.paths)
        return TrueAnchor(
            t_ns=int(self.t_ns[sample]),
            places=tuple(dict.fromkeys(known.place(sample) for known in self.paths)),
            sigma_m=float(self.sigma_m[sample]),
            kind=Evidence.REFERENCE,
            clock_m=float(self.clock_m[sample]) + open_m,
            proved=bool(self.proved[sample]),
            delta_s=self.clock_ns / NS_PER_S,
            open_m=open_m,
        )

    @property
    def doubtful(self) -> Bools:
        """Samples of which nobody knows how far they are off: the reference drifted, and no read says since when."""
        return np.asarray(np.logical_or.reduce([~np.isfinite(known.low_m) for known in self.paths]))

    def doubtful_spans(self) -> list[tuple[int, int]]:
        """The times of these samples, ends left out."""
        return [(int(self.t_ns[first]) - 1, int(self.t_ns[last]) + 1) for first, last in spans_of(self.doubtful)]

    def without_doubtful(self) -> list[KnownStretch]:
        """The parts without doubtful samples."""
        if not self.doubtful.any():
            return [self]
        return [self._some_rows(slice(first, last + 1)) for first, last in spans_of(~self.doubtful) if last > first]

    def _some_rows(self, rows: slice) -> KnownStretch:
        """The same stretch, with some of its rows only."""
        return replace(
            self,
            t_ns=self.t_ns[rows],
            sigma_m=self.sigma_m[rows],
            clock_m=self.clock_m[rows],
            paths=tuple(known.some_rows(rows) for known in self.paths),
            proved=self.proved[rows],
        )

    def end_anchors(self, counter: SignedOdometer) -> tuple[TrueAnchor, TrueAnchor]:
        """First and last sample at which the odometer counted; only from these is a place carried."""
        counted = np.flatnonzero(counter.odometer.known_at(self.t_ns))
        first, last = (counted if counted.size else np.arange(self.t_ns.size))[[0, -1]].tolist()
        return self.anchor(first), self.anchor(last)


@frozen
class OrientedStretch:
    """A stretch with the sense of its first path: metres that the odometer counted with it and against it."""

    stretch: ReferenceStretch
    sense: int
    with_m: float
    against_m: float

    def anchor(self, sample: int) -> TrueAnchor:
        """The places of one sample as an anchor, by its own clock."""
        paths = self.stretch.paths
        places = [path.legs[int(path.leg[sample])].locate(path.at_m[[sample]]) for path in paths]
        return TrueAnchor(
            t_ns=int(self.stretch.t_ns[sample]),
            places=tuple(dict.fromkeys(Place(int(element[0]), float(at_m[0])) for element, at_m, _ in places)),
            sigma_m=float(self.stretch.sigma_m[sample]),
            kind=Evidence.REFERENCE,
        )

    @property
    def first_oriented_element(self) -> int:
        """The oriented net element of the first sample, in the sense in which the odometer counts up."""
        path = self.stretch.paths[0]
        element, _, sense = path.legs[int(path.leg[0])].locate(path.at_m[:1])
        return 2 * int(element[0]) + int(sense[0] * self.sense < 0)


def orient_stretch(stretch: ReferenceStretch, counter: SignedOdometer | None, least_m: float) -> OrientedStretch:
    """The stretch with the sense in which the odometer counts along it: by the first movement of `least_m` (DOMAIN 2).

    Movements of the reference beyond its noise tell, where the odometer counted about as much: a reference that stands
    or creeps while the odometer counts has no direction to give.
    """
    begin, end, step_m = _movements_beyond_noise(stretch)
    counted_m = np.abs(step_m)
    if counter is not None:
        counted_m = counter.odometer.proved_distance_between(stretch.t_ns[begin], stretch.t_ns[end])
        counted_m = np.where(np.abs(step_m) > 0.5 * np.abs(counted_m), counted_m, 0.0)
    sense = relative_sense(counted_m, step_m, least_m)
    shared_m = sense * shared_movement_m(counted_m, step_m)
    with_m, against_m = (float((sign * shared_m).clip(min=0.0).sum()) for sign in (1, -1))
    return OrientedStretch(stretch, sense, with_m, against_m)


def _movements_beyond_noise(stretch: ReferenceStretch) -> tuple[Ints, Ints, Floats]:
    """Pairs of samples, a second apart or more, between which the reference moved beyond its noise; how far [m]."""
    t_ns = stretch.t_ns
    instants = np.arange(int(t_ns[0]), int(t_ns[-1]) + 1, NS_PER_S, dtype=np.int64)
    rows = np.unique(np.searchsorted(t_ns, instants)).tolist()
    at_m = stretch.paths[0].at_m.tolist()
    leg = stretch.paths[0].leg.tolist()
    noise_m = (_DIRECTION_SIGMAS * np.sqrt(2.0) * stretch.sigma_m).tolist()
    begin: list[int] = []
    end: list[int] = []
    since = rows[0]
    for row in rows[1:]:
        if leg[row] != leg[since]:
            since = row
        elif abs(at_m[row] - at_m[since]) > max(noise_m[row], noise_m[since]):
            begin.append(since)
            end.append(row)
            since = row
    ends = np.array(end, dtype=np.int64)
    begins = np.array(begin, dtype=np.int64)
    return begins, ends, stretch.paths[0].at_m[ends] - stretch.paths[0].at_m[begins]


def _on_one_leg(stretch: ReferenceStretch, begin: Ints, end: Ints) -> tuple[Ints, Ints, Floats]:
    """The pairs of samples that lie on one leg of the first path, and the movement between them [m]."""
    path = stretch.paths[0]
    whole = path.leg[begin] == path.leg[end]
    begin = begin[whole]
    end = end[whole]
    return begin, end, path.at_m[end] - path.at_m[begin]


def reference_movements(
    sides: Sequence[OrientedStretch], lengths_m: Callable[[TrueAnchor, TrueAnchor], list[float]]
) -> tuple[Ints, Ints, Floats, Floats]:
    """Movements of the reference between its stamps, as the odometer counts up: begin and end [ns], length and sigma
    [m].

    Of ten seconds, and from stretch to stretch where `lengths_m` knows one: a slow reference is all gaps.
    """
    nothing = np.zeros(0, dtype=np.int64)
    movements: list[tuple[Ints, Ints, Floats, Floats]] = [(nothing, nothing, np.zeros(0), np.zeros(0))]
    for side in sides:
        t_ns = side.stretch.t_ns
        begin, end, moved_m = _on_one_leg(side.stretch, *spans_of_rows((t_ns - t_ns[0]) / NS_PER_S))
        sigma_m = np.hypot(side.stretch.sigma_m[begin], side.stretch.sigma_m[end])
        movements.append((t_ns[begin], t_ns[end], side.sense * moved_m, sigma_m))
    for before, after in pairwise(sorted(sides, key=lambda side: int(side.stretch.t_ns[0]))):
        begin_at, end_at = before.anchor(-1), after.anchor(0)
        across_m = np.array(lengths_m(begin_at, end_at), dtype=np.float64)
        from_ns, to_ns = (np.full(across_m.size, anchor.t_ns, dtype=np.int64) for anchor in (begin_at, end_at))
        movements.append((from_ns, to_ns, across_m, np.full(across_m.size, np.hypot(begin_at.sigma_m, end_at.sigma_m))))
    begins, ends, lengths, sigmas = (np.concatenate(column) for column in zip(*movements, strict=True))
    return begins, ends, lengths, sigmas


def exclude_other_tracks(stretch: ReferenceStretch, config: Configuration) -> Bools:
    """Samples that no neighbouring track can have made, whether the survey holds it or not (DOMAIN section 5.0).

    By the median over 200 m about each the reference lies within the spacing of tracks, less k combined sigmas, of its
    track; per sample, of the worst of the paths.
    """
    if config.evidence.survey_complete:
        return np.ones(stretch.t_ns.size, dtype=np.bool_)
    proved = np.ones(stretch.t_ns.size, dtype=np.bool_)
    for path in stretch.paths:
        spare_m = config.evidence.track_spacing_m - config.hazards.evidence_factor * path.root_m
        run_m = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path.at_m)))])
        proved &= running_median(path.aside_m, run_m, config.evidence.survey_window_m) <= running_median(
            spare_m, run_m, config.evidence.survey_window_m
        )
    return proved


def read_anchors(
    reads: pl.DataFrame | None, balises: pl.DataFrame | None, track: SurveyedTrack, config: HazardConfig
) -> list[TrueAnchor]:
    """Reads of physical balises that the site knows, in order of time."""
    if reads is None or balises is None or reads.is_empty():
        return []
    physical = balises.filter(pl.col("kind").cast(pl.String) == BaliseKind.PHYSICAL.value)
    rows, elements = track.elements_holding(physical)
    known = physical[rows].select("balise_id", "measure_m", element=elements)
    read = reads.select("t", "balise_id").join(known, on="balise_id").sort("t", "balise_id")
    return [
        TrueAnchor(t_ns, (Place(element, measure_m),), config.balise_read_sigma_m, Evidence.BALISE)
        for t_ns, element, measure_m in zip(times_ns(read).tolist(), read["element"], read["measure_m"], strict=True)
    ]


def put_on_clock(
    anchors: Sequence[TrueAnchor], clock: RecorderClock, counter: SignedOdometer | None
) -> list[TrueAnchor]:
    """Anchors on the odometer's clock, with what their own clock may add at their speed; 0 without an odometer."""
    t_ns = np.array([anchor.t_ns for anchor in anchors], dtype=np.int64)
    speed_mps = np.zeros(t_ns.size) if counter is None else np.abs(counter.odometer.speed_about(t_ns))
    clock_m = clock.delta_s * speed_mps
    shift_ns = round(clock.shift_s * NS_PER_S)
    rows = zip(anchors, clock_m.tolist(), strict=True)
    return [
        replace(anchor, t_ns=anchor.t_ns - shift_ns, clock_m=added_m, delta_s=clock.delta_s) for anchor, added_m in rows
    ]


def anchors_outside(anchors: Sequence[TrueAnchor], stretches: Sequence[KnownStretch]) -> list[TrueAnchor]:
    """Anchors at times that no stretch covers."""
    spans = [stretch.t_ns[[0, -1]].tolist() for stretch in stretches]
    return [anchor for anchor in anchors if not any(begin <= anchor.t_ns <= end for begin, end in spans)]
