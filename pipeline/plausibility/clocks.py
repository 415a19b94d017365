"""By how much two clocks may differ, from two records of one journey's speed, whatever their units."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from schemas.arrays import Floats

# At most so many instants: a day of seconds is still quick, and a coarser grid finds hours as well.
_MOST = 30_000
# Less in common than this, and than this share of the shorter record, and any two journeys look alike.
_LEAST_S = 90.0
LEAST_SHARE = 0.6
# Shifts of the clocks that are worth a closer look: so many, so well correlated, so far from each other [s].
_CANDIDATES, _LEAST_CORRELATION, APART_S = 4, 0.4, 15.0
# Constant speed tells no lag: its scatter over its mean.
_LEAST_CHANGE = 0.08


@dataclass(frozen=True)
class Candidates:
    """Lags that two clocks may have [s]: the second record's stamp of a moment minus the first's, to `step_s`.

    Best correlated first. `reason`: why there are none.
    """

    lags_s: tuple[float, ...] = ()
    step_s: float = 1.0
    reason: str = ""


def possible_lags(
    one_s: tuple[float, float],
    one: Callable[[Floats], Floats],
    other_s: tuple[float, float],
    other: Callable[[Floats], Floats],
) -> Candidates:
    """Lags at which two records of speed look alike, each a function of its own time within its span [s]."""
    step_s = max(1.0, (one_s[1] - one_s[0]) / _MOST, (other_s[1] - other_s[0]) / _MOST)
    times = [_grid(begin, end, step_s) for begin, end in (one_s, other_s)]
    speeds = [_bounded(np.abs(one(times[0]))), _bounded(np.abs(other(times[1])))]
    if any(np.isfinite(speed).sum() * step_s < _LEAST_S for speed in speeds):
        return Candidates(step_s=step_s, reason=f"less than {_LEAST_S:.0f} s of movement are known")
    if any(np.nanstd(speed) < _LEAST_CHANGE * max(float(np.nanmean(speed)), 1e-9) for speed in speeds):
        return Candidates(step_s=step_s, reason="the speed hardly changes")
    rho = _correlations(speeds[0], speeds[1], _LEAST_S / step_s)
    lags_s = other_s[0] - one_s[0] + step_s * np.arange(times[1].size - 1.0, times[1].size - 1.0 - rho.size, -1.0)
    return Candidates(tuple(_peaks(lags_s, rho)), step_s)


def _grid(begin_s: float, end_s: float, step_s: float) -> Floats:
    return np.arange(begin_s, end_s + step_s / 2, step_s, dtype=np.float64)


def _peaks(lags_s: Floats, rho: Floats) -> Iterator[float]:
    """Lags of the highest correlations that are not beside a higher one."""
    left = rho.copy()
    for _ in range(_CANDIDATES):
        best = int(np.argmax(left))
        if left[best] < _LEAST_CORRELATION:
            return
        yield float(lags_s[best])
        left[np.abs(lags_s - lags_s[best]) < APART_S] = -2.0


def _bounded(speed: Floats) -> Floats:
    """Without speeds that only a jump of the position has."""
    known = speed[np.isfinite(speed)]
    if not known.size:
        return speed
    return np.where(speed > 1.5 * np.quantile(known, 0.95) + 1e-9, np.nan, speed)


def _correlations(one: Floats, other: Floats, least: float) -> Floats:
    """Correlation at every shift over what both know; -2 where that is too little or does not change.

    Element k pairs `one[i]` with `other[i - k + n - 1]`, n the length of `other` (Padfield 2012, masked FFT).
    """
    size = 1 << (one.size + other.size - 2).bit_length()
    masks = [np.isfinite(values).astype(np.float64) for values in (one, other)]
    filled = [np.nan_to_num(values / max(float(np.nanmean(values)), 1e-9) - 1.0) for values in (one, other)]
    spectra = [np.fft.rfft(array, size) for array in (masks[0], filled[0], filled[0] ** 2)]
    turned = [np.fft.rfft(array[::-1], size) for array in (masks[1], filled[1], filled[1] ** 2)]

    def sums(left: int, right: int) -> Floats:
        whole: Floats = np.fft.irfft(spectra[left] * turned[right], size)[: one.size + other.size - 1]
        return whole

    count = np.maximum(np.round(sums(0, 0)), 0.0)
    need = max(least, LEAST_SHARE * min(mask.sum() for mask in masks))
    many = np.maximum(count, 1.0)
    first, second = sums(1, 0), sums(0, 1)
    covariance = sums(1, 1) - first * second / many
    spread = (sums(2, 0) - first**2 / many) * (sums(0, 2) - second**2 / many)
    enough = spread > (_LEAST_CHANGE**2 * many) ** 2 * 0.25
    rho = covariance / np.sqrt(np.where(enough, spread, 1.0))
    zero = np.where(enough & (count >= least), rho, -2.0)
    result: Floats = np.where(count >= need, zero, -2.0)
    return result
