"""What contradicts a reference: steps, stands, drifts and leaps, by an odometer or by what a train can drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.stages.evidence.carrying import Lags, SignedOdometer, recorder_clock
from pipeline.stages.odometry.polarity import relative_sense
from pipeline.stages.odometry.regression import ScaleLag
from pipeline.stages.reference import ReferencePath, ReferenceStretch
from pipeline.stages.track.path import Place
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import Configuration
from schemas.frozen import frozen

# DOMAIN section 5.1: the reference is held against the odometer over so long; a spike is no longer [s].
_WINDOW_S = 10.0
_LONG_WINDOW_S = 100.0
# Long windows begin again half-way: a drift that two of them share lies within one of the others.
_BEGUN_S = (0.0, 0.5 * _LONG_WINDOW_S)
# Least number of samples for a median.
_FEWEST_IN_WINDOW = 5
# Numerics: the speed is compared with its median over this time before and after [s].
EVEN_S = 2.0


@frozen
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

    def some_rows(self, rows: slice) -> KnownPath:
        """The path at some of its samples only."""
        arrays = {name: getattr(self, name)[rows] for name in ("at_m", "low_m", "high_m", "step_m")}
        return replace(self, path=self.path.some_rows(rows), **arrays)

    def place(self, sample: int) -> Place:
        """Net element and measure of one sample."""
        element, measure, _ = self.path.legs[int(self.path.leg[sample])].locate(self.at_m[[sample]])
        return Place(int(element[0]), float(measure[0]))


def path_speed_mps(t_ns: Ints, at_m: Floats, leg: Ints) -> Floats:
    """Speed over a second about each sample [m/s]."""
    half_ns = NS_PER_S // 2
    end = np.minimum(np.searchsorted(t_ns, t_ns + half_ns), t_ns.size - 1)
    # A slow log has no other sample within the second before its last one.
    begin = np.minimum(np.searchsorted(t_ns, t_ns - half_ns), np.maximum(end - 1, 0))
    elapsed_s = np.maximum((t_ns[end] - t_ns[begin]) / NS_PER_S, 1e-9)
    return np.where((leg[begin] == leg[end]) & (end > begin), np.abs(at_m[end] - at_m[begin]) / elapsed_s, 0.0)


@frozen
class ReferenceStep:
    """From sample `sample` to the next the reference moves by `step_m` more than every odometer, and than `noise_m`.

    `span`: samples over which it drifted by so much, where it was no step; `leap`: no odometer says so, but no train
    can drive it.
    """

    sample: int
    step_m: float
    noise_m: float
    span: tuple[int, int] | None = None
    leap: bool = False


@frozen
class Witness:
    """An odometer that may contradict a reference.

    `lag_s`, `clock_s`: stamps of the reference less its own, as measured, and how far that may be off; `scale`,
    `scale_sigma`: true over counted distance where no vehicle file gives it.
    """

    counter: SignedOdometer
    lag_s: float = 0.0
    clock_s: float = 0.0
    scale: float = 1.0
    scale_sigma: float = 0.0

    @classmethod
    def with_measured_scale(cls, counter: SignedOdometer, lags: Lags, config: Configuration) -> Self:
        """The odometer with its scale by the vehicle file, else as measured, else within 5 % (SUBSET-041 5.3.1.1)."""
        factor = config.hazards.evidence_factor
        share = config.lds.odometer_share
        clock = recorder_clock([lags], independent=True, config=config.hazards)
        if counter.has_known_scale:
            # The variance of a distance holds that of the file's scale.
            return cls(counter, clock.shift_s, clock.delta_s)
        best = min(lags.found, key=lambda lag: lag.scale_sigma, default=ScaleLag())
        if factor * best.scale_sigma < share:
            return cls(counter, clock.shift_s, clock.delta_s, best.scale, best.scale_sigma)
        # At k_T sigmas the 5 % of an odometer of which nothing is known.
        return cls(counter, clock.shift_s, clock.delta_s, 1.0, share / config.align.sure_sigmas)


def find_contradictions(
    known: KnownPath, stretch: ReferenceStretch, witnesses: Sequence[Witness], config: Configuration
) -> list[ReferenceStep]:
    """Steps that no train can drive, or that an odometer contradicts by more than k_T sigmas, over 10 s and 100 s too.

    A step between samples is one that the speed around it does not explain. Where no odometer says what it should be,
    lost or hung with the reference in one logger, a leap shows it alone. Of a window the difference that no step in it
    explains counts as one step in its middle: the reference drifted, or stood still (DOMAIN section 5.1). Over 100 s
    the fixed 5 m of an odometer, its slip, are allowed too: so drifts of 0.1 m/s show.
    """
    t_ns = stretch.t_ns
    if t_ns.size < 2:
        return []
    rows = np.arange(t_ns.size)
    nothing_m = np.zeros(t_ns.size - 1)
    step_m, limit_m = _differences_m(known, stretch, witnesses, (rows[:-1], rows[1:]), nothing_m, config)
    leap_m, leap_limit_m = _beyond_driving_m(known, stretch, config)
    contradicted = np.abs(step_m) > limit_m
    contradicted[contradicted] = (_beyond_speed_m(known.at_m, t_ns, limit_m) != 0.0)[contradicted]
    step_m = np.where(contradicted, step_m, leap_m)
    limit_m = np.where(contradicted, limit_m, leap_limit_m)
    stepped = np.flatnonzero(step_m)
    steps = [
        ReferenceStep(row, float(step_m[row]), float(limit_m[row]), leap=not contradicted[row])
        for row in stepped.tolist()
    ]
    gathered_m = np.zeros(t_ns.size)
    gathered_m[1:][stepped] = step_m[stepped]
    for window in (
        (_WINDOW_S, 0.0, 0.0),
        *((_LONG_WINDOW_S, late_s, config.lds.odometer_fixed_m) for late_s in _BEGUN_S),
    ):
        found = _find_drifts(known, stretch, witnesses, np.cumsum(gathered_m), window, config)
        for step in found:
            gathered_m[step.sample + 1] += step.step_m
        steps += found
    return sorted(steps, key=lambda step: step.sample)


def _find_drifts(
    known: KnownPath,
    stretch: ReferenceStretch,
    witnesses: Sequence[Witness],
    explained_m: Floats,
    window: tuple[float, float, float],
    config: Configuration,
) -> list[ReferenceStep]:
    """Windows in which an odometer contradicts the reference by more than the steps explain (`explained_m`).

    `window`: length, first begin [s], and what an odometer may be off whatever it counted [m]. Next to one that is
    contradicted the reference may have drifted already, or still, where no odometer counted.
    """
    t_ns = stretch.t_ns
    window_s, late_s, fixed_m = window
    begin_ns = int(t_ns[0]) + round(late_s * NS_PER_S)
    ends = np.unique(np.searchsorted(t_ns, np.arange(begin_ns, int(t_ns[-1]), round(window_s * NS_PER_S))))
    begin = ends[:-1]
    end = ends[1:]
    if begin.size == 0:
        return []
    explained_m = explained_m[end] - explained_m[begin]
    rest_m, allowed_m = _differences_m(known, stretch, witnesses, (begin, end), explained_m, config)
    allowed_m += fixed_m
    counted = np.flatnonzero(np.isfinite(allowed_m))
    steps: list[ReferenceStep] = []
    for row in np.flatnonzero(np.abs(rest_m) > allowed_m).tolist():
        at = int(np.searchsorted(counted, row))
        first = int(counted[at - 1]) + 1 if at else 0
        last = int(counted[at + 1]) - 1 if at + 1 < counted.size else begin.size - 1
        steps.append(
            ReferenceStep(
                sample=int(begin[row] + end[row]) // 2,
                step_m=float(rest_m[row]),
                noise_m=float(allowed_m[row]),
                span=(int(begin[first]), int(end[last])),
            )
        )
    return steps


@frozen
class Levels:
    """The samples between lasting steps of a reference, with how high each level lies over the first one [m].

    `confirmed`: by a read. `drifts`: the step before it is a drift of unknown size; `spikes`: steps that lead back to
    where they began.
    """

    rows: tuple[slice, ...]
    heights_m: Floats
    confirmed: Bools
    drifts: Bools
    spikes: tuple[tuple[ReferenceStep, ReferenceStep], ...] = ()

    @classmethod
    def between_steps(cls, steps: Sequence[ReferenceStep], t_ns: Ints, reads_ns: Sequence[int]) -> Levels:
        """The levels between steps of a reference; reads confirm those that they lie in."""
        lasting, spikes = _part_spikes(steps, t_ns)
        heard = np.searchsorted(t_ns, np.array(reads_ns, dtype=np.int64))
        begins = [(step.sample + 1, step.step_m, step.span is not None) for step in lasting]
        for leap in (step for step in lasting if step.leap):
            # Reads before and after say of an odometer that it failed; of a leap that the reference was off between.
            before, after = heard[heard <= leap.sample], heard[heard > leap.sample]
            begins += [(row, 0.0, False) for row in (*(before[-1:] + 1).tolist(), *after[:1].tolist())]
        begins.sort(key=lambda begin: begin[0])
        borders = [0, *(begin for begin, _, _ in begins), t_ns.size]
        rows = [slice(first, max(last, first)) for first, last in pairwise(borders)]
        confirmed = np.array([bool(((heard >= part.start) & (heard < part.stop)).any()) for part in rows])
        heights_m = np.concatenate([[0.0], np.cumsum([step_m for _, step_m, _ in begins])])
        drifts = np.array([False, *(drift for _, _, drift in begins)])
        return cls(tuple(rows), heights_m, confirmed, drifts, tuple(spikes))

    def oriented(self, sense: int) -> Levels:
        """The same with heights as the odometer counts up (`sense` +1), or back along the path (-1)."""
        return replace(self, heights_m=sense * self.heights_m)

    @property
    def count_doubted_steps(self) -> int:
        """Number of steps of which no read says which side was right.

        Between two confirmed levels the odometer failed.
        """
        return int((~(self.confirmed[:-1] & self.confirmed[1:])).sum())

    @property
    def rise_m(self) -> float:
        """The last level over the first [m]; NaN where a drift lies between them."""
        return float("nan") if self.drifts.any() else float(self.heights_m[-1])


@frozen
class LevelsBeyond:
    """Levels of the reference before and after a stretch, up to one that a read confirms: how high they lie [m].

    `before_m` over its first level, `after_m` over its last one, as the odometer counts up; NaN: nobody knows.
    """

    before_m: tuple[float, ...] = ()
    after_m: tuple[float, ...] = ()

    def oriented(self, sense: int) -> LevelsBeyond:
        """The same with heights as the odometer counts up (`sense` +1), or back along the path (-1)."""
        return LevelsBeyond(tuple(sense * m for m in self.before_m), tuple(sense * m for m in self.after_m))


def open_for_steps(
    known: KnownPath, t_ns: Ints, steps: Sequence[ReferenceStep], levels: Levels, beyond: LevelsBeyond
) -> KnownPath:
    """The path with how far behind and ahead of each sample the train may be, because the reference stepped.

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
        behind_m = ahead_m = -first.step_m
        for begin, end in (step.span for step in (first, last) if step.span is not None):
            # It drifted before the step or after it: nobody knows when within its window.
            part = slice(min(part.start, begin), max(part.stop, end))
            behind_m, ahead_m = -abs(first.step_m), abs(first.step_m)
        low_m[part] = np.minimum(low_m[part], behind_m)
        high_m[part] = np.maximum(high_m[part], ahead_m)
    for number in np.flatnonzero(~levels.confirmed).tolist():
        behind_m = levels.heights_m[number] - _possible_levels_m(levels, number, beyond)
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


def _possible_levels_m(levels: Levels, number: int, beyond: LevelsBeyond) -> Floats:
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


def levels_beyond(stretches: Sequence[Levels], steps_m: Sequence[float]) -> list[LevelsBeyond]:
    """The levels on both sides of each stretch; `steps_m`: of the reference in the gaps between them."""
    reversed_steps = [-step_m for step_m in reversed(steps_m)]
    before = _levels_before_m(stretches, steps_m, back=False)
    after = _levels_before_m(stretches[::-1], reversed_steps, back=True)[::-1]
    return [LevelsBeyond(tuple(was), tuple(comes)) for was, comes in zip(before, after, strict=True)]


def _levels_before_m(stretches: Sequence[Levels], steps_m: Sequence[float], back: bool) -> list[list[float]]:
    """The levels of all stretches before each, in this order, over its near end [m]."""
    behind: list[list[float]] = []
    levels_so_far_m: list[float] = []
    for number, levels in enumerate(stretches):
        behind.append(list(levels_so_far_m))
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
            levels_so_far_m = []
        rise_m = levels.rise_m * (-1.0 if back else 1.0)
        levels_so_far_m = [height_m - rise_m - steps_m[number] for height_m in levels_so_far_m]
        levels_so_far_m += (own_m - steps_m[number]).tolist()
    # A reference without any step, and without a gap that does not close, leaves nothing open.
    return [list(dict.fromkeys(heights_m)) for heights_m in behind]


def _part_spikes(
    steps: Sequence[ReferenceStep], t_ns: Ints
) -> tuple[list[ReferenceStep], list[tuple[ReferenceStep, ReferenceStep]]]:
    """The steps that last, and the pairs of steps that lead back to where they began."""
    lasting: list[ReferenceStep] = []
    spikes: list[tuple[ReferenceStep, ReferenceStep]] = []
    for step in steps:
        before = lasting[-1] if lasting else None
        soon = before is not None and int(t_ns[step.sample] - t_ns[before.sample]) <= round(_WINDOW_S * NS_PER_S)
        # A leap that ends a standstill is no return from it.
        soon = soon and before is not None and before.leap == step.leap
        if before is not None and soon and abs(before.step_m + step.step_m) <= np.hypot(before.noise_m, step.noise_m):
            spikes.append((before, step))
            lasting.pop()
        else:
            lasting.append(step)
    return lasting, spikes


def _beyond_speed_m(at_m: Floats, t_ns: Ints, least_m: Floats) -> Floats:
    """How far each step leads beyond the speed of the 2 s before and after it, as the median has it [m].

    0 where that is `least_m` at most: such a step a train may drive, however its odometer fails.
    """
    dt_s = np.diff(t_ns) / NS_PER_S
    speed_mps = np.diff(at_m) / dt_s
    reach = max(1, round(EVEN_S / float(np.median(dt_s))))
    around = sliding_window_view(np.pad(speed_mps, reach, mode="edge"), 2 * reach + 1)
    # A median lies among its values: far from it lie few.
    farthest_mps = np.maximum(around.max(axis=1) - speed_mps, speed_mps - around.min(axis=1))
    rows = np.flatnonzero(farthest_mps * dt_s > least_m)
    beyond_m = np.zeros(dt_s.size)
    beyond_m[rows] = (speed_mps[rows] - np.median(around[rows], axis=1)) * dt_s[rows]
    return np.where(np.abs(beyond_m) > least_m, beyond_m, 0.0)


def _beyond_driving_m(known: KnownPath, stretch: ReferenceStretch, config: Configuration) -> tuple[Floats, Floats]:
    """How far each step of the reference leads beyond what a train can drive, else 0 [m]; and what is allowed [m]."""
    dt_s = np.diff(stretch.t_ns) / NS_PER_S
    root_m = np.hypot(stretch.sigma_m[1:], stretch.sigma_m[:-1])
    driven_m = config.align.braking_mps2 * np.maximum(dt_s, EVEN_S) * dt_s
    allowed_m = config.align.sure_sigmas * root_m + driven_m
    same_leg = np.diff(known.path.leg) == 0
    return np.where(same_leg, _beyond_speed_m(known.at_m, stretch.t_ns, allowed_m), 0.0), allowed_m


def _differences_m(
    known: KnownPath,
    stretch: ReferenceStretch,
    witnesses: Sequence[Witness],
    pairs: tuple[Ints, Ints],
    explained_m: Floats,
    config: Configuration,
) -> tuple[Floats, Floats]:
    """Per pair of samples: how far the reference differs from the odometer that contradicts it most [m], and its limit.

    Less what is explained. The limit: k_T sigmas, the clock at a change of speed, and what the odometer itself doubts
    of its distance. `stretch`: with the stamps of the reference; each is compared at the lag that was measured.
    """
    begin, end = pairs
    moved_m = known.at_m[end] - known.at_m[begin]
    speed_mps = path_speed_mps(stretch.t_ns, known.at_m, known.path.leg)
    change_mps = np.abs(speed_mps[end] - speed_mps[begin])
    rest_m = np.zeros(begin.size)
    allowed_m = np.full(begin.size, np.inf)
    excess_m = np.full(begin.size, -np.inf)
    whole = known.path.leg[begin] == known.path.leg[end]
    for number, witness in enumerate(witnesses):
        t_ns = stretch.t_ns - round(witness.lag_s * NS_PER_S)
        distance = witness.counter.distance_and_variance(t_ns[begin], t_ns[end])
        # Others may count with the other sign.
        least_m = config.matching.orientation_distance_m
        sense = relative_sense(distance.distance_m, moved_m, least_m) if number else known.sense
        counted_m = sense * witness.scale * distance.distance_m
        if not witness.counter.signed:
            counted_m = np.where(moved_m * counted_m < 0.0, -counted_m, counted_m)
        variance_m2 = stretch.sigma_m[end] ** 2 + stretch.sigma_m[begin] ** 2 + distance.variance_m2
        root_m = np.sqrt(variance_m2 + (witness.scale_sigma * distance.distance_m) ** 2)
        limit_m = config.align.sure_sigmas * root_m + witness.clock_s * change_mps + distance.bound_m
        off_m = moved_m - counted_m - explained_m
        beyond_m = np.abs(off_m) - limit_m
        more = whole & np.isfinite(beyond_m) & (beyond_m > excess_m)
        rest_m = np.where(more, off_m, rest_m)
        allowed_m = np.where(more, limit_m, allowed_m)
        excess_m = np.where(more, beyond_m, excess_m)
    return rest_m, allowed_m


def running_median(values: Floats, distance_m: Floats, window_m: float) -> Floats:
    """Median over `window_m` of the distance about each sample, every quarter of it, of 5 samples at least."""
    if not np.any(values != values[:1]):
        return values
    places_m = np.arange(distance_m[0], distance_m[-1] + 0.25 * window_m, 0.25 * window_m)
    first = np.searchsorted(distance_m, places_m - 0.5 * window_m)
    last = np.searchsorted(distance_m, places_m + 0.5 * window_m, side="right")
    short = np.maximum(_FEWEST_IN_WINDOW - (last - first), 0)
    first = np.maximum(first - short, 0)
    last = np.minimum(last + short, values.size)
    medians = [_median(values[low:high]) for low, high in zip(first.tolist(), last.tolist(), strict=True)]
    nearest = np.rint((distance_m - distance_m[0]) / (0.25 * window_m)).astype(np.int64).clip(0, places_m.size - 1)
    return np.asarray(np.array(medians)[nearest])


def _median(values: Floats) -> float:
    """The median of finite values, ten times faster than `np.median` for as few as lie in a window."""
    half = values.size // 2
    ordered = np.partition(values, (half - 1, half) if values.size > 1 else half)
    return ordered.item(half) if values.size % 2 else 0.5 * (ordered.item(half - 1) + ordered.item(half))
