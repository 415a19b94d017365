"""Anchors: balise reads, and the reference on every track along which it may have run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Self

import numpy as np
import polars as pl
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.stages.evidence.carrying import Counter, TrueAnchor
from pipeline.stages.evidence.clock import RecorderClock, RecorderLag, lag_of
from pipeline.stages.reference import ReferencePath, ReferenceStretch
from pipeline.stages.track.path import Place
from pipeline.stages.track.survey import SurveyedTrack
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, spans_of, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.enums import BaliseKind, Evidence

# Numerics: a lag shows where the speed changes, so ways over this time are compared [s].
_LAG_WINDOW_S = 10.0
# DOMAIN section 5.1: the reference is held against the odometer over so long; a spike is no longer [s].
_WINDOW_S = 10.0
_LONG_WINDOW_S = 100.0
# Least number of samples for a median.
_FEWEST_IN_WINDOW = 5
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

    def part(self, rows: slice) -> KnownPath:
        """Of some samples."""
        arrays = {name: getattr(self, name)[rows] for name in ("at_m", "low_m", "high_m", "step_m")}
        return replace(self, path=self.path.part(rows), **arrays)

    def place(self, sample: int) -> Place:
        element, measure, _ = self.path.legs[int(self.path.leg[sample])].locate(self.at_m[[sample]])
        return Place(int(element[0]), float(measure[0]))


@dataclass(frozen=True)
class KnownStretch:
    """A stretch of the reference on the odometer's clock; the train was on one of its paths.

    `proved`: samples that lie on no track that the survey lacks; `levels`: between its steps, as the odometer counts;
    `clock_ns`: so far beyond its ends the samples there may have been made.
    """

    t_ns: Ints
    sigma_m: Floats
    clock_m: Floats
    paths: tuple[KnownPath, ...]
    proved: Bools
    reference: ReferenceStretch
    levels: Levels
    clock_ns: int = 0

    def proved_at(self, t_ns: Ints) -> Bools:
        """Whether the samples about each instant are."""
        after = np.searchsorted(self.t_ns, t_ns).clip(0, self.t_ns.size - 1)
        before = np.maximum(after - 1, 0)
        proved: Bools = self.proved[after] & (self.proved[before] | (self.t_ns[after] == t_ns))
        return proved

    def anchor(self, sample: int) -> TrueAnchor:
        """The places of one sample; what a step left open widens it like the clock."""
        open_m = max(float((known.high_m - known.low_m)[sample]) for known in self.paths)
        return TrueAnchor(
            t_ns=int(self.t_ns[sample]),
            places=tuple(dict.fromkeys(known.place(sample) for known in self.paths)),
            sigma_m=float(self.sigma_m[sample]),
            kind=Evidence.REFERENCE,
            clock_m=float(self.clock_m[sample]) + open_m,
            proved=bool(self.proved[sample]),
        )

    @property
    def doubtful(self) -> Bools:
        """Samples of which nobody knows how far they are off: the reference drifted, and no read says since when."""
        return np.asarray(np.logical_or.reduce([~np.isfinite(known.low_m) for known in self.paths]))

    def doubtful_spans(self) -> list[tuple[int, int]]:
        """The times of these samples, ends left out."""
        return [(int(self.t_ns[first]) - 1, int(self.t_ns[last]) + 1) for first, last in spans_of(self.doubtful)]

    def trusted(self) -> list[KnownStretch]:
        """The parts without doubtful samples."""
        if not self.doubtful.any():
            return [self]
        return [self._part(slice(first, last + 1)) for first, last in spans_of(~self.doubtful) if last > first]

    def _part(self, rows: slice) -> KnownStretch:
        return replace(
            self,
            t_ns=self.t_ns[rows],
            sigma_m=self.sigma_m[rows],
            clock_m=self.clock_m[rows],
            paths=tuple(known.part(rows) for known in self.paths),
            proved=self.proved[rows],
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
        counted_m = counter.odometer.proved_between(stretch.t_ns[begin], stretch.t_ns[end])
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
    witnesses: Witnesses,
    reads: Sequence[TrueAnchor],
    ahead_m: float,
    config: Configuration,
    beyond: Beyond | None = None,
) -> KnownStretch:
    """The stretch as evidence; `reads` close a step of the reference where they confirm it.

    `beyond`: what the reference does on both sides of the stretch.
    """
    beyond = beyond or Beyond()
    t_ns = side.stretch.t_ns - round(clock.shift_s * NS_PER_S)
    stretch = replace(side.stretch, t_ns=t_ns)
    paths: list[KnownPath] = []
    speed_mps = np.zeros(t_ns.size)
    levels: list[Levels] = []
    for path in stretch.paths:
        at_m = path.at_m - side.sense * ahead_m
        path_mps = _speed_mps(t_ns, at_m, path.leg)
        speed_mps = np.maximum(speed_mps, path_mps)
        known = KnownPath(path, side.sense, at_m, at_m, at_m, np.zeros(t_ns.size))
        reads_ns = _confirming_ns(known, stretch, path_mps * clock.delta_s, reads, config.hazards)
        steps = contradictions(known, side.stretch, witnesses, config)
        of_path = Levels.of(steps, t_ns, reads_ns)
        levels.append(of_path.seen(side.sense))
        paths.append(left_open(known, t_ns, steps, of_path, beyond.seen(side.sense)))
    since_s = (t_ns - t_ns[0]) / NS_PER_S
    around = [np.interp(since_s + late_s, since_s, speed_mps) for late_s in (-clock.delta_s, 0.0, clock.delta_s)]
    clock_m = np.maximum.reduce(around) * clock.delta_s
    proved = shown_on_its_track(stretch, config)
    return KnownStretch(
        t_ns, stretch.sigma_m, clock_m, tuple(paths), proved, stretch, levels[0], round(clock.delta_s * NS_PER_S)
    )


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


@dataclass(frozen=True)
class ReferenceStep:
    """From one sample to the next the reference moves by `step_m` more than every odometer; more than `noise_m`.

    `span`: samples over which it drifted by so much, where it was no step.
    """

    sample: int
    step_m: float
    noise_m: float
    span: tuple[int, int] | None = None


@dataclass(frozen=True)
class Witnesses:
    """The independent odometers that may contradict a reference.

    `lag_s`, `clock_s`: stamps of the reference less those of the odometers, as measured, and how far that may be off;
    `scales`, `scale_doubts`: true over counted distance where no vehicle file gives it, and the sigma of that;
    `signed`: they count down when the train goes back.
    """

    counters: tuple[Counter, ...]
    lag_s: float
    clock_s: float
    scales: tuple[float, ...]
    scale_doubts: tuple[float, ...]
    signed: bool

    @classmethod
    def of(
        cls,
        counters: Sequence[Counter],
        lag: RecorderLag,
        signed: bool,
        config: Configuration,
    ) -> Self:
        """Scale by the vehicle file, else as measured with the lag, else within 5 % (SUBSET-041 5.3.1.1)."""
        factor = config.hazards.evidence_factor
        known = np.isfinite(lag.sigma_s)
        clock_s = factor * lag.sigma_s if known else config.hazards.evidence_clock_s
        share = config.lds.odometer_share
        scales = [1.0] * len(counters)
        # At k_T sigmas the 5 % of an odometer of which nothing is known.
        doubts = [share / config.align.sure_sigmas] * len(counters)
        if counters and counters[0].by_file:
            doubts[0] = 0.0  # its variance holds that of the file's scale
        elif counters and factor * lag.scale_sigma < share:
            scales[0] = lag.scale
            doubts[0] = lag.scale_sigma
        return cls(tuple(counters), lag.lag_s, clock_s, tuple(scales), tuple(doubts), signed)


def contradictions(
    known: KnownPath, stretch: ReferenceStretch, witnesses: Witnesses, config: Configuration
) -> list[ReferenceStep]:
    """Steps that every odometer contradicts by more than k_T sigmas: between samples, over 10 s and over 100 s.

    A step between samples is one that the speed around it does not explain. Of a window the difference that no step in
    it explains counts as one step in its middle: the reference drifted, or stood still (DOMAIN section 5.1). Over 100 s
    the fixed 5 m of an odometer, its slip, are allowed too: so drifts of 0.1 m/s show.
    """
    t_ns = stretch.t_ns
    if t_ns.size < 2 or not witnesses.counters:
        return []
    factor = config.align.sure_sigmas
    rows = np.arange(t_ns.size)
    step_m, root_m = _contradicted(known, stretch, witnesses, rows[:-1], rows[1:])
    limit_m = factor * root_m
    stepped = np.flatnonzero((np.abs(step_m) > limit_m) & _uneven(known.at_m, t_ns, limit_m))
    steps = [ReferenceStep(row, float(step_m[row]), float(limit_m[row])) for row in stepped.tolist()]
    gathered_m = np.zeros(t_ns.size)
    gathered_m[1:][stepped] = step_m[stepped]
    # A counter without a sign says nothing of a window in which the train may have turned.
    windows = () if not witnesses.signed else ((_WINDOW_S, 0.0), (_LONG_WINDOW_S, config.lds.odometer_fixed_m))
    for window_s, fixed_m in windows:
        found = _drifts(known, stretch, witnesses, np.cumsum(gathered_m), (window_s, fixed_m), config)
        for step in found:
            gathered_m[step.sample + 1] += step.step_m
        steps += found
    return sorted(steps, key=lambda step: step.sample)


def _drifts(
    known: KnownPath,
    stretch: ReferenceStretch,
    witnesses: Witnesses,
    explained_m: Floats,
    window: tuple[float, float],
    config: Configuration,
) -> list[ReferenceStep]:
    """Windows (length [s], fixed error of odometers [m]) that the odometers contradict beyond `explained_m` of steps.

    Their tolerance is k_T roots, the clock at a change of speed, and k sigmas of the scale on the way.
    """
    t_ns = stretch.t_ns
    window_s, fixed_m = window
    ends = np.unique(np.searchsorted(t_ns, np.arange(int(t_ns[0]), int(t_ns[-1]), round(window_s * NS_PER_S))))
    begin = ends[:-1]
    end = ends[1:]
    if begin.size == 0:
        return []
    whole_m, root_m = _contradicted(known, stretch, witnesses, begin, end)
    rest_m = whole_m - (explained_m[end] - explained_m[begin])
    speed_mps = _speed_mps(t_ns, known.at_m, known.path.leg)
    late_m = witnesses.clock_s * np.abs(speed_mps[end] - speed_mps[begin])
    allowed_m = config.align.sure_sigmas * root_m + late_m + fixed_m
    windows = np.flatnonzero((whole_m != 0.0) & (np.abs(rest_m) > allowed_m)).tolist()
    return [
        ReferenceStep(
            sample=int(begin[row] + end[row]) // 2,
            step_m=float(rest_m[row]),
            noise_m=float(allowed_m[row]),
            span=(int(begin[row]), int(end[row])),
        )
        for row in windows
    ]


@dataclass(frozen=True)
class Levels:
    """The samples between steps that last, with how high each lies over the first; `confirmed` by a read.

    `drifts`: the step before it is a drift of unknown size; `spikes`: steps that lead back to where they began.
    """

    rows: tuple[slice, ...]
    heights_m: Floats
    confirmed: Bools
    drifts: Bools
    spikes: tuple[tuple[ReferenceStep, ReferenceStep], ...] = ()

    @classmethod
    def of(cls, steps: Sequence[ReferenceStep], t_ns: Ints, reads_ns: Sequence[int]) -> Levels:
        lasting, spikes = _without_spikes(steps, t_ns)
        borders = [0, *(step.sample + 1 for step in lasting), t_ns.size]
        rows = [slice(first, max(last, first)) for first, last in pairwise(borders)]
        heard = np.searchsorted(t_ns, np.array(reads_ns, dtype=np.int64))
        confirmed = np.array([bool(((heard >= part.start) & (heard < part.stop)).any()) for part in rows])
        heights_m = np.concatenate([[0.0], np.cumsum([step.step_m for step in lasting])])
        drifts = np.array([False, *(step.span is not None for step in lasting)])
        return cls(tuple(rows), heights_m, confirmed, drifts, tuple(spikes))

    def seen(self, sense: int) -> Levels:
        """As the odometer counts up, or back along the path."""
        return replace(self, heights_m=sense * self.heights_m)

    @property
    def doubts(self) -> int:
        """Steps of which no read says which side was right; between two confirmed levels the odometer failed."""
        return int((~(self.confirmed[:-1] & self.confirmed[1:])).sum())

    @property
    def rise_m(self) -> float:
        """The last level over the first [m]; NaN where a drift lies between them."""
        return float("nan") if self.drifts.any() else float(self.heights_m[-1])


@dataclass(frozen=True)
class Beyond:
    """Levels of the reference before and after a stretch, up to one that a read confirms: how high they lie [m].

    `before_m` over its first level, `after_m` over its last one, as the odometer counts up; NaN: nobody knows.
    """

    before_m: tuple[float, ...] = ()
    after_m: tuple[float, ...] = ()

    def seen(self, sense: int) -> Beyond:
        """As the odometer counts up, or back along the path."""
        return Beyond(tuple(sense * m for m in self.before_m), tuple(sense * m for m in self.after_m))


def left_open(
    known: KnownPath, t_ns: Ints, steps: Sequence[ReferenceStep], levels: Levels, beyond: Beyond
) -> KnownPath:
    """The path with how far behind and ahead of each sample the train may be after and before steps of the reference.

    Which side of a step was right nobody knows: both are possible, forward and backward, as far as the next level that
    a read confirms; without end after a drift, whose size nobody knows. Two steps that cancel each other within ten
    seconds count between them only.
    """
    low_m, high_m, open_step_m = np.zeros((3, t_ns.size))
    for step in steps:
        if step.span is None:
            open_step_m[step.sample] = max(open_step_m[step.sample], abs(step.step_m))
    for first, last in levels.spikes:
        part = slice(first.sample + 1, last.sample + 1)
        low_m[part] = np.minimum(low_m[part], -first.step_m)
        high_m[part] = np.maximum(high_m[part], -first.step_m)
    for number in np.flatnonzero(~levels.confirmed).tolist():
        behind_m = levels.heights_m[number] - _possible_m(levels, number, beyond)
        unknown = bool(np.isnan(behind_m).any())
        rows = levels.rows[number]
        low_m[rows] -= np.inf if unknown else behind_m.max()
        high_m[rows] -= -np.inf if unknown else behind_m.min()
    for step in steps:
        # While it drifts it is somewhere between the levels before and after.
        rows = slice(*step.span) if step.span else slice(0)
        low_m[rows] = low_m[rows].min(initial=0.0)
        high_m[rows] = high_m[rows].max(initial=0.0)
    return replace(known, low_m=known.at_m + low_m, high_m=known.at_m + high_m, step_m=open_step_m)


def _possible_m(levels: Levels, number: int, beyond: Beyond) -> Floats:
    """Levels at which the reference may have been right when it was at this one [m]; NaN where a drift lies between."""
    first = number
    while first > 0 and not levels.confirmed[first]:
        first -= 1
    last = number
    while last < levels.confirmed.size - 1 and not levels.confirmed[last]:
        last += 1
    group = levels.heights_m[first : last + 1].copy()
    if levels.drifts[first + 1 : last + 1].any():
        group[0] = np.nan
    before_m = beyond.before_m if first == 0 and not levels.confirmed[0] else ()
    after_m = beyond.after_m if last == levels.confirmed.size - 1 and not levels.confirmed[-1] else ()
    return np.concatenate([group, before_m, levels.heights_m[-1] + np.array(after_m)])


def levels_beyond(stretches: Sequence[Levels], steps_m: Sequence[float]) -> list[Beyond]:
    """For each stretch the levels on both sides of it; `steps_m`: of the reference in the gaps between them."""
    reversed_steps = [-step_m for step_m in reversed(steps_m)]
    before = _behind(stretches, steps_m, back=False)
    after = _behind(stretches[::-1], reversed_steps, back=True)[::-1]
    return [Beyond(tuple(was), tuple(comes)) for was, comes in zip(before, after, strict=True)]


def _behind(stretches: Sequence[Levels], steps_m: Sequence[float], back: bool) -> list[list[float]]:
    """For each stretch, in this order, the levels of those before it, over its near end [m]."""
    behind: list[list[float]] = []
    met: list[float] = []
    for number, levels in enumerate(stretches):
        behind.append(list(met))
        if number == len(steps_m):
            break
        heights_m = levels.heights_m[::-1] if back else levels.heights_m
        confirmed = levels.confirmed[::-1] if back else levels.confirmed
        own_m = heights_m - heights_m[-1]
        if levels.drifts.any():
            own_m = np.full(own_m.size, np.nan)
        if confirmed.any():
            # What lies before a confirmed level says nothing here.
            own_m = heights_m[int(np.flatnonzero(confirmed)[-1]) :] - heights_m[-1]
            met = []
        rise_m = levels.rise_m * (-1.0 if back else 1.0)
        met = [height_m - rise_m - steps_m[number] for height_m in met]
        met += (own_m - steps_m[number]).tolist()
    # A reference without any step, and without a gap that does not close, leaves nothing open.
    return [list(dict.fromkeys(heights_m)) for heights_m in behind]


def _without_spikes(
    steps: Sequence[ReferenceStep], t_ns: Ints
) -> tuple[list[ReferenceStep], list[tuple[ReferenceStep, ReferenceStep]]]:
    """The steps that last, and pairs that lead back to where they began."""
    lasting: list[ReferenceStep] = []
    spikes: list[tuple[ReferenceStep, ReferenceStep]] = []
    for step in steps:
        before = lasting[-1] if lasting else None
        soon = before is not None and int(t_ns[step.sample] - t_ns[before.sample]) <= round(_WINDOW_S * NS_PER_S)
        if before is not None and soon and abs(before.step_m + step.step_m) <= np.hypot(before.noise_m, step.noise_m):
            spikes.append((before, step))
            lasting.pop()
        else:
            lasting.append(step)
    return lasting, spikes


def _uneven(at_m: Floats, t_ns: Ints, limit_m: Floats) -> Bools:
    """Steps that the speed around them does not explain: these are of the reference, not of a failing odometer."""
    dt_s = np.diff(t_ns) / NS_PER_S
    speed_mps = np.diff(at_m) / dt_s
    beside = max(1, round(_EVEN_S / float(np.median(dt_s))))
    around = sliding_window_view(np.pad(speed_mps, beside, mode="edge"), 2 * beside + 1)
    return np.greater(np.abs(speed_mps - np.median(around, axis=1)) * dt_s, limit_m)


def _contradicted(
    known: KnownPath, stretch: ReferenceStretch, witnesses: Witnesses, begin: Ints, end: Ints
) -> tuple[Floats, Floats]:
    """Per way between samples: its difference from the odometer that agrees best, and the sigma of that [m].

    `stretch`: with the stamps of the reference; compared at the lag that was measured.
    """
    t_ns = stretch.t_ns - round(witnesses.lag_s * NS_PER_S)
    least = np.full(begin.size, np.inf)
    root = np.ones(begin.size)
    for counter, scale, doubt in zip(witnesses.counters, witnesses.scales, witnesses.scale_doubts, strict=True):
        way = counter.between(t_ns[begin], t_ns[end])
        step_sigma_m = np.sqrt(
            stretch.sigma_m[end] ** 2 + stretch.sigma_m[begin] ** 2 + way.variance_m2 + (doubt * way.distance_m) ** 2
        )
        way_m = known.at_m[end] - known.at_m[begin]
        sure_m = np.where(way.bound_m > 0.0, np.nan, way.distance_m)
        # Others may count the other way round.
        agreed_m = np.nansum(way_m * sure_m)
        sense = known.sense if counter is witnesses.counters[0] or agreed_m == 0.0 else np.sign(agreed_m)
        counted_m = sense * scale * sure_m
        if not witnesses.signed:
            counted_m = np.where(way_m * counted_m < 0.0, -counted_m, counted_m)
        off_m = way_m - counted_m
        nearer = np.isfinite(off_m) & (np.abs(off_m) / step_sigma_m < np.abs(least) / root)
        least = np.where(nearer, off_m, least)
        root = np.where(nearer, step_sigma_m, root)
    whole = known.path.leg[begin] == known.path.leg[end]
    return np.where(whole & np.isfinite(least), least, 0.0), root


def shown_on_its_track(stretch: ReferenceStretch, config: Configuration) -> Bools:
    """Samples that no neighbouring track can have made, whether the survey holds it or not (DOMAIN section 5.0).

    By the median over 200 m about each the reference lies within the spacing of tracks, less k roots, of its track; per
    sample, of the worst of the paths.
    """
    if config.evidence.survey_complete:
        return np.ones(stretch.t_ns.size, dtype=np.bool_)
    proved = np.ones(stretch.t_ns.size, dtype=np.bool_)
    for path in stretch.paths:
        spare_m = config.evidence.track_spacing_m - config.hazards.evidence_factor * path.root_m
        way_m = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path.at_m)))])
        proved &= median_about(path.aside_m, way_m, config.evidence.survey_window_m) <= median_about(
            spare_m, way_m, config.evidence.survey_window_m
        )
    return proved


def median_about(values: Floats, way_m: Floats, window_m: float) -> Floats:
    """Median over `window_m` of the way about each sample, taken every quarter of it; over 5 samples at least."""
    if values.size == 0:
        return values
    places_m = np.arange(way_m[0], way_m[-1] + 0.25 * window_m, 0.25 * window_m)
    first = np.searchsorted(way_m, places_m - 0.5 * window_m)
    last = np.searchsorted(way_m, places_m + 0.5 * window_m, side="right")
    short = np.maximum(_FEWEST_IN_WINDOW - (last - first), 0)
    first = np.maximum(first - short, 0)
    last = np.minimum(last + short, values.size)
    medians = [float(np.median(values[low:high])) for low, high in zip(first.tolist(), last.tolist(), strict=True)]
    nearest = np.rint((way_m - way_m[0]) / (0.25 * window_m)).astype(np.int64).clip(0, places_m.size - 1)
    return np.asarray(np.array(medians)[nearest])


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
