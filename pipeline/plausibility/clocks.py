"""By how much two clocks may differ, from two records of one journey's speed, whatever their units."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pipeline.plausibility.course import Course, Places
from schemas.arrays import Floats

# Less in common than this, and than this share of the shorter record, and any two journeys look alike.
_LEAST_S, LEAST_SHARE = 90.0, 0.6
# Shifts of the clocks that are worth a closer look: so many, so far from each other [s].
_CANDIDATES, APART_S = 4, 15.0
# Constant speed tells no lag: its scatter over its mean.
_LEAST_CHANGE = 0.08


def possible_lags(one: Places, other: Course) -> tuple[list[float], str]:
    """Lags at which two records of speed look alike, to a second, best correlated first; and why there are none.

    A lag is the second record's stamp of a moment minus the first's.
    """
    times = [np.arange(t_s[0], t_s[-1] + 0.5, 1.0) for t_s in (one.t_s, other.t_s)]
    speeds = _bounded(one.speed(times[0])), _bounded(np.abs(other.speed(times[1])))
    if any(np.isfinite(speed).sum() < _LEAST_S for speed in speeds):
        return [], f"less than {_LEAST_S:.0f} s of movement are known"
    if any(np.nanstd(speed) < _LEAST_CHANGE * max(float(np.nanmean(speed)), 1e-9) for speed in speeds):
        return [], "the speed hardly changes"
    rho = _correlations(*speeds)
    lags_s = times[1][0] - times[0][0] + times[1].size - 1.0 - np.arange(rho.size)
    return list(_peaks(lags_s, rho)), ""


def _peaks(lags_s: Floats, rho: Floats) -> Iterator[float]:
    """Lags of the highest correlations that are not beside a higher one."""
    left = rho.copy()
    for _ in range(_CANDIDATES):
        best = int(np.argmax(left))
        if left[best] <= 0.0:
            return
        yield float(lags_s[best])
        left[np.abs(lags_s - lags_s[best]) < APART_S] = 0.0


def _bounded(speed: Floats) -> Floats:
    """Without speeds that only a jump of the position has."""
    known = speed[np.isfinite(speed)]
    return np.where(speed > 1.5 * np.quantile(known, 0.95) + 1e-9, np.nan, speed) if known.size else speed


def _correlations(one: Floats, other: Floats) -> Floats:
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

    least = max(_LEAST_S, LEAST_SHARE * min(np.isfinite(values).sum() for values in (one, other)))
    spread = sums(2, 0) * sums(0, 2)
    told = (np.round(sums(0, 0)) >= least) & (spread > _LEAST_CHANGE**4)
    return np.where(told, sums(1, 1) / np.sqrt(np.where(told, spread, 1.0)), 0.0)
