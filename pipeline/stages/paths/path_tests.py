"""Whether the residuals of a path across its track can be those of a train on it (DOMAIN section 2).

A residual is r = b + e + n: b the bias of the run, turning with the heading, e the survey, of any correlation, n the
receiver. Tested are movements over several windows, the offset, and the lasting offset, each against its own bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pipeline.stages.paths.path_steps import PathSteps
from schemas.arrays import Bools, Floats, Ints
from schemas.config import MatchingConfig

# Windows of the movements [s].
WINDOWS_S = (3.0, 6.0, 12.0, 24.0, 48.0, 96.0, 192.0)
# The nine tests share the level; looks of each in 600 s, of the lasting offset three.
_LOOKED_S = 600.0
_LASTING_LOOKS = 3.0
# A window counts with so many of its steps.
_WHOLE = 0.6
# Correlation times of the noise that are thought of, up to the slowest part of DIAG Table 1 [s].
_TAUS_S = np.array([10.0, 20.0, 50.0, 75.0, 100.0, 150.0, 200.0, 300.0, 400.0, 600.0, 1000.0, 2000.0])
# Part of the variance that lasts, and how fast the rest of it averages (DIAG Table 1 at 45 degrees).
_SLOW, _AVERAGED_S = 0.247, 400.0
# Windows up to so long are measured along the track, after so many.
_MEASURED_S, _MEASURED_WINDOWS = 48.0, 6.0


class Verdict(NamedTuple):
    """The first step at which a path is refuted (a large number: at none), and its least p-value."""

    rejected: int
    p: float


@dataclass(frozen=True)
class PathTests:
    """The tests at one level; `bias_m`: sigma of b; `merged_m`: by so much merged paths may differ.

    `measured_m2`: per window the variance of a movement along the track so far, NaN where it is not known yet.
    `excess`: by how much that is larger than the stated sigma has it, 1 at least: stated sigmas may be too small.
    `windows`: per window the steps at which those that end at a step begin (`_windows`).
    """

    alpha: float
    bias_m: float
    merged_m: float
    alone: int
    measured_m2: dict[float, Floats]
    windows: dict[float, tuple[Ints, Ints, Ints]]
    excess: Floats
    config: MatchingConfig

    @classmethod
    def of_run(cls, steps: PathSteps, alpha: float, bias_m: float, alone: int, config: MatchingConfig) -> PathTests:
        """Tests of the paths of a run; `alone`: before this step no other track was near, only offsets are tested."""
        measured = {window_s: _measured_m2(steps, window_s) for window_s in WINDOWS_S if window_s <= _MEASURED_S}
        windows = {window_s: _windows(steps.end_s, window_s) for window_s in WINDOWS_S}
        excess = _excess(steps, measured)
        return cls(alpha, bias_m, config.paths_alike_m, alone, measured, windows, excess, config)

    def offset_m(self, sigma_m: Floats, survey_m: Floats) -> Floats:
        """How far beside its track a single step may lie [m]."""
        limit = _size(self.alpha, _LOOKED_S / self.config.paths_level_s)
        return np.asarray(limit * np.sqrt(self.bias_m**2 + survey_m**2 + sigma_m**2))

    @property
    def longest_s(self) -> float:
        """As far back as a movement looks."""
        return 3.0 * WINDOWS_S[-1]

    def of(
        self, steps: PathSteps, residual_m: Floats, survey_m: Floats, heading_rad: Floats, begin: int, end: int
    ) -> Verdict:
        """Test the steps from `begin` on, before `end`, of a path with these residuals since its beginning."""
        counted = steps.counted[:end] & np.isfinite(residual_m[:end])
        sums = _Sums.of(steps, counted, residual_m[:end], survey_m[:end])
        at = np.arange(begin, end)
        refuted = np.zeros(at.size, dtype=np.bool_)
        p = 1.0
        for z, limit, looks in self._statistics(steps, sums, heading_rad[:end], at):
            refuted |= z > limit
            most = float(z.max(initial=0.0))
            p = min(p, 9.0 * looks * 2.0 * _tail(most))
        first = np.flatnonzero(refuted)
        return Verdict(int(at[first[0]]) if first.size else 2**62, p)

    def _statistics(
        self, steps: PathSteps, sums: _Sums, heading_rad: Floats, at: Ints
    ) -> list[tuple[Floats, float, float]]:
        """Per test its size in sigmas at each step (0 where it cannot be made), its limit, its looks."""
        found: list[tuple[Floats, float, float]] = []
        apart = at >= self.alone
        for window_s in WINDOWS_S if apart.any() else ():
            if window_s < 2.0 * steps.period_s:
                continue
            moved = self._movement(steps, sums, heading_rad, at, window_s)
            found.append((np.where(apart, moved, 0.0), *self._limit(_LOOKED_S / window_s)))
        found.append((self._offset(steps, sums, at), *self._limit(_LOOKED_S / self.config.paths_level_s)))
        if apart.any():
            lasting = np.where(apart, self._lasting(steps, sums, at), 0.0)
            found.append((lasting, *self._limit(_LASTING_LOOKS)))
        return found

    def _limit(self, looks: float) -> tuple[float, float]:
        return _size(self.alpha, looks), looks

    def _movement(self, steps: PathSteps, sums: _Sums, heading_rad: Floats, at: Ints, window_s: float) -> Floats:
        """Mean of the last window less that of the window before the last but one."""
        late, early_end, early = (begin[at] for begin in self.windows[window_s])
        whole = _WHOLE * window_s / steps.period_s
        usable = (sums.count(late, at + 1) >= whole) & (sums.count(early, early_end) >= whole)
        moved_m = sums.residual(late, at + 1) - sums.residual(early, early_end)
        survey_m2 = sums.survey(late, at + 1) ** 2 + sums.survey(early, early_end) ** 2
        sigma_m2 = 0.5 * (sums.sigma2(late, at + 1) + sums.sigma2(early, early_end))
        turned = heading_rad[at] - heading_rad[np.minimum(early_end, at)]
        swung_m2 = (self.bias_m * 2.0 * np.sin(0.5 * turned)) ** 2
        root_m = np.sqrt(np.maximum(survey_m2 + self._noise_m2(steps, sigma_m2, at, window_s) + swung_m2, 1e-12))
        spare_m = np.maximum(np.abs(moved_m) - 2.0 * self.merged_m, 0.0)
        return np.where(usable & np.isfinite(spare_m) & np.isfinite(root_m), spare_m / root_m, 0.0)

    def _noise_m2(self, steps: PathSteps, sigma_m2: Floats, at: Ints, window_s: float) -> Floats:
        """Variance of a movement by the receiver: by its sigma, and no less than an odometer shows along the track.

        What is not measured yet, or never, may be correlated for less.
        """
        long_m2 = sigma_m2 * _greatest_share(window_s, 50.0)
        if window_s > _MEASURED_S:
            return long_m2 * self.excess[at]
        seen_m2 = self.measured_m2[window_s][at]
        soonest_s = 20.0 if np.isfinite(steps.along_m).any() else 10.0
        short_m2 = sigma_m2 * _greatest_share(window_s, soonest_s)
        return np.where(np.isfinite(seen_m2), np.fmax(long_m2, self.config.paths_measured_factor * seen_m2), short_m2)

    def _offset(self, steps: PathSteps, sums: _Sums, at: Ints) -> Floats:
        late = np.searchsorted(steps.end_s, steps.end_s[at] - self.config.paths_level_s, side="right")
        late = np.minimum(late, at)
        usable = sums.count(late, at + 1) >= min(_WHOLE * self.config.paths_level_s / steps.period_s, 1.0)
        root_m = np.sqrt(self.bias_m**2 + sums.survey(late, at + 1) ** 2 + sums.sigma2(late, at + 1) * self.excess[at])
        mean_m = np.abs(sums.residual(late, at + 1))
        return np.where(usable & np.isfinite(mean_m) & (root_m > 0.0), mean_m / np.maximum(root_m, 1e-9), 0.0)

    def _lasting(self, steps: PathSteps, sums: _Sums, at: Ints) -> Floats:
        start = np.full(at.size, sums.first)
        usable = sums.count(start, at + 1) >= 10
        lasted_s = np.maximum(steps.end_s[at] - steps.end_s[start], 1e-9)
        share = _SLOW + (1.0 - _SLOW) * np.minimum(1.0, _AVERAGED_S / lasted_s)
        sigma_m2 = sums.sigma2(start, at + 1) * share * self.excess[at]
        root_m = np.sqrt(self.bias_m**2 + sums.survey(start, at + 1) ** 2 + sigma_m2)
        mean_m = np.abs(sums.residual(start, at + 1))
        return np.where(usable & np.isfinite(mean_m) & (root_m > 0.0), mean_m / np.maximum(root_m, 1e-9), 0.0)


@dataclass(frozen=True)
class _Sums:
    """Running sums over the steps that count, so that any window is a difference of two."""

    counts: Floats
    residuals: Floats
    surveys: Floats
    sigmas2: Floats
    first: int

    @classmethod
    def of(cls, steps: PathSteps, counted: Bools, residual_m: Floats, survey_m: Floats) -> _Sums:
        def summed(values: Floats) -> Floats:
            return np.concatenate([[0.0], np.cumsum(np.where(counted, np.nan_to_num(values), 0.0))])

        known = np.flatnonzero(np.isfinite(residual_m))
        return cls(
            summed(np.ones(counted.size)),
            summed(residual_m),
            summed(survey_m),
            summed(steps.sigma_m[: counted.size] ** 2),
            int(known[0]) if known.size else 0,
        )

    def count(self, begin: Ints, end: Ints) -> Floats:
        return np.asarray(self.counts[end] - self.counts[begin])

    def _mean(self, sums: Floats, begin: Ints, end: Ints) -> Floats:
        count = self.count(begin, end)
        return np.where(count > 0, (sums[end] - sums[begin]) / np.maximum(count, 1.0), np.nan)

    def residual(self, begin: Ints, end: Ints) -> Floats:
        return self._mean(self.residuals, begin, end)

    def survey(self, begin: Ints, end: Ints) -> Floats:
        return self._mean(self.surveys, begin, end)

    def sigma2(self, begin: Ints, end: Ints) -> Floats:
        return self._mean(self.sigmas2, begin, end)


def told_by_a_switch_m(survey_m: Floats, alpha: float, merged_m: float) -> Floats:
    """How far apart tracks have to be for a movement from one to the other to be seen, with exact positions [m]."""
    return np.asarray(_size(alpha, _LOOKED_S / WINDOWS_S[0]) * np.sqrt(2.0) * survey_m + 2.0 * merged_m)


def told_by_offset_m(survey_m: Floats, alpha: float, bias_m: float) -> Floats:
    """How far apart tracks have to be for a lasting offset to tell them apart, with exact positions [m]."""
    return np.asarray(_size(alpha, _LASTING_LOOKS) * np.hypot(bias_m, survey_m))


def _size(alpha: float, looks: float) -> float:
    """Limit of a test in sigmas: the level is shared by nine tests, each with so many looks."""
    from scipy.special import ndtri

    return float(-ndtri(alpha / (9.0 * looks * 2.0)))


def _tail(z: float) -> float:
    from scipy.special import ndtr

    return float(ndtr(-z))


_SHARES: dict[tuple[float, float], float] = {}


def _greatest_share(window_s: float, tau_s: float) -> float:
    """Variance of a movement over that of the noise, the greatest over Gauss-Markov noises of at least `tau_s`."""
    key = (window_s, tau_s)
    if key not in _SHARES:
        samples = max(4, min(int(window_s), 24))
        times = (np.arange(samples) + 0.5) * window_s / samples
        times = np.concatenate([times, times + 2.0 * window_s])
        weights = np.concatenate([np.full(samples, 1.0), np.full(samples, -1.0)]) / samples
        lags = np.abs(times[:, None] - times[None, :])
        shares = [float(weights @ np.exp(-lags / tau) @ weights) for tau in _TAUS_S if tau >= tau_s]
        _SHARES[key] = max(shares)
    return _SHARES[key]


def _windows(t_s: Floats, window_s: float) -> tuple[Ints, Ints, Ints]:
    """Of the last window the first step, of the window before the last but one the step after it, and its first."""
    late, early_end, early = (np.searchsorted(t_s, t_s - k * window_s, side="right") for k in (1.0, 2.0, 3.0))
    return late, early_end, early


def _excess(steps: PathSteps, measured_m2: dict[float, Floats]) -> Floats:
    """Variance along the track over what the stated sigma gives, of all windows that are known the middle one."""
    stated_m2 = np.cumsum(steps.sigma_m**2) / np.arange(1, len(steps) + 1)
    ratios = np.sort(
        [seen / (stated_m2 * _greatest_share(window, 50.0)) for window, seen in measured_m2.items()], axis=0
    )
    known = np.isfinite(ratios).sum(axis=0)
    middle = ratios[np.maximum(known - 1, 0) // 2, np.arange(len(steps))]
    return np.where(known > 0, np.fmax(middle, 1.0), 1.0)


def _measured_m2(steps: PathSteps, window_s: float) -> Floats:
    """Variance of the same movement along the track against an independent odometer, from the steps before [m2].

    NaN until there are enough of them. Along the track needs no path, and has the same law.
    """
    known = np.isfinite(steps.along_m) & steps.counted
    if not known.any():
        return np.full(len(steps), np.nan)
    rows = np.arange(len(steps))
    late, early_end, early = _windows(steps.end_s, window_s)
    counts = np.concatenate([[0], np.cumsum(known)])
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, steps.along_m, 0.0))])
    late_count = counts[rows + 1] - counts[late]
    early_count = counts[early_end] - counts[early]
    with np.errstate(invalid="ignore", divide="ignore"):
        moved_m = (sums[rows + 1] - sums[late]) / late_count - (sums[early_end] - sums[early]) / early_count
    least = _WHOLE * window_s / steps.period_s
    whole = (late_count >= least) & (early_count >= least)
    moved_m = np.where(whole, moved_m, 0.0)
    number = np.cumsum(whole)
    mean_m = np.cumsum(moved_m) / np.maximum(number, 1)
    variance_m2 = np.cumsum(moved_m**2) / np.maximum(number, 1) - mean_m**2
    enough = number >= _MEASURED_WINDOWS * window_s / steps.period_s
    return np.where(enough, np.maximum(variance_m2, 0.0), np.nan)
