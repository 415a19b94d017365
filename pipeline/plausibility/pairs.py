"""Scale and lag of one counter against positions: robust against jumps, drifts, slips and stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.plausibility.clocks import APART_S, LEAST_SHARE, possible_lags
from pipeline.plausibility.course import Course, Places
from pipeline.plausibility.robust import LEAST, MOVES_MPS, Regression, explains, regressed, steady, usual
from schemas.arrays import Bools, Floats

# A window is some 150 m long: positions that scatter by 2 m tell its way to 2 %.
_WINDOW_M = 150.0
_WINDOW_S = (8.0, 60.0)
# Slower than this share of the usual speed a window tells more of noise than of the scale.
_SLOW_SHARE = 0.2
# A window agrees if its ratio is within so much of the usual one.
_AGREES = 0.12
# Nobody looks for another lag where speeds agree in so much of the run; a journey that repeats itself agrees nearly as
# well at another one.
SURELY, _RIVAL = 0.93, 0.05
# Steps in which a lag is improved; regressed it is as near, or the second of them where both halves agree, or faults
# of the counter have bent it [s].
_CLIMB_S, _NEAR_S = (8.0, 4.0, 2.0, 1.0), 2.0
# Windows overlap by half. Positions a step apart are known to no better than this [m].
_OVERLAP, _LEAST_SPREAD_M = 1.5, 0.05


@dataclass(frozen=True)
class PairFit:
    """How a counter fits positions.

    `factor`: counted units per metre, negative where the counter falls; `lag_s`: the counter's stamp of a moment minus
    the GNSS's; sigmas of both (inf: not told). `halves`: factor and lag of the first and the second half alone.
    `constant`: share of windows that agree on the factor, of all in which the positions move.
    `reason`: why the factor is not told.
    `shifted`: the lag is one of the clocks, found by the whole journey's speed; `clock_reason`: why that told nothing.
    """

    factor: float = float("nan")
    factor_sigma: float = float("inf")
    lag_s: float = 0.0
    lag_sigma_s: float = float("inf")
    halves: tuple[tuple[float, float], ...] = ()
    constant: float = 0.0
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
        """Whether the lag differs from `lag_s` by more than `least_s` and than its noise, in both halves of the run."""
        return self.lag_told and _beyond(
            self.lag_s - lag_s, [lag - lag_s for _, lag in self.halves], max(least_s, 5.0 * self.lag_sigma_s)
        )

    def other_factor(self, factor: float, least: float) -> bool:
        """Whether the factor differs from this one by a larger share than `least`, in both halves of the run."""
        apart, *halves = (abs(one) / abs(factor) - 1.0 for one in (self.factor, *(one for one, _ in self.halves)))
        return self.told and _beyond(apart, halves, max(least, 5.0 * self.factor_sigma / abs(self.factor)))


def _beyond(apart: float, halves: list[float], least: float) -> bool:
    """A drift or slip in one half is none."""
    return abs(apart) > least and steady(np.array([apart]), *(np.array([half]) for half in halves))


@dataclass(frozen=True)
class _Windows:
    """Ways of both [m], [units], the counter's change of speed [units/s] from begin to end, and its signed way."""

    gnss_m: Floats
    size: Floats
    change: Floats
    counted: Floats

    def take(self, rows: Bools) -> _Windows:
        return _Windows(self.gnss_m[rows], self.size[rows], self.change[rows], self.counted[rows])

    def regressed(self) -> Regression:
        """Metres per unit, and its slope over the change of speed.

        GNSS way = a counted + b change, for the counter is the less noisy one; a lag of the counter's stamps by
        `d` beyond the assumed one is b = a d.
        """
        ratio = self.size / self.gnss_m
        unit = float(np.median(ratio))
        # A counter that is reset seems to run so far that it would weigh more than all the rest.
        sane = np.abs(np.log(ratio / unit)) < np.log(2.0)
        design = np.column_stack([self.size, self.change])[sane, None, :] / unit
        fit = regressed(design, self.gnss_m[sane, None], _LEAST_SPREAD_M, start=(1.0, 0.0))
        halves = tuple(half / unit for half in fit.halves)
        return replace(fit, estimate=fit.estimate / unit, sigma=fit.sigma / unit, halves=halves)


def fit_pair(gnss: Places, counter: Course) -> PairFit:
    """Scale and lag of a counter against positions; first the clocks, then both at once."""
    coarse_s, clock_reason = _clock_lag(gnss, counter)
    found = _fitted(gnss, counter, coarse_s)
    if found.lag_told and abs(found.lag_s - coarse_s) <= _CLIMB_S[1]:
        found = _fitted(gnss, counter, found.lag_s)
    agreed = found.lag_told and all(abs(half_s - found.lag_s) < _CLIMB_S[-1] for _, half_s in found.halves)
    if coarse_s and abs(found.lag_s - coarse_s) > (_CLIMB_S[1] if agreed else _NEAR_S):
        found = replace(found, lag_s=coarse_s, lag_sigma_s=_CLIMB_S[-1])
    return replace(found, shifted=coarse_s != 0.0, clock_reason=clock_reason)


def _clock_lag(gnss: Places, counter: Course) -> tuple[float, str]:
    """The lag of the clocks that makes the speeds agree, 0 where they do as recorded; and why none is told.

    A fault of one of both leaves part of the journey that agrees, and with it the right lag ahead of all others.
    """
    as_recorded = _agreement(gnss, counter, 0.0, 0.0)
    if as_recorded >= SURELY:
        return 0.0, ""
    possible_s, reason = possible_lags(gnss, counter)
    if reason:
        return 0.0, reason
    rated = _rated(gnss, counter, possible_s)
    if not rated or not explains(rated[0][0], as_recorded):
        return 0.0, "" if explains(as_recorded, 0.0) else "no shift of the clocks makes the speeds agree"
    if len(rated) > 1 and rated[0][0] - rated[1][0] < _RIVAL:
        return 0.0, "several shifts of the clocks make the speeds agree"
    return rated[0][1], ""


def _rated(gnss: Places, counter: Course, possible_s: list[float]) -> list[tuple[float, float]]:
    """Agreement and lag of the best shifts away from 0, best first; a stuck counter moves a correlation by seconds."""
    found: list[tuple[float, float]] = []
    for first_s in possible_s:
        best = _agreement(gnss, counter, first_s, LEAST_SHARE), first_s
        for step_s in _CLIMB_S:
            near = [best[1] - step_s, best[1] + step_s]
            best = max(best, *((_agreement(gnss, counter, lag_s, LEAST_SHARE), lag_s) for lag_s in near))
        found.append(best)
    found.sort(reverse=True)
    apart = found[:1] + [one for one in found[1:] if abs(one[1] - found[0][1]) > APART_S]
    return [one for one in apart if abs(one[1]) > _NEAR_S]


def _agreement(gnss: Places, counter: Course, lag_s: float, least_overlap: float) -> float:
    """Share of the moving time in which both speeds agree at this lag, times what of the shorter record they have in
    common then: a shift that cuts a fault off explains nothing. 0 where that is too little.
    """
    begin_s = max(gnss.t_s[0], counter.t_s[0] - lag_s)
    end_s = min(gnss.t_s[-1], counter.t_s[-1] - lag_s)
    shorter_s = min(gnss.t_s[-1] - gnss.t_s[0], counter.t_s[-1] - counter.t_s[0])
    if end_s - begin_s < max(least_overlap * shorter_s, 20.0):
        return 0.0
    grid = np.linspace(begin_s, end_s, int(np.clip(end_s - begin_s, 20, 800)))
    one, other = gnss.speed(grid), np.abs(counter.speed(grid + lag_s))
    known = np.isfinite(one) & np.isfinite(other)
    one, other = one[known], other[known]
    bounds = _SLOW_SHARE * usual(one, 0.9), _SLOW_SHARE * usual(other, 0.9)
    both = (one > bounds[0]) & (other > bounds[1])
    if both.sum() < LEAST:
        return 0.0
    fast, factor = bounds[0] / _SLOW_SHARE, float(np.median(other[both] / one[both]))
    moves = (one > bounds[0]) | (other > bounds[1])
    share = float(np.mean(np.abs(other / factor - one)[moves] < (0.07 * one + 0.04 * fast)[moves]))
    return share * float(end_s - begin_s) / float(shorter_s)


def _fitted(gnss: Places, counter: Course, lag_s: float) -> PairFit:
    begin_s = max(gnss.t_s[0], counter.t_s[0] - lag_s)
    end_s = min(gnss.t_s[-1], counter.t_s[-1] - lag_s)
    if end_s - begin_s < 3.0 * _WINDOW_S[0]:
        return PairFit(reason="nothing in common")
    windows, counts = _windows(gnss, counter, begin_s, end_s, lag_s)
    stands = counts < 0.1
    if windows.gnss_m.size < LEAST:
        reason = "the odometer stands while the positions move" if stands else "hardly any movement in common"
        return PairFit(reason=reason, stands=stands)
    ratio = np.abs(windows.counted) / windows.gnss_m
    sign = -1.0 if np.median(windows.counted) < 0 else 1.0
    fit = windows.regressed()
    (scale, slope), sigma = fit.estimate.tolist(), (_OVERLAP * fit.sigma).tolist()
    return PairFit(
        factor=sign / scale,
        factor_sigma=sigma[0] / scale**2,
        lag_s=lag_s + slope / scale,
        lag_sigma_s=sigma[1] / scale,
        halves=tuple((sign / one, lag_s + change / one) for one, change in fit.halves),
        constant=counts * float(np.mean(np.abs(np.log(ratio / np.median(ratio))) < _AGREES)),
    )


def _windows(gnss: Places, counter: Course, begin_s: float, end_s: float, lag_s: float) -> tuple[_Windows, float]:
    """Windows in which both move, and their share of those in which the positions move."""
    speed = gnss.speed(np.linspace(begin_s, end_s, 400))
    fast = speed[np.nan_to_num(speed) > MOVES_MPS]
    if not fast.size:
        return _Windows(*(np.zeros(0),) * 4), 1.0
    length_s = float(np.clip(_WINDOW_M / np.median(fast), *_WINDOW_S))
    starts = np.arange(begin_s, end_s - length_s, length_s / 2)
    ends = starts + length_s
    way = gnss.way(starts, ends)
    counted = counter.gained(starts + lag_s, ends + lag_s)
    change = _speed(counter, ends + lag_s) - _speed(counter, starts + lag_s)
    known = np.isfinite(way) & np.isfinite(counted) & np.isfinite(change)
    size = np.abs(counted)
    moves = known & (way > _SLOW_SHARE * usual(way[known], 0.9)) & (way > MOVES_MPS * length_s)
    # Neither a counter that stands most of the time nor one that is reset tells what is usual.
    counts = moves & (size > _SLOW_SHARE * usual(size[moves], 0.8))
    share = float(counts.sum() / moves.sum()) if moves.any() else 1.0
    return _Windows(way, size, np.where(counted < 0, -change, change), counted).take(counts), share


def _speed(counter: Course, t_s: Floats) -> Floats:
    return counter.gained(t_s - 1.0, t_s + 1.0) / 2.0
