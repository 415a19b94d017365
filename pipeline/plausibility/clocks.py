"""By how much two clocks differ, from two records of one journey's speed, whatever their units."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.plausibility.records import Places, Record
from pipeline.plausibility.robust import LEAST, explains, usual
from schemas.arrays import Floats
from schemas.config import PlausibilityConfig

# Lags that are worth a closer look: so many, so far from each other [s], improved in these steps.
_CANDIDATES, _APART_S, _CLIMB_S = 4, 15.0, (8.0, 4.0, 2.0, 1.0)


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
