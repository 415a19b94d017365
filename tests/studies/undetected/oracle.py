"""The bank written anew from DOMAIN section 3, row by row, and the largest error from it.

Rows are plain arrays: `dt_s`, `rate_mps` (recorded), `fresh`, `raw_mps` (threshold of the raw monitor), `ewma_mps`
(rows, averages). The first row is the one after which the fault begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linprog

from pipeline.studies.undetected.watched import NO_ROW, Watched
from schemas.arrays import Bools, Floats


@dataclass
class Rows:
    """One window; `alphas` per second; `low_m`, `high_m`: bounds of the fault itself."""

    alphas: tuple[float, ...]
    dt_s: Floats
    rate_mps: Floats
    fresh: Bools
    raw_mps: Floats
    ewma_mps: Floats
    start_mps: Floats
    low_m: Floats
    high_m: Floats
    largest_mps: float = 5.0

    @property
    def size(self) -> int:
        return self.dt_s.size


def rows(rng: np.random.Generator, size: int, resets: int = 0, levels: bool = False) -> Rows:
    """Recorded noise well inside random thresholds that change slowly, as those of a run do."""
    alphas = (0.1, 0.01, 0.001)
    dt_s = np.where(rng.random(size) < 0.1, 3.0, 1.0)
    fresh = np.zeros(size, dtype=bool)
    fresh[0] = rng.random() < 0.5
    fresh[rng.integers(1, size, resets)] = True
    swell = np.exp(np.cumsum(rng.normal(0.0, 0.01, size)))[:, None]
    limits = swell * np.array([0.7, 0.16, 0.038, 0.0076]) * rng.uniform(0.5, 2.0)
    rate = rng.normal(0.0, 0.15, size) * limits[:, 0]
    empty = np.zeros(3)
    start = empty if fresh[0] else rng.uniform(-0.4, 0.4, 3) * limits[0, 1:]
    made = Rows(
        alphas, dt_s, rate, fresh, limits[:, 0], limits[:, 1:], start, np.full(size, -np.inf), np.full(size, np.inf)
    )
    # A threshold that the recorded noise itself exceeds would be an alarm: lift it.
    averages = recursions(made, np.zeros(size))
    made.ewma_mps = np.maximum(made.ewma_mps, 1.3 * np.abs(averages))
    if levels:
        made.high_m = rng.uniform(4.0, 9.0, size)
        made.low_m = -rng.uniform(4.0, 9.0, size)
    return made


def recursions(window: Rows, fault_m: Floats) -> Floats:
    """Every average at every row with this fault, by the recursion as it is printed; shape (rows, averages)."""
    found = np.zeros((window.size, len(window.alphas)))
    for index, alpha in enumerate(window.alphas):
        value = window.start_mps[index]
        for row in range(1, window.size):
            if window.fresh[row]:
                value = 0.0
            else:
                weight = 1.0 - (1.0 - alpha) ** window.dt_s[row]
                rate = window.rate_mps[row] + (fault_m[row] - fault_m[row - 1]) / window.dt_s[row]
                value = weight * rate + (1.0 - weight) * value
            found[row, index] = value
    return found


def beyond(window: Rows, fault_m: Floats) -> float:
    """The largest share of a threshold that a monitor reaches at any row."""
    averages = recursions(window, fault_m)
    shares = [0.0]
    for row in range(1, window.size):
        if window.fresh[row]:
            continue
        rate = window.rate_mps[row] + (fault_m[row] - fault_m[row - 1]) / window.dt_s[row]
        shares.append(abs(rate) / window.raw_mps[row])
        shares += (np.abs(averages[row]) / window.ewma_mps[row]).tolist()
    return max(shares)


def optimum(window: Rows) -> float:
    """The largest fault at the last row, by a dense program over the fault's own values."""
    size = window.size
    none = recursions(window, np.zeros(size))
    matrix, right = [], []
    effect = np.zeros((size, len(window.alphas), size))
    raw = np.zeros((size, size))
    for column in range(1, size):
        one = np.zeros(size)
        one[column] = 1.0
        effect[:, :, column] = recursions(window, one) - none
        raw[column, column] = 1.0 / window.dt_s[column]
        if column + 1 < size:
            raw[column + 1, column] = -1.0 / window.dt_s[column + 1]
    for row in range(1, size):
        largest = np.zeros(size)
        largest[row], largest[row - 1] = 1.0, -1.0
        for sign in (1.0, -1.0):
            matrix.append(sign * largest / window.dt_s[row])
            right.append(window.largest_mps)
            if window.fresh[row]:
                continue
            matrix.append(sign * raw[row] / window.raw_mps[row])
            right.append(1.0 - sign * window.rate_mps[row] / window.raw_mps[row])
            for index in range(len(window.alphas)):
                limit = window.ewma_mps[row, index]
                matrix.append(sign * effect[row, index] / limit)
                right.append(1.0 - sign * none[row, index] / limit)
    goal = np.zeros(size)
    goal[-1] = -1.0
    bounds = np.column_stack([window.low_m, window.high_m])
    bounds[0] = 0.0
    found = linprog(goal, A_ub=np.array(matrix), b_ub=np.array(right), bounds=bounds, method="highs")
    assert found.status == 0
    return float(-found.fun)


def watched(window: Rows) -> Watched:
    """The same rows as the program has them."""
    alphas, size = np.array(window.alphas), window.size
    unlimited = np.where(window.fresh, np.inf, 1.0)
    averages = recursions(window, np.zeros(size))
    averages[0] = window.start_mps
    infinite, zero = np.full(size, np.inf), np.zeros(size)
    return Watched(
        epoch=np.arange(size),
        t_s=np.cumsum(window.dt_s),
        fresh=window.fresh,
        free=np.zeros(size, dtype=bool),
        fastest_m=window.largest_mps * window.dt_s,
        gain_s=window.dt_s,
        rate_mps=window.rate_mps,
        least_mps=np.maximum(-window.raw_mps * unlimited, window.rate_mps - window.largest_mps),
        most_mps=np.minimum(window.raw_mps * unlimited, window.rate_mps + window.largest_mps),
        weight=1.0 - (1.0 - alphas[None, :]) ** window.dt_s[:, None],
        average_mps=averages,
        threshold_mps=window.ewma_mps * unlimited[:, None],
        low_m=window.low_m,
        high_m=window.high_m,
        anchor=np.full(size, NO_ROW),
        held_low_m=-infinite,
        held_high_m=infinite,
        learned_m=zero,
        learned_late_m=zero,
    )
