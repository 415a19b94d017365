"""Scale and lag of one counter against positions: robust against jumps, drifts, slips and stands."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.plausibility.clocks import clock_lag, common
from pipeline.plausibility.records import Places, Record
from pipeline.plausibility.robust import LEAST, regressed, steady, usual
from schemas.arrays import Floats
from schemas.config import PlausibilityConfig

# Windows overlap by half, which makes sigmas larger by so much; positions a step apart are no better known [m].
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
