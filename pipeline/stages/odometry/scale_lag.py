"""Scale and lag of a counter against another recorder of the same journey: the one estimator of both.

movement of the other = scale * movement counted - scale * lag * change of speed,

with movements and speeds counted at the stamps less an assumed lag, and `lag` what is left of it: linear in scale and
scale * lag. Evidence asks it for the clocks of reference and reads, the input checks for the odometer's against
positions, calibration for the vehicle file; the causal filter (`alignment.odometer_filter`) follows the same equation
from epoch to epoch. It knows neither where the movements come from nor what they are used for.

The lag is searched over +- 30 s by the mean absolute difference of movements, each time at the scale that fits best,
and refined from there by regression; then it is held against all lags far from it. No figure is given where another lag
does nearly as well, or where the changes of speed are noise.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from pipeline.stages.odometry.regression import (
    SHOWN,
    WORSE,
    LagState,
    Regression,
    ScaleLag,
    half_apart,
    has_enough_movements,
    huber_loss,
    least_absolute_scale,
    robust_sigma,
    solved_moments,
    student_factor,
    widened,
)
from schemas.arrays import Bools, Floats, Ints, median
from schemas.frozen import frozen

# Numerics: a lag shows where the speed changes, so movements over this time are compared, one every so often [s]; no
# longer ones where a recorder pauses.
MOVEMENT_S, MOVEMENT_EVERY_S = 10.0, 2.0
_LONGEST = 1.5
# Numerics: range and step of the search [s].
_FARTHEST_S, _STEP_S = 30.0, 0.5
_LAGS_S: Floats = np.linspace(-_FARTHEST_S, _FARTHEST_S, 2 * round(_FARTHEST_S / _STEP_S) + 1)
# Of the lags that few movements leave, where the noise is known.
_FINE_S = 0.1
_FINE_LAGS_S: Floats = np.linspace(-_FARTHEST_S, _FARTHEST_S, 2 * round(_FARTHEST_S / _FINE_S) + 1)
_ROUNDS = 20
_SCALES = 3
# A lag stays where it moves by less than this share of its sigma.
_STAYS = 0.05
# Least number of movements for a lag, and for one of more than a second; no more are looked at in the search.
FEWEST, _FEWEST_FAR = 6, 12
_NEAR_S = 1.0
# Two movements fit some scale and lag.
_FEWEST_TELLING = 2
_SEARCHED = 800
# A speed is taken over so much on both sides of an instant, and next to it from twice to four times that, so that the
# rows whose noise is in one are not in the other [s].
_SPEED_S = 0.5
# Numerics: rows farther apart are joined by curves [s].
_APART_S = 0.25
# Outliers, in robust standard deviations: slip, or a step of the other recorder.
_USUAL = 4.5
# Numerics: movements are not written finer than this [m].
_FINEST_M = 1e-3
# A lag so many sigmas, and so many seconds, from the one found is far.
_FAR_SIGMAS, _FAR_S = 15.0, 2.0


@frozen
class CounterRows:
    """Rows of a counter: times [s], distance [m], how many steps before each row are in doubt; sigma of a row [m]."""

    t_s: Floats
    distance_m: Floats
    doubtful: Floats
    row_sigma_m: float = 0.0

    def gained(self, begin_s: Floats, end_s: Floats) -> Floats:
        """Movement between instants [m]; NaN outside the recording and over a step in doubt."""
        moved_m = self._at(end_s, self.distance_m) - self._at(begin_s, self.distance_m)
        if self.doubtful[-1] == self.doubtful[0]:
            return moved_m
        return np.where(self._at(begin_s, self.doubtful) == self._at(end_s, self.doubtful), moved_m, np.nan)

    def _at(self, at_s: Floats, values: Floats) -> Floats:
        """A column of the rows interpolated at instants; NaN outside the recording."""
        return np.interp(at_s, self.t_s, values, np.nan, np.nan)

    @cached_property
    def _half_s(self) -> float:
        """Half of the time a speed is taken over [s]."""
        return max(_SPEED_S, median(np.diff(self.t_s)))

    def speeds(self, t_s: Floats) -> tuple[Floats, Floats]:
        """Speed about each instant, and by the rows next to these."""
        half_s = self._half_s
        ends = np.array([[-4.0, -1.0, 2.0], [-2.0, 1.0, 4.0]]) * half_s
        begin_s, end_s = t_s + ends.reshape(2, 3, *(1,) * t_s.ndim)
        before, near, after = self.gained(begin_s, end_s)
        return near / (2.0 * half_s), (before + after) / (4.0 * half_s)

    @cached_property
    def smooth(self) -> CounterRows:
        """Rows no farther apart than `_APART_S`, by cubics through the speeds at the rows.

        A straight line over a second is off by 15 cm at 1.2 m/s2: ahead of a train that starts, behind one that brakes.
        """
        step_s = np.diff(self.t_s)
        parts = int(np.ceil(median(step_s) / _APART_S - 1e-6))
        if parts <= 1 or self.t_s.size < 3:
            return self
        speed = np.gradient(self.distance_m, self.t_s)
        begin = np.repeat(np.arange(step_s.size), parts)
        u = np.tile(np.arange(parts) / parts, step_s.size)
        length_s, moved_m = step_s[begin], np.diff(self.distance_m)[begin]
        bent = (1.0 - u) * (speed[begin] * length_s - moved_m) - u * (speed[begin + 1] * length_s - moved_m)
        distance_m = self.distance_m[begin] + u * moved_m + u * (1.0 - u) * bent
        t_s = self.t_s[begin] + u * length_s
        doubtful = self.doubtful[begin] + u * np.diff(self.doubtful)[begin]
        return CounterRows(
            t_s=np.append(t_s, self.t_s[-1]),
            distance_m=np.append(distance_m, self.distance_m[-1]),
            doubtful=np.append(doubtful, self.doubtful[-1]),
            row_sigma_m=self.row_sigma_m,
        )

    @property
    def least_change_mps(self) -> float:
        """A change of speed, by four rows at each end over 4 half spans, is noise of the rows up to 3 of its sigmas."""
        return 3.0 * float(np.sqrt(8.0)) * self.row_sigma_m / (4.0 * self._half_s)

    @property
    def noise_m(self) -> float:
        """Sigma of a movement by the noise of its two rows."""
        return max(self.row_sigma_m * float(np.sqrt(2.0)), _FINEST_M)

    def driven(self) -> CounterRows:
        """Distance driven, to and fro."""
        return replace(self, distance_m=np.concatenate([[0.0], np.cumsum(np.abs(np.diff(self.distance_m)))]))


_Figure = TypeVar("_Figure", float, Floats)


def slopes(moved_m: _Figure, speed_mps: _Figure, scale: float = 1.0) -> tuple[_Figure, _Figure]:
    """Change of the other's movement with scale and with lag; with scale * lag at a `scale` of 1."""
    return moved_m, -scale * speed_mps


def spans_of_rows(t_s: Floats) -> tuple[Ints, Ints]:
    """Begin and end of movements of 10 s, one every 2 s, among the rows of a recorder; none over a pause."""
    rows = (
        np.unique(np.searchsorted(t_s, np.arange(t_s[0], t_s[-1], MOVEMENT_EVERY_S))) if t_s.size else np.zeros(0, int)
    )
    ends = np.searchsorted(t_s, t_s[rows] + MOVEMENT_S)
    inside = ends < t_s.size
    begin, end = rows[inside], ends[inside]
    whole = t_s[end] - t_s[begin] <= _LONGEST * MOVEMENT_S
    return begin[whole], end[whole]


def scale_and_lag(begin_s: Floats, end_s: Floats, moved_m: Floats, counter: CounterRows) -> ScaleLag:
    """Scale and lag of the recorder that saw the movements `moved_m` between its stamps.

    Args:
        begin_s: stamps at which the movements begin, in order of time [s], shape (n,); they may overlap.
        end_s: stamps at which they end [s], shape (n,).
        moved_m: signed movements by that recorder [m], shape (n,).
        counter: rows of the counter that they are compared with.

    Returns:
        Scale and lag with standard deviations, infinite where a figure is not measured.
    """
    if begin_s.size < FEWEST:
        return ScaleLag()
    pairs = _DistancePairs(begin_s, end_s, moved_m, counter.smooth)
    found = pairs.refined(pairs.likeliest_s)
    if pairs.count < FEWEST or (pairs.count < _FEWEST_FAR and abs(found.lag_s) > _NEAR_S):
        return pairs.without_lag(LagState.TOO_FEW)
    if not found.measured:
        return pairs.without_lag(found.state)
    return found if pairs.stands_out(found) else pairs.without_lag(LagState.AMBIGUOUS)


def possible_lags(
    movements: tuple[Floats, Floats, Floats], counter: CounterRows, sigma_m: Floats, scale_off: float, factor: float
) -> tuple[float, float] | None:
    """Least and largest lag [s] that the movements (begin, end [s], length [m]) do not refute; None if they tell
    nothing.

    A set of confidence at `factor` sigmas by the sum of squares, of movements with errors of `sigma_m` each or of what
    the best lag leaves, if that is more, with the scale within 1 +- `scale_off`. They tell nothing where movements
    without any error would not refute a lag at an end of the search: noise widens the set, and never makes it nothing.
    One or two movements that tell nothing are too few to show that it is the journey, at one speed, that hides a lag:
    any is possible.
    """
    begin_s, end_s, moved_m = movements
    if begin_s.size == 0:
        return None
    apart = slice(None, None, _DistancePairs(begin_s, end_s, moved_m, counter).step)
    begin_s, end_s, observed, sigma_m = begin_s[apart], end_s[apart], moved_m[apart] / sigma_m[apart], sigma_m[apart]
    counted = counter.smooth.gained(begin_s - _FINE_LAGS_S[:, None], end_s - _FINE_LAGS_S[:, None]) / sigma_m
    left = _left_over(counted, observed, scale_off)
    # A movement not counted at a lag does not refute it; where the best one is looked for it counts as one that fits.
    counts = np.isfinite(counted).sum(axis=1)
    likeliest = int((left + counts.max() - counts).argmin())
    exact = np.where(np.isfinite(counted[likeliest]), counted[likeliest], observed)
    if (_left_over(counted[[0, -1]], exact, scale_off) <= factor**2).any():
        return None if counts.max() > _FEWEST_TELLING else (-_FARTHEST_S, _FARTHEST_S)
    best = float(left[likeliest] + counts.max() - counts[likeliest])
    # Two movements fit some lag and scale whatever their noise is.
    free = max(float(counts[likeliest]) - 2.0, 0.0)
    noise = max(student_factor(free) ** 2 * float(left[likeliest]) / free, 1.0) if free else 1.0
    possible = left - best <= factor**2 * noise
    # One or two movements leave nothing over that would show that a slip was it, and no lag.
    possible[_FINE_LAGS_S.size // 2] |= free == 0.0
    lags_s = _FINE_LAGS_S[possible]
    return float(lags_s[0] - _FINE_S), float(lags_s[-1] + _FINE_S)


def _left_over(counted: Floats, observed: Floats, scale_off: float) -> Floats:
    """What the movements observed leave of those counted at each lag (rows), both in sigmas, at the scale that fits
    best.

    Sum of squares; of each no more than that of an outlier, a slip.
    """
    known = np.isfinite(counted) & np.isfinite(observed)
    counted, observed = np.where(known, counted, 0.0), np.where(known, observed, 0.0)
    limits = 1.0 - scale_off, 1.0 + scale_off
    scale = np.clip(least_absolute_scale(counted, observed), *limits)
    for _ in range(_SCALES):
        used = np.where(np.abs(observed - scale[:, None] * counted) <= _USUAL, counted, 0.0)
        squares = (used * counted).sum(axis=1)
        scale = np.where(
            squares > 0.0, np.clip((used * observed).sum(axis=1) / np.maximum(squares, 1e-9), *limits), scale
        )
    return np.asarray(np.minimum((observed - scale[:, None] * counted) ** 2, _USUAL**2).sum(axis=1))


@frozen
class _DistancePairs:
    """Movements that a recorder saw between its stamps, and the counter that counted them too."""

    begin_s: Floats
    end_s: Floats
    moved_m: Floats
    counter: CounterRows

    @property
    def count(self) -> float:
        """Number of movements that do not overlap."""
        return 1.0 + (self.begin_s.size - 1.0) / self.overlap_count

    @cached_property
    def overlap_count(self) -> int:
        """Median number of movements that begin before one of them ends, itself included; at least 1."""
        after = np.searchsorted(self.begin_s, self.end_s - 1e-6)
        return max(1, round(median(after - np.arange(after.size))))

    @property
    def step(self) -> int:
        """A search looks at every so many-th movement: these do not overlap."""
        return max(self.overlap_count, self.begin_s.size // _SEARCHED, 1)

    def _apart_m(self, lag_s: Floats) -> tuple[Floats, Floats]:
        """How far movements that do not overlap are apart at each lag (lags, movements), at the scale that makes their
        sum least; these scales.
        """
        some = slice(None, None, self.step)
        begin_s, end_s, moved_m = (values[some] for values in (self.begin_s, self.end_s, self.moved_m))
        counted = self.counter.gained(begin_s - lag_s[:, None], end_s - lag_s[:, None])
        scale = least_absolute_scale(counted, moved_m)
        return np.abs(moved_m - scale[:, None] * counted), scale

    @cached_property
    def _search(self) -> tuple[Floats, Floats]:
        """How far movements are apart at each lag tried [m], and the scale at each."""
        return self._apart_m(_LAGS_S)

    @cached_property
    def likeliest_s(self) -> float:
        """The lag that leaves the least mean difference, of those at which half of the movements are known."""
        apart, _ = self._search
        mean = np.nansum(apart, axis=1) / np.maximum(np.isfinite(apart).sum(axis=1), 1)
        return float(_LAGS_S[np.where(has_enough_movements(apart), mean, np.inf).argmin()])

    def _fits(self, lag_s: float) -> Bools:
        """Which lags of the search fit as well as this one: what they leave more is no more than chance.

        By Huber's loss. Under a lag that fits as well the sum of differences has at most twice the variance of the sum
        of losses. Where less than half of the movements are known at both it is not said to fit.
        """
        here, _ = self._apart_m(np.full(1, lag_s))
        limit_m = _USUAL * max(robust_sigma(here[here > 0.0]), self.counter.noise_m)
        loss, losses = (huber_loss(apart, limit_m) for apart in (here, self._search[0]))
        worse = losses - loss
        # An outlier is one at both lags: its losses differ by no more than by what noise does to it.
        chance = WORSE * np.sqrt(2.0 * np.nansum(np.minimum(loss, limit_m**2) ** 2))
        fits: Bools = has_enough_movements(worse) & (np.nansum(worse, axis=1) <= chance)
        return fits

    def stands_out(self, found: ScaleLag) -> bool:
        """No lag far from it fits as well; sigmas so large that none is far are none."""
        far: Bools = np.abs(_LAGS_S - found.lag_s) >= max(_FAR_S, _FAR_SIGMAS * found.lag_sigma_s)
        return bool(far.any() and not self._fits(found.lag_s)[far].any())

    def without_lag(self, state: LagState) -> ScaleLag:
        """The scale alone, as uncertain as it is over all lags that fit; not known where the movements are all
        noise.
        """
        found = self._regression(self.likeliest_s, _FARTHEST_S)
        if found is None:
            return ScaleLag(state=state)
        scale, sigma = found.with_sigmas(slice(1))
        halves = found.halves(0.0, slice(1))
        scales = self._search[1][self._fits(self.likeliest_s)]
        sigma = max(float(np.hypot(sigma, 0.5 * np.ptp(scales))) if scales.size else sigma, half_apart(halves))
        if abs(scale) <= SHOWN * sigma:
            return ScaleLag(state=state)
        return ScaleLag(scale, sigma, state=state, halves=halves)

    def refined(self, lag_s: float) -> ScaleLag:
        """The regression from here until it stays."""
        doubt_s = _STEP_S
        found = ScaleLag()
        for _ in range(_ROUNDS):
            regression = self._regression(lag_s, doubt_s)
            if regression is None:
                return ScaleLag()
            found = regression.solved(lag_s)
            moved_s = abs(found.lag_s - lag_s)
            if not found.measured or abs(found.lag_s) > _FARTHEST_S:
                return ScaleLag(state=LagState.CONSTANT_SPEED)
            lag_s = found.lag_s
            if moved_s <= _STAYS * found.lag_sigma_s and doubt_s <= found.lag_sigma_s:
                return found
            doubt_s = min(0.5 * doubt_s, 2.0 * moved_s + 0.5 * found.lag_sigma_s)
        return replace(found, lag_sigma_s=found.lag_sigma_s + moved_s)

    def _regression(self, lag_s: float, doubt_s: float) -> Regression | None:
        """The estimate at an assumed lag; `doubt_s`: by how much it may be off, which makes no outlier."""
        begin_s, end_s = self.begin_s - lag_s, self.end_s - lag_s
        counted = self.counter.gained(begin_s, end_s)
        (first, last), (first_instrument, last_instrument) = self.counter.speeds(np.stack([begin_s, end_s]))
        design = np.column_stack(slopes(counted, last - first))
        change_mps = last_instrument - first_instrument
        # The counts of a coarse counter at one speed have a rhythm, in speeds as in movements: no changes of speed.
        change_mps = np.where(np.abs(change_mps) <= self.counter.least_change_mps, 0.0, change_mps)
        instruments = np.column_stack(slopes(counted, change_mps))
        known = np.asarray(np.isfinite(np.column_stack([design, instruments])).all(axis=1))
        # Where both stand there is nothing to learn, nor of the noise.
        moving: Bools = known & (np.abs(counted) > 0.0)
        if moving.sum() < FEWEST:
            return None
        design, instruments = (np.where(known[:, None], values, 0.0) for values in (design, instruments))
        scale = float(least_absolute_scale(counted[None], self.moved_m)[0])
        theta = np.array([scale, 0.0])
        used = moving
        for _ in range(_ROUNDS):
            left = self.moved_m - design @ theta
            spread = max(robust_sigma(np.abs(left[moving])), abs(scale) * self.counter.noise_m)
            kept = moving & (np.abs(left) <= _USUAL * spread + doubt_s * np.abs(scale * design[:, 1]))
            if kept.sum() < FEWEST:
                return None
            solved = solved_moments(design[kept], instruments[kept], self.moved_m[kept])
            same = np.array_equal(kept, used) and bool(np.all(np.abs(solved - theta) <= 1e-9 + 1e-9 * np.abs(theta)))
            theta, used = solved, kept
            if same:
                break
        used = used & ~widened(moving & ~used, self.overlap_count // 2)
        if used.sum() < FEWEST:
            return None
        return Regression(design, instruments, self.moved_m, used, self.overlap_count)
