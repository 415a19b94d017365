"""Anchors: balise reads, and the reference on every track along which it may have run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.stages.evidence.carrying import Counter, TrueAnchor
from pipeline.stages.evidence.clock import RecorderClock, RecorderLag, lag_of
from pipeline.stages.reference import ReferencePath, ReferenceStretch
from pipeline.stages.track.path import Place
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.enums import BaliseKind, Evidence

# Numerics: a lag shows where the speed changes, so ways over this time are compared [s].
_LAG_WINDOW_S = 10.0
# Numerics: the speed is compared with its median over this time before and after [s].
_EVEN_S = 2.0


@dataclass(frozen=True)
class KnownPath:
    """One path of the reference: per sample the coordinate and its least and largest value [m].

    `sense`: +1 where the odometer counts up as the coordinate grows, else -1. `step_m`: size of a step to the next
    sample that every odometer contradicts, else 0; in between the train may be on either side.
    """

    path: ReferencePath
    sense: int
    at_m: Floats
    low_m: Floats
    high_m: Floats
    step_m: Floats

    def place(self, sample: int) -> Place:
        element, measure, _ = self.path.legs[int(self.path.leg[sample])].locate(self.at_m[[sample]])
        return Place(int(element[0]), float(measure[0]))


@dataclass(frozen=True)
class KnownStretch:
    """A stretch of the reference on the odometer's clock; the train was on one of its paths."""

    t_ns: Ints
    sigma_m: Floats
    clock_m: Floats
    paths: tuple[KnownPath, ...]

    def anchor(self, sample: int) -> TrueAnchor:
        """The places of one sample; what a step left open widens it like the clock."""
        open_m = max(float((known.high_m - known.low_m)[sample]) for known in self.paths)
        return TrueAnchor(
            t_ns=int(self.t_ns[sample]),
            places=tuple(dict.fromkeys(known.place(sample) for known in self.paths)),
            sigma_m=float(self.sigma_m[sample]),
            kind=Evidence.REFERENCE,
            clock_m=float(self.clock_m[sample]) + open_m,
        )

    def ends(self, counter: Counter) -> tuple[TrueAnchor, TrueAnchor]:
        """The outermost samples at which the odometer counted: only from these is a place carried."""
        counted = np.flatnonzero(counter.odometer.known_at(self.t_ns))
        first, last = (counted if counted.size else np.arange(self.t_ns.size))[[0, -1]].tolist()
        return self.anchor(first), self.anchor(last)


@dataclass(frozen=True)
class Sided:
    """A stretch with the sense of its first path: metres that the odometer counted with it and against it."""

    stretch: ReferenceStretch
    sense: int
    with_m: float
    against_m: float

    @property
    def facing(self) -> int:
        """The oriented net element of the first sample, in the sense in which the odometer counts up."""
        path = self.stretch.paths[0]
        element, _, sense = path.legs[int(path.leg[0])].locate(path.at_m[:1])
        return 2 * int(element[0]) + int(sense[0] * self.sense < 0)


def sided(stretch: ReferenceStretch, counter: Counter | None, least_m: float) -> Sided:
    """The sense in which the odometer counts along the path: by the first movement of `least_m` (DOMAIN section 2)."""
    begin, end, step_m = _steps_of(stretch, 1.0)
    if counter is not None:
        counted_m = counter.distance_m(stretch.t_ns[begin], stretch.t_ns[end])
        step_m = np.sign(step_m) * np.nan_to_num(counted_m)
    moved_m = np.cumsum(step_m)
    first = np.flatnonzero(np.abs(moved_m) >= least_m)
    total_m = float(moved_m[first[0]]) if first.size else float(step_m.sum())
    sense = -1 if total_m < 0.0 else 1
    with_m, against_m = (float((sign * sense * step_m).clip(min=0.0).sum()) for sign in (1, -1))
    return Sided(stretch, sense, with_m, against_m)


def _steps_of(stretch: ReferenceStretch, step_s: float) -> tuple[Ints, Ints, Floats]:
    """Pairs of samples so far apart in time on one leg of the first path, and the way between them [m]."""
    path = stretch.paths[0]
    t_ns = stretch.t_ns
    instants = np.arange(int(t_ns[0]), int(t_ns[-1]) + 1, round(step_s * NS_PER_S), dtype=np.int64)
    rows = np.unique(np.searchsorted(t_ns, instants))
    whole = np.flatnonzero(np.diff(path.leg[rows]) == 0)
    begin = rows[:-1][whole]
    end = rows[1:][whole]
    return begin, end, path.at_m[end] - path.at_m[begin]


def reference_lag(sides: Sequence[Sided], counter: Counter | None) -> RecorderLag:
    """The reference's clock against the odometer's, by its ways of ten seconds, as the odometer counts up."""
    ways = []
    for side in sides:
        begin, end, way_m = _steps_of(side.stretch, _LAG_WINDOW_S)
        ways.append((side.stretch.t_ns[begin], side.stretch.t_ns[end], side.sense * way_m))
    if not ways:
        return RecorderLag()
    begins, ends, lengths = (np.concatenate(column) for column in zip(*ways, strict=True))
    return lag_of(begins, ends, lengths, counter)


def known_stretch(
    side: Sided,
    clock: RecorderClock,
    counters: Sequence[Counter],
    reads: Sequence[TrueAnchor],
    ahead_m: float,
    config: Configuration,
) -> KnownStretch:
    """The stretch as evidence; `reads` close a step of the reference where they confirm it."""
    t_ns = side.stretch.t_ns - round(clock.shift_s * NS_PER_S)
    stretch = replace(side.stretch, t_ns=t_ns)
    paths: list[KnownPath] = []
    speed_mps = np.zeros(t_ns.size)
    for path in stretch.paths:
        at_m = path.at_m - side.sense * ahead_m
        path_mps = _speed_mps(t_ns, at_m, path.leg)
        speed_mps = np.maximum(speed_mps, path_mps)
        known = KnownPath(path, side.sense, at_m, at_m, at_m, np.zeros(t_ns.size))
        reads_ns = _confirming_ns(known, stretch, path_mps * clock.delta_s, reads, config.hazards)
        paths.append(_left_open(known, stretch, counters, reads_ns, config))
    since_s = (t_ns - t_ns[0]) / NS_PER_S
    around = [np.interp(since_s + late_s, since_s, speed_mps) for late_s in (-clock.delta_s, 0.0, clock.delta_s)]
    return KnownStretch(t_ns, stretch.sigma_m, np.maximum.reduce(around) * clock.delta_s, tuple(paths))


def _speed_mps(t_ns: Ints, at_m: Floats, leg: Ints) -> Floats:
    """Speed over a second about each sample."""
    half_ns = NS_PER_S // 2
    end = np.minimum(np.searchsorted(t_ns, t_ns + half_ns), t_ns.size - 1)
    # A slow log has no other sample within the second before its last one.
    begin = np.minimum(np.searchsorted(t_ns, t_ns - half_ns), np.maximum(end - 1, 0))
    elapsed_s = np.maximum((t_ns[end] - t_ns[begin]) / NS_PER_S, 1e-9)
    return np.where((leg[begin] == leg[end]) & (end > begin), np.abs(at_m[end] - at_m[begin]) / elapsed_s, 0.0)


def _confirming_ns(
    known: KnownPath, stretch: ReferenceStretch, clock_m: Floats, reads: Sequence[TrueAnchor], config: HazardConfig
) -> list[int]:
    """Times of reads at balises where the reference was too, within k sigmas of both and both clocks."""
    t_ns = stretch.t_ns
    since_ns = (t_ns - t_ns[0]).astype(np.float64)
    confirming: set[int] = set()
    for read in reads:
        if not t_ns[0] <= read.t_ns <= t_ns[-1]:
            continue
        at_m = np.interp([float(read.t_ns - t_ns[0])], since_ns, known.at_m)
        sample = int(np.searchsorted(t_ns, read.t_ns))
        route = known.path.legs[int(known.path.leg[sample])]
        half_m = config.evidence_factor * float(np.hypot(stretch.sigma_m[sample], read.sigma_m))
        half_m += float(clock_m[sample]) + read.clock_m
        for place in read.places:
            there_m, _ = route.coordinate(np.array([place.element]), np.array([place.measure_m]), at_m)
            if abs(float(there_m[0] - at_m[0])) <= half_m:
                confirming.add(read.t_ns)
    return sorted(confirming)


def _left_open(
    known: KnownPath, stretch: ReferenceStretch, counters: Sequence[Counter], reads_ns: list[int], config: Configuration
) -> KnownPath:
    """The path with how far behind and ahead of each sample the train may be after a step of the reference.

    After a step that every odometer contradicts by more than k_T sigmas, the reference may be wrong before or after
    it: both sides stay possible, until the step back or the next read that confirms the reference (DOMAIN section 5.1).
    """
    t_ns = stretch.t_ns
    if t_ns.size < 2:
        return known
    low_m, high_m, open_step_m = np.zeros((3, t_ns.size))
    step_m, root_m = _contradicted(known, stretch, counters)
    limit_m = config.align.sure_sigmas * root_m
    stepped = np.flatnonzero((np.abs(step_m) > limit_m) & _uneven(known.at_m, t_ns, limit_m))
    open_step_m[stepped] = np.abs(step_m[stepped])
    events = [(int(t_ns[row + 1]), float(step_m[row]), float(limit_m[row])) for row in stepped.tolist()]
    # A read that confirms is a step of 0 m with any noise: it closes every step before it.
    events += [(read_ns, 0.0, np.inf) for read_ns in reads_ns]
    open_m: list[float] = []
    for at_ns, jump_m, noise_m in sorted(events):
        # From where each open step began to here, the oldest first: near 0 where this step leads back.
        sides_m = np.cumsum([jump_m, *open_m[::-1]])[:0:-1]
        back = np.flatnonzero(np.abs(sides_m) <= np.sqrt(2.0) * noise_m)
        open_m = open_m[: int(back[0])] if back.size else [*open_m, jump_m]
        behind_m = np.cumsum([0.0, *open_m[::-1]])
        rows = slice(int(np.searchsorted(t_ns, at_ns)), None)
        low_m[rows] = -behind_m.max()
        high_m[rows] = -behind_m.min()
    return replace(known, low_m=known.at_m + low_m, high_m=known.at_m + high_m, step_m=open_step_m)


def _uneven(at_m: Floats, t_ns: Ints, limit_m: Floats) -> Bools:
    """Steps that the speed around them does not explain: these are of the reference, not of a failing odometer."""
    dt_s = np.diff(t_ns) / NS_PER_S
    speed_mps = np.diff(at_m) / dt_s
    beside = max(1, round(_EVEN_S / float(np.median(dt_s))))
    around = sliding_window_view(np.pad(speed_mps, beside, mode="edge"), 2 * beside + 1)
    return np.greater(np.abs(speed_mps - np.median(around, axis=1)) * dt_s, limit_m)


def _contradicted(known: KnownPath, stretch: ReferenceStretch, counters: Sequence[Counter]) -> tuple[Floats, Floats]:
    """Per step to the next sample: its difference from the odometer that agrees best, and the sigma of that [m]."""
    t_ns = stretch.t_ns
    least = np.full(t_ns.size - 1, np.inf)
    root = np.ones(t_ns.size - 1)
    for counter in counters:
        way = counter.between(t_ns[:-1], t_ns[1:])
        step_sigma_m = np.sqrt(stretch.sigma_m[1:] ** 2 + stretch.sigma_m[:-1] ** 2 + way.variance_m2)
        off_m = np.diff(known.at_m) - known.sense * way.distance_m
        nearer = np.isfinite(off_m) & (np.abs(off_m) / step_sigma_m < np.abs(least) / root)
        least = np.where(nearer, off_m, least)
        root = np.where(nearer, step_sigma_m, root)
    whole = np.diff(known.path.leg) == 0
    return np.where(whole & np.isfinite(least), least, 0.0), root


def read_anchors(
    reads: pl.DataFrame | None, balises: pl.DataFrame | None, track: SurveyedTrack, config: HazardConfig
) -> list[TrueAnchor]:
    """Reads of physical balises that the site knows, in order of time."""
    if reads is None or balises is None or reads.is_empty():
        return []
    physical = balises.filter(pl.col("kind").cast(pl.String) == BaliseKind.PHYSICAL.value)
    rows, elements = track.holding(physical)
    known = physical[rows].select("balise_id", "measure_m", element=elements)
    read = reads.select("t", "balise_id").join(known, on="balise_id").sort("t", "balise_id")
    return [
        TrueAnchor(t_ns, (Place(element, measure_m),), config.balise_read_sigma_m, Evidence.BALISE)
        for t_ns, element, measure_m in zip(times_ns(read).tolist(), read["element"], read["measure_m"], strict=True)
    ]


def on_clock(anchors: Sequence[TrueAnchor], clock: RecorderClock, counter: Counter) -> list[TrueAnchor]:
    """The reads on the odometer's clock, with what that clock may add at their speed."""
    t_ns = np.array([anchor.t_ns for anchor in anchors], dtype=np.int64)
    clock_m = clock.delta_s * np.abs(counter.best_speed_mps(t_ns))
    shift_ns = round(clock.shift_s * NS_PER_S)
    rows = zip(anchors, clock_m.tolist(), strict=True)
    return [replace(anchor, t_ns=anchor.t_ns - shift_ns, clock_m=added_m) for anchor, added_m in rows]


def outside(anchors: Sequence[TrueAnchor], stretches: Sequence[KnownStretch]) -> list[TrueAnchor]:
    """Anchors at times that no stretch covers."""
    spans = [stretch.t_ns[[0, -1]].tolist() for stretch in stretches]
    return [anchor for anchor in anchors if not any(begin <= anchor.t_ns <= end for begin, end in spans)]
