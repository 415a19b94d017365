"""Clock and scale of one counter against positions: robust against jumps, drifts, slips and stands.

First the clocks: at which lag two records of one journey's speed agree, whatever their units; then scale and the rest
of the lag, by the ways of windows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pipeline.studies.plausibility.records import Places, Record
from pipeline.studies.plausibility.robust import LEAST, explains, regressed, steady, usual
from schemas.arrays import Floats
from schemas.config import PlausibilityConfig

# Windows overlap by half, which makes sigmas larger by so much; positions a step apart are no better known [m].
_OVERLAP, _LEAST_SPREAD_M = 1.5, 0.05
# Lags that are worth a closer look: so many, so far from each other [s], improved in these steps.
_CANDIDATES, _APART_S, _CLIMB_S = 4, 15.0, (8.0, 4.0, 2.0, 1.0)


@dataclass(frozen=True)
class PairFit:
    """How a counter fits positions.

    `factor`: counted units per metre, negative where the counter falls; `lag_s`: the counter's stamp of a moment minus
    the GNSS's; sigmas of both (inf: not told). `halves`: factor and lag of the first and the second half alone.
    `constant`: share of windows that agree on the factor, of all in which the positions move.
    `reason`: why the factor is not told.
    `shifted`: the lag is one of the clocks, found by the whole journey's speed; `clock_reason`: why that told nothing.
    """

    config: PlausibilityConfig
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
        return self.told and self.lag_sigma_s < self.config.lag_sigma_s

    @property
    def near_one(self) -> bool:
        """Whether the counter counts metres, as far as any odometer may be off."""
        return abs(abs(self.factor) - 1.0) <= self.config.scale_limit

    def scale(self, unit: float = 1.0) -> float:
        """True distance over what is counted, in a unit of which `unit` make a metre."""
        return unit / abs(self.factor)

    def scale_sigma(self, unit: float = 1.0) -> float:
        return unit * self.factor_sigma / self.factor**2

    def other_lag(self, lag_s: float, least_s: float) -> bool:
        """Whether the lag differs from `lag_s` by more than `least_s` and than its noise, in both halves of the run."""
        apart = np.array([self.lag_s, *(lag for _, lag in self.halves)]) - lag_s
        return self.lag_told and _beyond(apart, max(least_s, self.config.told_sigmas * self.lag_sigma_s))

    def other_factor(self, factor: float, least: float) -> bool:
        """Whether the factor differs from this one by a larger share than `least`, in both halves of the run."""
        apart = np.abs([self.factor, *(one for one, _ in self.halves)]) / abs(factor) - 1.0
        return self.told and _beyond(apart, max(least, self.config.told_sigmas * self.factor_sigma / abs(self.factor)))


def _beyond(apart: Floats, least: float) -> bool:
    """Whole run first, then its halves; a drift or slip in one half is none."""
    return abs(apart[0]) > least and steady(*apart[:, None])


def fit_pair(gnss: Places, counter: Record) -> PairFit:
    """Scale and lag of a counter against positions; first the clocks, then both at once."""
    coarse_s, clock_reason = clock_lag(gnss, counter)
    found = _fitted(gnss, counter, coarse_s)
    near_s = gnss.config.speed_lag_s
    if found.lag_told and abs(found.lag_s - coarse_s) <= 2.0 * near_s:
        found = _fitted(gnss, counter, found.lag_s)
    # Regressed, a lag is twice as near where both halves agree on it, or faults of the counter have bent it.
    agreed = found.lag_told and all(abs(half_s - found.lag_s) < near_s / 2.0 for _, half_s in found.halves)
    if coarse_s and abs(found.lag_s - coarse_s) > (2.0 if agreed else 1.0) * near_s:
        found = replace(found, lag_s=coarse_s, lag_sigma_s=near_s / 2.0)
    return replace(found, shifted=coarse_s != 0.0, clock_reason=clock_reason)


def _fitted(gnss: Places, counter: Record, lag_s: float) -> PairFit:
    """Metres per unit, and its slope over the change of speed from begin to end of a window.

    GNSS way = a counted + b change, for the counter is the less noisy one; a lag of the counter's stamps by `d` beyond
    the assumed one is b = a d.
    """
    config, (begin_s, end_s) = gnss.config, common(gnss, counter, lag_s)
    if end_s - begin_s < 3.0 * config.window_least_s:
        return PairFit(config, reason="nothing in common")
    (way, counted, change), counts = _windows(gnss, counter, begin_s, end_s, lag_s)
    stands = counts < 0.1
    if way.size < LEAST:
        reason = "the odometer stands while the positions move" if stands else "hardly any movement in common"
        return PairFit(config, reason=reason, stands=stands)
    sign, size = -1.0 if np.median(counted) < 0 else 1.0, np.abs(counted)
    ratio = size / way
    unit = float(np.median(ratio))
    off = np.abs(np.log(ratio / unit))
    # A counter that is reset seems to run so far that it would weigh more than all the rest.
    sane = off < np.log(2.0)
    design = np.column_stack([size, np.sign(counted) * change])[sane, None, :] / unit
    fit = regressed(design, way[sane, None], _LEAST_SPREAD_M, start=(1.0, 0.0))
    (scale, slope), sigma = (fit.estimate / unit).tolist(), (_OVERLAP * fit.sigma / unit).tolist()
    return PairFit(
        config,
        factor=sign / scale,
        factor_sigma=sigma[0] / scale**2,
        lag_s=lag_s + slope / scale,
        lag_sigma_s=sigma[1] / scale,
        halves=tuple((sign * unit / one, lag_s + lag / one) for one, lag in fit.halves),
        constant=counts * float(np.mean(off < config.window_agrees)),
    )


def _windows(gnss: Places, counter: Record, begin_s: float, end_s: float, lag_s: float) -> tuple[Floats, float]:
    """Of windows in which both move the GNSS way [m], and the counter's signed way and change of speed (3, windows);
    their share of those in which the positions move.
    """
    config, speed = gnss.config, gnss.speed(np.linspace(begin_s, end_s, 400))
    fast = speed[np.nan_to_num(speed) > config.moving_mps]
    if not fast.size:
        return np.zeros((3, 0)), 1.0
    length_s = float(np.clip(config.window_m / np.median(fast), config.window_least_s, config.window_most_s))
    starts = np.arange(begin_s, end_s - length_s, length_s / 2)
    ends = starts + length_s
    change = counter.speed(ends + lag_s, 2.0) - counter.speed(starts + lag_s, 2.0)
    found = np.stack([gnss.way(starts, ends), counter.gained(starts + lag_s, ends + lag_s), change])
    found = found[:, np.isfinite(found).all(axis=0)]
    found = found[:, found[0] > max(config.slow_share * usual(found[0], 0.9), config.moving_mps * length_s)]
    # Neither a counter that stands most of the time nor one that is reset tells what is usual.
    size = np.abs(found[1])
    counts = size > config.slow_share * usual(size, 0.8)
    return found[:, counts], float(counts.mean()) if counts.size else 1.0


def clock_lag(gnss: Places, counter: Record) -> tuple[float, str]:
    """The lag of the clocks that makes the speeds agree, 0 where they do as recorded; and why none is told.

    A lag is the counter's stamp of a moment minus the GNSS's. A fault of one of both leaves part of the journey that
    agrees, and with it the right lag ahead of all others.
    """
    config = gnss.config
    as_recorded = _agreement(gnss, counter, 0.0, 0.0)
    if as_recorded >= config.speeds_agree:
        return 0.0, ""
    possible_s, reason = _possible_lags(gnss, counter)
    if reason:
        return 0.0, reason
    rated = _rated(gnss, counter, possible_s)
    if not rated or not explains(rated[0][0], as_recorded):
        return 0.0, "" if explains(as_recorded, 0.0) else "no shift of the clocks makes the speeds agree"
    if len(rated) > 1 and rated[0][0] - rated[1][0] < config.lag_rival:
        return 0.0, "several shifts of the clocks make the speeds agree"
    return rated[0][1], ""


def _possible_lags(gnss: Places, counter: Record) -> tuple[list[float], str]:
    """Lags at which both speeds look alike, to a second, best correlated first; and why there are none."""
    config = gnss.config
    times = [np.arange(one.t_s[0], one.t_s[-1] + 0.5, 1.0) for one in (gnss, counter)]
    speeds = [np.abs(one.speed(t_s)) for one, t_s in zip((gnss, counter), times, strict=True)]
    # Without speeds that only a jump of the position has.
    speeds = [np.where(speed > 1.5 * usual(speed, 0.95) + 1e-9, np.nan, speed) for speed in speeds]
    if any(np.isfinite(speed).sum() < config.overlap_s for speed in speeds):
        return [], f"less than {config.overlap_s:.0f} s of movement are known"
    if any(np.nanstd(speed) < config.speed_change * max(float(np.nanmean(speed)), 1e-9) for speed in speeds):
        return [], "the speed hardly changes"
    rho = _correlations(speeds[0], speeds[1], config)
    lags_s = times[1][0] - times[0][0] + times[1].size - 1.0 - np.arange(rho.size)
    return list(_peaks(lags_s, rho)), ""


def _peaks(lags_s: Floats, rho: Floats) -> Iterator[float]:
    """Lags of the highest correlations that are not beside a higher one."""
    left = rho.copy()
    for _ in range(_CANDIDATES):
        best = int(np.argmax(left))
        if left[best] > 0.0:
            yield float(lags_s[best])
        left[np.abs(lags_s - lags_s[best]) < _APART_S] = 0.0


def _correlations(one: Floats, other: Floats, config: PlausibilityConfig) -> Floats:
    """Correlation at every shift over what both know; 0 where that is too little.

    Element k pairs `one[i]` with `other[i - k + n - 1]`, n the length of `other` (Padfield 2012, masked FFT).
    """
    size = 1 << (one.size + other.size - 2).bit_length()

    def spectra(values: Floats) -> list[np.ndarray]:
        """Of what is known, of how it differs from the mean, and of the square of that."""
        apart = np.nan_to_num(values / max(float(np.nanmean(values)), 1e-9) - 1.0)
        return [np.fft.rfft(part, size) for part in (np.isfinite(values).astype(np.float64), apart, apart**2)]

    first, second = spectra(one), spectra(other[::-1])

    def sums(left: int, right: int) -> Floats:
        return np.asarray(np.fft.irfft(first[left] * second[right], size)[: one.size + other.size - 1])

    least = max(config.overlap_s, config.overlap_share * min(np.isfinite(values).sum() for values in (one, other)))
    spread = sums(2, 0) * sums(0, 2)
    told = (np.round(sums(0, 0)) >= least) & (spread > config.speed_change**4)
    return np.where(told, sums(1, 1) / np.sqrt(np.where(told, spread, 1.0)), 0.0)


def _rated(gnss: Places, counter: Record, possible_s: list[float]) -> list[tuple[float, float]]:
    """Agreement and lag of the best shifts away from 0, best first; a stuck counter moves a correlation by seconds."""

    def rated(lag_s: float) -> tuple[float, float]:
        return _agreement(gnss, counter, lag_s, gnss.config.overlap_share), lag_s

    found: list[tuple[float, float]] = []
    for lag_s in possible_s:
        best = rated(lag_s)
        for step_s in _CLIMB_S:
            best = max(best, rated(best[1] - step_s), rated(best[1] + step_s))
        found.append(best)
    found.sort(reverse=True)
    apart = found[:1] + [one for one in found[1:] if abs(one[1] - found[0][1]) > _APART_S]
    return [one for one in apart if abs(one[1]) > gnss.config.speed_lag_s]


def common(gnss: Places, counter: Record, lag_s: float) -> tuple[float, float]:
    """Begin and end of what both records have in common at this lag, by the stamps of the GNSS [s]."""
    return max(gnss.t_s[0], counter.t_s[0] - lag_s), min(gnss.t_s[-1], counter.t_s[-1] - lag_s)


def _agreement(gnss: Places, counter: Record, lag_s: float, least_overlap: float) -> float:
    """Share of the moving time in which both speeds agree at this lag, times what of the shorter record they have in
    common then: a shift that cuts a fault off explains nothing. 0 where that is too little.
    """
    config, (begin_s, end_s) = gnss.config, common(gnss, counter, lag_s)
    shorter_s = min(np.ptp(gnss.t_s), np.ptp(counter.t_s))
    if end_s - begin_s < max(least_overlap * shorter_s, 20.0):
        return 0.0
    grid = np.linspace(begin_s, end_s, int(np.clip(end_s - begin_s, 20, 800)))
    speeds = np.stack([gnss.speed(grid), np.abs(counter.speed(grid + lag_s))])
    one, other = speeds[:, np.isfinite(speeds).all(axis=0)]
    moves = [speed > config.slow_share * usual(speed, 0.9) for speed in (one, other)]
    both, either = moves[0] & moves[1], moves[0] | moves[1]
    if both.sum() < LEAST:
        return 0.0
    factor = float(np.median(other[both] / one[both]))
    apart, bound = np.abs(other / factor - one), config.speed_alike_share * one
    alike = apart < bound + config.speed_alike_usual * usual(one, 0.9)
    return float(np.mean(alike[either])) * float(end_s - begin_s) / float(shorter_s)
