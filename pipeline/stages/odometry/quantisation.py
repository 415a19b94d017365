"""Quantisation noise: what single rows of an odometer's distance are off by, measured from the rows themselves.

A counter of whole metres, stamps on receipt, noise of the reading: nothing of it adds up, but at 10 Hz a counter of
half metres seems to change its speed by metres per second from epoch to epoch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.stages.odometry.written_steps import step_of
from schemas.arrays import Bools, Floats, Ints
from schemas.config import AlignConfig

# Numerics of the fit: so many rows of a piece, and the degree of its curve.
_MOST_ROWS = 16
_FEWEST_ROWS = 8
_DEGREE = 3
# Enough for the median, however long the run is; with fewer it is chance.
_PIECES = 400
_FEWEST_PIECES = 8
# Less is rounding of decimal numbers, which are not whole in binary; far below any `counter_step_m`.
_ROUNDED_M = 1e-3


@dataclass(frozen=True)
class QuantisationNoise:
    """Variance [m^2] of a row at a stand, and its growth with the square of the speed [s^2]."""

    still_m2: float = 0.0
    moving_s2: float = 0.0

    def variance_m2(self, speed_mps: Floats) -> Floats:
        return self.still_m2 + self.moving_s2 * speed_mps**2

    def __bool__(self) -> bool:
        return self.still_m2 > 0.0 or self.moving_s2 > 0.0


NO_QUANTISATION = QuantisationNoise()


def quantisation_noise(
    t_s: Floats,
    distance_m: Floats,
    whole: Bools,
    white_m2_per_s: float,
    counter_m: float,
    deadband_mps: float,
    config: AlignConfig,
) -> QuantisationNoise:
    """What rows scatter about smooth curves beyond white noise of the increments.

    `whole` (rows - 1,): ways that are recorded. Medians over pieces in which the train moves, so that slips do not
    count. Noise of stamps grows with the square of the speed: low and high speeds are separated where their squares
    differ by `quantisation_factor`. A counter has the noise of its step at least: it does not show at one speed.
    """
    scatter = _scatter_beyond(t_s, distance_m, whole, white_m2_per_s, deadband_mps, config)
    return replace(scatter, still_m2=max(scatter.still_m2, counter_m**2 / 12.0))


def count_step_m(distance_m: Floats, whole: Bools, config: AlignConfig) -> float:
    """0 where there is none, or one finer than `counter_step_m`."""
    ways = np.abs(np.diff(distance_m)[whole])
    return step_of(ways, ways, config.counter_step_m, _ROUNDED_M)


def _scatter_beyond(
    t_s: Floats, distance_m: Floats, whole: Bools, white_m2_per_s: float, deadband_mps: float, config: AlignConfig
) -> QuantisationNoise:
    rows = _moving_pieces(t_s, distance_m, whole, deadband_mps, config)
    if len(rows) < _FEWEST_PIECES:
        return QuantisationNoise()
    since_s = t_s[rows] - t_s[rows[:, :1]]
    ways = distance_m[rows] - distance_m[rows[:, :1]]
    scatter, explained = _scatter(since_s, ways, white_m2_per_s)
    speeds = np.abs(ways[:, -1]) / since_s[:, -1]
    fast = speeds > np.median(speeds)
    low_mps, high_mps = (float(np.median(speeds[part])) if part.any() else 0.0 for part in (~fast, fast))
    if fast.sum() < _FEWEST_PIECES or high_mps**2 < config.quantisation_factor * low_mps**2:
        return QuantisationNoise(_beyond(scatter, explained, config))
    low_m2, high_m2 = (_beyond(scatter[part], explained[part], config) for part in (~fast, fast))
    moving_s2 = max(high_m2 - low_m2, 0.0) / (high_mps**2 - low_mps**2)
    return QuantisationNoise(max(low_m2 - moving_s2 * low_mps**2, 0.0), moving_s2)


def _moving_pieces(t_s: Floats, distance_m: Floats, whole: Bools, deadband_mps: float, config: AlignConfig) -> Ints:
    """Rows of pieces without a gap in which the train moves, spread over the run; shape (pieces, rows).

    None where rows are so far apart that the train drives otherwise from one to the next.
    """
    period_s = float(np.median(np.diff(t_s)))
    if period_s > config.straight_s or period_s <= 0.0:
        return np.zeros((0, 1), dtype=np.int64)
    count = int(np.clip(np.ceil(config.quantisation_span_s / period_s) + 1, _FEWEST_ROWS, _MOST_ROWS))
    stride = max(1, round(config.quantisation_span_s / period_s / (count - 1)))
    length = (count - 1) * stride
    starts = np.arange(0, t_s.size - length, max(length, (t_s.size - length) // _PIECES))
    broken = np.concatenate([[0], np.cumsum(~whole)])
    way_m = distance_m[starts + length] - distance_m[starts]
    time_s = t_s[starts + length] - t_s[starts]
    moves = np.abs(way_m) > deadband_mps * time_s
    starts = starts[moves & (broken[starts + length] == broken[starts])]
    chosen: Ints = starts[:, None] + stride * np.arange(count)
    return chosen


def _scatter(since_s: Floats, way_m: Floats, white_m2_per_s: float) -> tuple[Floats, Floats]:
    """Variance about the curves [m^2] of each piece, and what white noise of the increments makes of it."""
    count = since_s.shape[1]
    powers = (2.0 * since_s / since_s[:, -1:] - 1.0)[:, :, None] ** np.arange(_DEGREE + 1)
    curves, _ = np.linalg.qr(powers)
    fitted = curves @ (curves.transpose(0, 2, 1) @ way_m[:, :, None])
    scatter = ((way_m - fitted[:, :, 0]) ** 2).sum(axis=1)
    walk = np.minimum(since_s[:, :, None], since_s[:, None, :])
    left = since_s.sum(axis=1) - (curves * (walk @ curves)).sum(axis=(1, 2))
    free = count - _DEGREE - 1
    return scatter / free, white_m2_per_s * left / free


def _beyond(scatter_m2: Floats, explained_m2: Floats, config: AlignConfig) -> float:
    """The median scatter less what explains it [m^2]; none where that is most of it."""
    scatter = float(np.median(scatter_m2))
    explained = float(np.median(explained_m2))
    return scatter - explained if scatter > config.quantisation_factor * explained else 0.0
