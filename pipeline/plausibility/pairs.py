"""Scale and lag of one counter against positions: robust against jumps, drifts, slips and stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.plausibility.clocks import Candidates, possible_lags
from pipeline.plausibility.course import Course, Places
from schemas.arrays import Bools, Floats

# A window is some 150 m long: positions that scatter by 2 m tell its way to 2 %.
_WINDOW_M = 150.0
_WINDOW_S = (8.0, 60.0)
_LEAST_WINDOWS = 6
# Slower than this share of the usual speed a window tells more of noise than of the scale.
_SLOW_SHARE = 0.2
# Of a stand, positions seem to move so fast [m/s].
_STANDS_MPS = 0.25
# A window agrees if its ratio is within so much of the usual one.
_AGREES = 0.12
# Speeds agree at a lag in so much of the moving time; another lag has to do it in so much more, and leave so much less
# of the rest. Both records have so much of the shorter one in common.
_ALIKE, _MORE, _LESS, _LEAST_OVERLAP = 0.5, 0.08, 0.6, 0.6
# A journey that repeats itself agrees nearly as well at another lag.
_RIVAL = 0.05
# Nobody looks for another lag where they agree in so much of it.
_SURELY = 0.93
# Steps in which a lag is improved, lags that are the same, and those that are none [s].
_CLIMB_S, _SAME_S, _ZERO_S = (8.0, 4.0, 2.0, 1.0), 25.0, 1.5
# Tukey's biweight, 95 % efficient on Gaussian noise (Huber and Ronchetti 2009); windows overlap by half.
_BIWEIGHT, _OVERLAP = 4.685, 1.5
_ROUNDS = 8
# Positions a step apart are known to no better than this [m].
_LEAST_SPREAD_M = 0.05


@dataclass(frozen=True)
class PairFit:
    """How a counter fits positions.

    `factor`: counted units per metre, negative where the counter falls; `lag_s`: the counter's stamp of a moment minus
    the GNSS's; sigmas of both (inf: not told). `halves`: factor and lag of the first and the second half alone.
    `constant`: share of windows that agree on the factor. `reason`: why the factor is not told.
    `shifted`: the lag is one of the clocks, found by the whole journey's speed; `clock_reason`: why that told nothing.
    """

    factor: float = float("nan")
    factor_sigma: float = float("inf")
    lag_s: float = 0.0
    lag_sigma_s: float = float("inf")
    halves: tuple[tuple[float, float], ...] = ()
    constant: float = 0.0
    windows: int = 0
    reason: str = ""
    stands: bool = False
    shifted: bool = False
    clock_reason: str = ""

    @property
    def told(self) -> bool:
        return not self.reason

    @property
    def lag_told(self) -> bool:
        return self.told and self.lag_sigma_s < 0.5

    def other_lag(self, lag_s: float, least_s: float) -> bool:
        """Whether the lag differs from `lag_s` by more than `least_s` and than its noise, in both halves of the run.

        A drift or slip in one half is no lag.
        """
        apart = [one - lag_s for one in (self.lag_s, *(lag for _, lag in self.halves))]
        beyond = abs(apart[0]) > max(least_s, 5.0 * self.lag_sigma_s)
        return self.lag_told and beyond and all(one * apart[0] > 0.5 * apart[0] ** 2 for one in apart)

    def other_factor(self, factor: float, least: float) -> bool:
        """Whether the factor differs from this one by a larger share than `least`, in both halves of the run."""
        apart = [abs(one) / abs(factor) - 1.0 for one in (self.factor, *(one for one, _ in self.halves))]
        beyond = abs(apart[0]) > max(least, 5.0 * self.factor_sigma / abs(self.factor))
        return self.told and beyond and all(one * apart[0] > 0.5 * apart[0] ** 2 for one in apart)


@dataclass(frozen=True)
class _Windows:
    """Ways of both [m], [units], and the counter's change of speed [units/s] from begin to end of each window."""

    gnss_m: Floats
    counted: Floats
    change: Floats

    def take(self, rows: Bools) -> _Windows:
        return _Windows(self.gnss_m[rows], self.counted[rows], self.change[rows])


def fit_pair(gnss: Places, counter: Course) -> PairFit:
    """Scale and lag of a counter against positions; first the clocks, then both at once."""
    spans = [(float(one.t_s[0]), float(one.t_s[-1])) for one in (gnss, counter)]
    possible = possible_lags(spans[0], gnss.speed, spans[1], counter.speed)
    coarse_s, clock_reason = _clock_lag(gnss, counter, possible)
    lag_s, found = coarse_s, PairFit()
    for _ in range(2):
        found = _fitted(gnss, counter, lag_s)
        if not found.lag_told or abs(found.lag_s - coarse_s) > 5.0:
            break
        lag_s = found.lag_s
    if coarse_s and abs(found.lag_s - coarse_s) > 5.0:
        found = replace(found, lag_s=coarse_s)
    return replace(found, shifted=coarse_s != 0.0, clock_reason=clock_reason)


def _clock_lag(gnss: Places, counter: Course, possible: Candidates) -> tuple[float, str]:
    """The lag of the clocks that makes the speeds agree, 0 where they do as recorded; and why none is told.

    A fault of one of both leaves part of the journey that agrees, and with it the right lag ahead of all others.
    """
    if possible.reason:
        return 0.0, possible.reason
    as_recorded = _agreement(gnss, counter, 0.0, 0.0)
    if as_recorded >= _SURELY:
        return 0.0, ""
    rated = _rated(gnss, counter, possible)
    if not rated or not _beats(rated[0][0], as_recorded):
        alike = as_recorded >= _ALIKE
        return 0.0, "" if alike else "no shift of the clocks makes the speeds agree"
    if len(rated) > 1 and rated[0][0] - rated[1][0] < _RIVAL:
        return 0.0, "several shifts of the clocks make the speeds agree"
    return rated[0][1], ""


def _rated(gnss: Places, counter: Course, possible: Candidates) -> list[tuple[float, float]]:
    """Agreement and lag of the best shifts away from 0, best first; a stuck counter moves a correlation by seconds."""
    found: list[tuple[float, float]] = []
    for first_s in possible.lags_s:
        best = _agreement(gnss, counter, first_s, _LEAST_OVERLAP), first_s
        for step_s in _CLIMB_S:
            near = [best[1] - step_s, best[1] + step_s]
            best = max(best, *((_agreement(gnss, counter, lag_s, _LEAST_OVERLAP), lag_s) for lag_s in near))
        found.append(best)
    found.sort(reverse=True)
    apart = found[:1] + [one for one in found[1:] if abs(one[1] - found[0][1]) > _SAME_S]
    return [one for one in apart if abs(one[1]) > _ZERO_S]


def _beats(share: float, other: float) -> bool:
    return share >= _ALIKE and share - other >= _MORE and 1.0 - share <= _LESS * (1.0 - other)


def _agreement(gnss: Places, counter: Course, lag_s: float, least_overlap: float) -> float:
    """Share of the moving time in which both speeds agree at this lag; 0 where they have too little in common."""
    begin_s = max(gnss.t_s[0], counter.t_s[0] - lag_s)
    end_s = min(gnss.t_s[-1], counter.t_s[-1] - lag_s)
    shorter_s = min(gnss.t_s[-1] - gnss.t_s[0], counter.t_s[-1] - counter.t_s[0])
    if end_s - begin_s < max(least_overlap * shorter_s, 20.0):
        return 0.0
    grid = np.linspace(begin_s, end_s, int(np.clip(end_s - begin_s, 20, 800)))
    one, other = gnss.speed(grid), np.abs(counter.speed(grid + lag_s))
    known = np.isfinite(one) & np.isfinite(other)
    one, other = one[known], other[known]
    bounds = _SLOW_SHARE * _usual(one), _SLOW_SHARE * _usual(other)
    both = (one > bounds[0]) & (other > bounds[1])
    if both.sum() < _LEAST_WINDOWS:
        return 0.0
    usual, factor = bounds[0] / _SLOW_SHARE, float(np.median(other[both] / one[both]))
    moves = (one > bounds[0]) | (other > bounds[1])
    return float(np.mean(np.abs(other / factor - one)[moves] < (0.07 * one + 0.04 * usual)[moves]))


def _fitted(gnss: Places, counter: Course, lag_s: float) -> PairFit:
    begin_s = max(gnss.t_s[0], counter.t_s[0] - lag_s)
    end_s = min(gnss.t_s[-1], counter.t_s[-1] - lag_s)
    if end_s - begin_s < 3.0 * _WINDOW_S[0]:
        return PairFit(reason="nothing in common")
    windows, stands = _windows(gnss, counter, begin_s, end_s, lag_s)
    if windows.gnss_m.size < _LEAST_WINDOWS:
        reason = "the odometer stands while the positions move" if stands else "hardly any movement in common"
        return PairFit(reason=reason, stands=stands)
    ratio = np.abs(windows.counted) / windows.gnss_m
    usual = float(np.median(ratio))
    agrees = np.abs(np.log(ratio / usual)) < _AGREES
    sign = -1.0 if np.median(windows.counted) < 0 else 1.0
    scale, slope, sigmas = _regressed(windows, usual)
    return PairFit(
        factor=sign / scale,
        factor_sigma=sigmas[0] / scale**2,
        lag_s=lag_s + slope / scale,
        lag_sigma_s=sigmas[1] / scale,
        halves=_halves(windows, usual, sign, lag_s),
        constant=float(agrees.mean()),
        windows=ratio.size,
    )


def _halves(windows: _Windows, usual: float, sign: float, lag_s: float) -> tuple[tuple[float, float], ...]:
    """Factor and lag of each half that is long enough."""
    order = np.arange(windows.gnss_m.size)
    parts = [windows.take(order < order.size // 2), windows.take(order >= order.size // 2)]
    fitted = [_regressed(part, usual) for part in parts if part.gnss_m.size >= _LEAST_WINDOWS]
    return tuple((sign / scale, lag_s + slope / scale) for scale, slope, _ in fitted)


def _windows(gnss: Places, counter: Course, begin_s: float, end_s: float, lag_s: float) -> tuple[_Windows, bool]:
    """Windows in which both move; and whether the counter stands where the positions move."""
    grid = np.linspace(begin_s, end_s, int(np.clip((end_s - begin_s) / 10.0, 20, 400)))
    speed = gnss.way(grid[:-1], grid[:-1] + 10.0) / 10.0
    fast = speed[speed > _STANDS_MPS] if np.isfinite(speed).any() else speed[:0]
    if not fast.size:
        return _Windows(*(np.zeros(0),) * 3), False
    length_s = float(np.clip(_WINDOW_M / np.median(fast), *_WINDOW_S))
    starts = np.arange(begin_s, end_s - length_s, length_s / 2)
    ends = starts + length_s
    way = gnss.way(starts, ends)
    counted = counter.gained(starts + lag_s, ends + lag_s)
    change = _speed(counter, ends + lag_s) - _speed(counter, starts + lag_s)
    known = np.isfinite(way) & np.isfinite(counted) & np.isfinite(change)
    size = np.abs(counted)
    moves = known & (way > _SLOW_SHARE * _usual(way[known])) & (way > _STANDS_MPS * length_s)
    stands = bool(moves.any() and np.mean(size[moves] == 0.0) > 0.9)
    moves &= size > _SLOW_SHARE * _usual(size[known])
    change = np.where(counted < 0, -change, change)
    return _Windows(way, counted, change).take(moves), stands


def _usual(values: Floats) -> float:
    return float(np.quantile(values, 0.9)) if values.size else 0.0


def _speed(counter: Course, t_s: Floats) -> Floats:
    return counter.gained(t_s - 1.0, t_s + 1.0) / 2.0


def _regressed(windows: _Windows, usual: float) -> tuple[float, float, Floats]:
    """Metres per unit, its slope over the change of speed, and the sigmas of both.

    GNSS way = a counted + b change, for the counter is the less noisy one; a lag of the counter's stamps by
    `d` beyond the assumed one is b = a d.
    """
    design = np.column_stack([np.abs(windows.counted), windows.change])
    estimate = np.array([1.0 / usual, 0.0])
    weight = np.ones(windows.gnss_m.size)
    spread_m = 0.0
    for _ in range(_ROUNDS):
        left_m = windows.gnss_m - design @ estimate
        spread_m = max(1.4826 * float(np.median(np.abs(left_m))), _LEAST_SPREAD_M)
        weight = np.clip(1.0 - (left_m / (_BIWEIGHT * spread_m)) ** 2, 0.0, None) ** 2
        normal = design.T @ (design * weight[:, None])
        if np.linalg.cond(normal) > 1e14:
            return 1.0 / usual, 0.0, np.array([spread_m / np.sqrt((design[:, 0] ** 2).sum()), np.inf])
        estimate = np.linalg.solve(normal, design.T @ (weight * windows.gnss_m))
    sigmas = _OVERLAP * spread_m * np.sqrt(np.diag(np.linalg.inv(normal)))
    return float(estimate[0]), float(estimate[1]), sigmas
