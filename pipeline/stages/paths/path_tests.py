"""Whether the residuals of a path across its track can be those of a train on it (DOMAIN section 2).

A residual is r = b + e + n: b the bias of the run, turning with the heading, e the survey, of any correlation, n the
receiver. Tested are movements over several windows, the offset, and the lasting offset, each against its own bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from pipeline.stages.paths.path_steps import PathSteps
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig
from schemas.frozen import frozen
from schemas.stages import ONE_TRACK_LEFT

# Windows of the movements [s].
WINDOWS_S = (3.0, 6.0, 12.0, 24.0, 48.0, 96.0, 192.0)
# The nine tests share the level; looks of each in 600 s, of the lasting offset three, after ten steps.
_TESTS = 9.0
LOOKED_S = 600.0
_LASTING_LOOKS, _LASTING_STEPS = 3.0, 10.0
# A window counts with so many of its steps.
_WHOLE = 0.6
# Correlation times of the noise that are thought of, up to the slowest part of DIAG Table 1 [s].
_TAUS_S = np.array([10.0, 20.0, 50.0, 75.0, 100.0, 150.0, 200.0, 300.0, 400.0, 600.0, 1000.0, 2000.0])
# Part of the variance that lasts, and how fast the rest of it averages (DIAG Table 1 at 45 degrees).
_SLOW, _AVERAGED_S = 0.247, 400.0
# Windows up to so long are measured along the track, after so many.
_MEASURED_S, _MEASURED_WINDOWS = 48.0, 6.0


class Verdict(NamedTuple):
    """The first step at which a path is refuted (a large number: at none); the least p-value up to each new step."""

    rejected: int
    p: Floats


class _Test(NamedTuple):
    """Residuals in sigmas and their limits, shapes (windows, n); looks of each window."""

    sigmas: Floats
    limits: Floats
    looks: Floats


class Totals(NamedTuple):
    """Sums over the steps of a path that count: their number, residuals [m], survey's sigmas [m], squared sigmas [m2].

    `to_left_m`, `to_right_m`: how far away the nearest other track lies on that side [m].
    """

    number: float
    residual_m: float
    survey_m: float
    sigma_m2: float
    to_left_m: float
    to_right_m: float


NO_STEPS = Totals(*(0.0 for _ in range(6)))


class Stretch(NamedTuple):
    """Of a path at successive steps: residuals, sigmas of the survey, distances to the nearest tracks left and right
    [m].

    These are 0 where none is within reach; `heading_rad`: of the path, in whose sense residuals and sides are.
    """

    residual_m: Floats
    survey_m: Floats
    to_left_m: Floats
    to_right_m: Floats
    heading_rad: Floats

    @classmethod
    def joined_parts(cls, parts: Sequence[Stretch]) -> Stretch:
        """Parts of a path as one, in order."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def first_steps(self, count: int) -> Stretch:
        """Its first `count` steps."""
        return Stretch(*(column[:count] for column in self))


NO_STRETCH = Stretch(*(np.zeros(0) for _ in range(5)))


@frozen
class Trail:
    """A path as far back as any test looks: from step `start` on, those from `begin` on being new.

    `before`: over all of its steps before `begin`, since its very first one.
    """

    first: int
    start: int
    begin: int
    along: Stretch
    before: Totals


@frozen
class PathTests:
    """The nine tests of residuals at one level, with what a run shows of its noise.

    `alone`: before this step no other track was near, only offsets are tested. `measured_m2`: per window and step the
    variance of a movement along the track so far, NaN where it is not known. `excess`: by how much that is larger than
    the stated sigma has it, 1 at least: stated sigmas may be too small. `late`, `early_end`, `early`: per window and
    step that ends it the first step of it, the step after the window before the last but one, and its first.
    """

    alone: int
    measured_m2: Floats
    excess: Floats
    late: Ints
    early_end: Ints
    early: Ints
    config: MatchingConfig

    @classmethod
    def of_run(cls, steps: PathSteps, alone: int, config: MatchingConfig) -> PathTests:
        """The tests with all that a run shows without a path: windows, noise along the track."""
        windows = np.array([_window_bounds(steps.end_s, window_s) for window_s in WINDOWS_S])
        late, early_end, early = np.moveaxis(windows, 1, 0)
        measured_m2 = np.full(late.shape, np.nan)
        for number, window_s in enumerate(WINDOWS_S):
            if window_s <= _MEASURED_S:
                measured_m2[number] = _measured_movement_variance_m2(steps, window_s)
        return cls(alone, measured_m2, _variance_excess(steps, measured_m2), late, early_end, early, config)

    def offset_limit_m(self, sigma_m: Floats, survey_m: Floats, track_spacing_m: Floats) -> Floats:
        """How far off its track a single step may lie [m]; `track_spacing_m`: to the next track there, 0 for none."""
        root_m = np.sqrt(self.config.cross_bias_sigma_m**2 + survey_m**2 + sigma_m**2)
        return np.asarray(root_m * self._offset_limits(root_m, track_spacing_m, LOOKED_S / self.config.paths_level_s))

    def movement_limit_m(self, sigma_m: Floats, survey_m: Floats) -> Floats:
        """Limit beyond which two means of `paths_level_s`, a while apart, differ on no path [m]."""
        limit = _limit_of_look(self.config.paths_alpha, LOOKED_S / self.config.paths_level_s)
        return np.asarray(limit * np.sqrt(2.0) * np.hypot(sigma_m, survey_m))

    @property
    def longest_s(self) -> float:
        """The longest time that a movement looks back [s]."""
        return 3.0 * WINDOWS_S[-1]

    def sum_steps(self, steps: PathSteps, begin: int, along: Stretch) -> Totals:
        """Sums over the steps of a path from `begin` on."""
        counted = self._step_terms(steps, begin, along)
        return Totals(*(float(value) for value in counted[: len(NO_STEPS)].sum(axis=1)))

    def largest_window_mean_m(self, steps: PathSteps, apart_m: Floats, last: int, window_s: float) -> float:
        """Largest mean, over any window, of differences at the steps before `last` [m], 0 where none counts.

        Windows may end later, where nothing differs; none counts with fewer than `_WHOLE` of its steps.
        """
        size = max(round(window_s / float(steps.period_s[last])), 1)
        # A window without a difference has the mean 0.
        begin = max(int(np.argmax(apart_m != 0.0)) - size, 0)
        apart_m = apart_m[begin:]
        sums = np.zeros(apart_m.size + size + 1)
        np.cumsum(apart_m, out=sums[1 : apart_m.size + 1])
        sums[apart_m.size + 1 :] = sums[apart_m.size]
        counts = np.ones(sums.size)
        counts[0] = 0.0
        counts[1 : apart_m.size + 1] = steps.counted[last - apart_m.size : last]
        counts = np.cumsum(counts)
        number = np.maximum(counts[size:] - counts[:-size], _WHOLE * size)
        return float((np.abs(sums[size:] - sums[:-size]) / number).max(initial=0.0))

    def test_trail(self, steps: PathSteps, trail: Trail) -> Verdict:
        """Test the new steps of a path: the first at which it is refuted, and its least p-value by each."""
        values = self._step_terms(steps, trail.start, trail.along)
        sums = np.zeros((values.shape[0], values.shape[1] + 1))
        np.cumsum(values, axis=1, out=sums[:, 1:])
        at = np.arange(trail.begin, trail.start + values.shape[1])
        refuted = np.zeros(at.size, dtype=np.bool_)
        p = np.ones(at.size)
        tests = [self._test_offset(steps, sums, trail, at)]
        if (apart := at >= self.alone).any():
            looks = LOOKED_S / np.array(WINDOWS_S)
            limits = _limits_of_looks(self.config.paths_alpha, looks)[:, None]
            tests.append(_Test(self._movements_in_sigmas(steps, sums, trail, at) * apart, limits, looks))
            lasting = self._test_lasting_offset(steps, sums, trail, at)
            tests.append(lasting._replace(sigmas=lasting.sigmas * apart))
        for sigmas, limits, looks in tests:
            refuted |= (sigmas > limits).any(axis=0)
            if (_TESTS * looks * 2.0 * _tail_probabilities(sigmas.max(axis=1, initial=0.0))).min() < 1.0:
                p = np.minimum(p, (_TESTS * looks[:, None] * 2.0 * _tail_probabilities(sigmas)).min(axis=0))
        first = np.flatnonzero(refuted)
        return Verdict(int(at[first[0]]) if first.size else 2**62, np.minimum.accumulate(p))

    def _step_terms(self, steps: PathSteps, begin: int, along: Stretch) -> Floats:
        """Terms of the sums, per step; shape (8, n), zero where the step does not count.

        1, residual, sigma of the survey, square of the position's, distances of tracks to both sides, normal (north,
        east).
        """
        count = along.residual_m.size
        part = slice(begin, begin + count)
        counted = steps.counted[part] & np.isfinite(along.residual_m)
        measured = along.residual_m, along.survey_m, steps.sigma_m[part] ** 2, along.to_left_m, along.to_right_m
        values = np.stack([np.ones(count), *measured, np.sin(along.heading_rad), -np.cos(along.heading_rad)])
        return np.where(counted, values, 0.0)

    def _movements_in_sigmas(self, steps: PathSteps, sums: Floats, trail: Trail, at: Ints) -> Floats:
        """Mean of each last window less that of the window before the last but one [sigmas]; shape (windows, n)."""
        late, early_end, early = (
            np.maximum(begin[:, at] - trail.start, 0) for begin in (self.late, self.early_end, self.early)
        )
        now = sums[:, None, at + 1 - trail.start] - sums[:, late]
        then = sums[:, early_end] - sums[:, early]
        window_s = np.array(WINDOWS_S)[:, None]
        period_s = steps.period_s[at]
        whole = _WHOLE * window_s / period_s
        usable = (now[0] >= whole) & (then[0] >= whole) & (window_s >= 2.0 * period_s)
        now_mean, then_mean = (part[1:] / np.maximum(part[0], 1.0) for part in (now, then))
        survey_m2 = now_mean[1] ** 2 + then_mean[1] ** 2
        sigma_m2 = 0.5 * (now_mean[2] + then_mean[2])
        # A bias of any direction moves the mean of a window by its part along the mean normal there.
        swung_m2 = self.config.cross_bias_sigma_m**2 * ((now_mean[5:] - then_mean[5:]) ** 2).sum(axis=0)
        root_m = np.sqrt(np.maximum(survey_m2 + self._movement_variance_m2(steps, sigma_m2, at) + swung_m2, 1e-12))
        spare_m = np.maximum(np.abs(now_mean[0] - then_mean[0]) - 2.0 * self.config.paths_alike_m, 0.0)
        return np.where(usable & np.isfinite(root_m), spare_m / root_m, 0.0)

    def _movement_variance_m2(self, steps: PathSteps, sigma_m2: Floats, at: Ints) -> Floats:
        """Variance of a movement by the receiver: by its sigma, and no less than an odometer shows along the track.

        What is not measured yet, or never, may be correlated for less.
        """
        long, short, shortest = (_largest_movement_ratios(tau_s)[:, None] for tau_s in (50.0, 20.0, 10.0))
        measured_m2 = self.measured_m2[:, at]
        by_odometer_m2 = np.fmax(sigma_m2 * long, self.config.paths_measured_factor * measured_m2)
        soon = np.where(steps.with_odometer[at], short, shortest)
        noise_m2 = np.where(np.isfinite(measured_m2), by_odometer_m2, sigma_m2 * soon)
        lasting = np.array(WINDOWS_S)[:, None] > _MEASURED_S
        return np.where(lasting, sigma_m2 * long * self.excess[at], noise_m2)

    def _test_offset(self, steps: PathSteps, sums: Floats, trail: Trail, at: Ints) -> _Test:
        """The mean of the last seconds against its limit."""
        late = np.searchsorted(steps.end_s, steps.end_s[at] - self.config.paths_level_s, side="right")
        late = np.maximum(np.minimum(late, at) - trail.start, 0)
        part = sums[:, at + 1 - trail.start] - sums[:, late]
        least = _WHOLE * self.config.paths_level_s / steps.period_s[at]
        return self._offset_in_sigmas(part, part[0] >= least, self.excess[at], LOOKED_S / self.config.paths_level_s)

    def _test_lasting_offset(self, steps: PathSteps, sums: Floats, trail: Trail, at: Ints) -> _Test:
        """The mean over the whole path against its limit."""
        own = sums[:, at + 1 - trail.start] - sums[:, [trail.begin - trail.start]]
        part = own[: len(NO_STEPS)] + np.array(trail.before)[:, None]
        lasted_s = np.maximum(steps.end_s[at] - steps.end_s[trail.first], 1e-9)
        share = _SLOW + (1.0 - _SLOW) * np.minimum(1.0, _AVERAGED_S / lasted_s)
        return self._offset_in_sigmas(part, part[0] >= _LASTING_STEPS, share * self.excess[at], _LASTING_LOOKS)

    def _offset_in_sigmas(self, part: Floats, usable: Bools, share: Floats, looks: float) -> _Test:
        """Mean residual over its sigma, 0 where steps are too few.

        `share`: part of the position's variance that lasts.
        """
        mean = part[1:] / np.maximum(part[0], 1.0)
        root_m = np.sqrt(self.config.cross_bias_sigma_m**2 + mean[1] ** 2 + mean[2] * share)
        sigmas = np.where(usable & (root_m > 0.0), np.abs(mean[0]) / np.maximum(root_m, 1e-9), 0.0)
        # If the train is on it all the same, the track on the side of the positions is left instead.
        track_spacing_m = np.where(mean[0] > 0.0, mean[3], mean[4])
        return _Test(sigmas[None], self._offset_limits(root_m, track_spacing_m, looks)[None], np.array([looks]))

    def _offset_limits(self, root_m: Floats, track_spacing_m: Floats, looks: float) -> Floats:
        """Limits of an offset [sigmas], the next track being so far away [m], 0 for none."""
        spacing = np.where(track_spacing_m > 0.0, track_spacing_m / np.maximum(root_m, 1e-9), np.inf)
        return _limits_by_spacing(spacing, self.config.paths_alpha, looks)


def switch_resolution_m(survey_m: Floats, alpha: float, merged_m: float) -> Floats:
    """How far apart tracks must be for a movement from one to the other to show, with exact positions [m]."""
    return np.asarray(_limit_of_look(alpha, LOOKED_S / WINDOWS_S[0]) * np.sqrt(2.0) * survey_m + 2.0 * merged_m)


def offset_resolution_m(survey_m: Floats, alpha: float, bias_m: float) -> Floats:
    """How far apart tracks have to be for a lasting offset to tell them apart, with exact positions [m]."""
    return np.asarray(_limit_of_look(alpha, _LASTING_LOOKS) * np.hypot(bias_m, survey_m))


def _limit_of_look(alpha: float, looks: float) -> float:
    """Limit of one look of a test, of which there are so many in 600 s [sigmas]."""
    return float(_limits_of_looks(alpha, np.array([looks]))[0])


def _limits_of_looks(alpha: float, looks: Floats) -> Floats:
    """Limits of tests [sigmas]: nine share the level alpha, each with so many looks in 600 s."""
    from scipy.special import ndtri

    return np.asarray(-ndtri(alpha / (_TESTS * looks * 2.0)))


def _limits_by_spacing(spacing: Floats, alpha: float, looks: float) -> Floats:
    """Limits of an offset [sigmas], by how many sigmas away the next track lies, infinite for none.

    As seldom as its level says an offset refutes the true track and leaves the neighbouring one: a wrong claim. It
    makes a right one as often as the other track is beyond the limit while the train is on this one. Where that is
    seldom too, the limit grows until of both together no more are wrong than claims may be; at the most up to that of a
    level as much smaller, for what is more seldom is claimed in no run.
    """
    limits, needed = _limits_and_needed(alpha, looks)
    return np.interp(-spacing, -needed, limits)


@cache
def _limits_and_needed(alpha: float, looks: float) -> tuple[Floats, Floats]:
    """Limits of an offset, and how far away another track needs to be for each [sigmas].

    `alpha`: level that the nine tests share; `looks`: of this test in 600 s.
    """
    from scipy.special import ndtri

    share = 1.0 - ONE_TRACK_LEFT
    limits = np.linspace(_limit_of_look(alpha, looks), _limit_of_look(alpha * share, looks), 100)
    # So often the other track has to be beyond the limit, and so far away it is.
    rate = looks * _tail_probabilities(limits) / share
    limits, rate = limits[rate < 1.0], rate[rate < 1.0]
    return limits, limits + ndtri(rate)


def _tail_probabilities(sigmas: Floats) -> Floats:
    """Probability of a standard normal value above so many sigmas."""
    from scipy.special import ndtr

    return np.asarray(ndtr(-sigmas))


@cache
def _largest_movement_ratios(tau_s: float) -> Floats:
    """Variance of a movement over that of the noise in each window, the greatest over all noises of `tau_s` or more.

    Of Gauss-Markov noises with these correlation times.
    """
    taus_s = _TAUS_S[tau_s <= _TAUS_S]
    shares = []
    for window_s in WINDOWS_S:
        samples = max(4, min(int(window_s), 24))
        times = (np.arange(samples) + 0.5) * window_s / samples
        times = np.concatenate([times, times + 2.0 * window_s])
        weights = np.concatenate([np.full(samples, 1.0), np.full(samples, -1.0)]) / samples
        lags = np.abs(times[:, None] - times[None, :])
        shares.append(max(float(weights @ np.exp(-lags / tau) @ weights) for tau in taus_s))
    return np.array(shares)


def _window_bounds(t_s: Floats, window_s: float) -> tuple[Ints, Ints, Ints]:
    """Per step the first step of the last window, the step after the window before the last but one, and its first."""
    late, early_end, early = (np.searchsorted(t_s, t_s - k * window_s, side="right") for k in (1.0, 2.0, 3.0))
    return late, early_end, early


def _variance_excess(steps: PathSteps, measured_m2: Floats) -> Floats:
    """Measured variance along the track over what the stated sigma gives, the middle one of all known windows."""
    stated_m2 = np.cumsum(steps.sigma_m**2) / np.arange(1, len(steps) + 1)
    shares = _largest_movement_ratios(50.0)[:, None]
    ratios = np.sort(measured_m2 / (stated_m2 * shares), axis=0)
    known = np.isfinite(ratios).sum(axis=0)
    middle = ratios[np.maximum(known - 1, 0) // 2, np.arange(len(steps))]
    return np.where(known > 0, np.fmax(middle, 1.0), 1.0)


def _measured_movement_variance_m2(steps: PathSteps, window_s: float) -> Floats:
    """Variance of the same movement along the track against an independent odometer, from the steps before [m2].

    NaN until there are enough of them. Along the track needs no path, and has the same law.
    """
    known = np.isfinite(steps.along_m) & steps.counted
    if not known.any():
        return np.full(len(steps), np.nan)
    rows = np.arange(len(steps))
    late, early_end, early = _window_bounds(steps.end_s, window_s)
    period_s = steps.period_s
    counts = np.concatenate([[0], np.cumsum(known)])
    # Sum and number of a window's values: differences of running ones.
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, steps.along_m, 0.0))])
    late_count = counts[rows + 1] - counts[late]
    early_count = counts[early_end] - counts[early]
    with np.errstate(invalid="ignore", divide="ignore"):
        moved_m = (sums[rows + 1] - sums[late]) / late_count - (sums[early_end] - sums[early]) / early_count
    least = _WHOLE * window_s / period_s
    whole = (late_count >= least) & (early_count >= least)
    moved_m = np.where(whole, moved_m, 0.0)
    number = np.cumsum(whole)
    mean_m = np.cumsum(moved_m) / np.maximum(number, 1)
    # Var(x) = E[x^2] - E[x]^2, of all windows up to each step.
    variance_m2 = np.cumsum(moved_m**2) / np.maximum(number, 1) - mean_m**2
    enough = number >= _MEASURED_WINDOWS * window_s / period_s
    return np.where(enough, np.maximum(variance_m2, 0.0), np.nan)
