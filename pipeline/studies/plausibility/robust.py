"""One robust regression for every comparison, and what is asked of its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from schemas.arrays import Bools, Floats

# Tukey's biweight, 95 % efficient on Gaussian noise (Huber and Ronchetti 2009), after least absolute deviations.
_BIWEIGHT = 4.685
_ROUNDS = 12
# Fewer observations tell nothing.
LEAST = 6
# Lags and factors differ where they are so many sigmas apart: windows overlap and errors last.
SIGNIFICANT_SIGMAS = 5.0


@dataclass(frozen=True)
class Shift:
    """How far one record lies from another [m]."""

    east_m: float
    north_m: float

    @property
    def shift_m(self) -> float:
        return float(np.hypot(self.east_m, self.north_m))

    @property
    def towards(self) -> str:
        """In words."""
        east = "east" if self.east_m >= 0 else "west"
        north = "north" if self.north_m >= 0 else "south"
        return f"{abs(self.east_m):.0f} m {east}, {abs(self.north_m):.0f} m {north}"

    def off_m(self, other: Shift) -> float:
        """How far this shift is from another."""
        return float(np.hypot(self.east_m - other.east_m, self.north_m - other.north_m))


@dataclass(frozen=True)
class Regression:
    """`estimate` with `sigma` (inf: not known); `spread`: of what is left [m]; `whole`: all of it is known."""

    estimate: Floats
    sigma: Floats
    spread: float
    whole: bool


def steady(whole: Floats, *halves: Floats) -> bool:
    """Whether every half points the same way as the whole, and by more than half of it: a drift in one does not."""
    return all(float(half @ whole) > 0.5 * float(whole @ whole) for half in halves)


def regressed(
    design: Floats,
    target: Floats,
    floor: float,
    least_known: float = 1e-12,
    start: tuple[float, ...] | None = None,
) -> Regression:
    """Robust regression; `design` (n, m, k), `target` (n, m): the m parts of one observation share a weight.

    `floor`: least spread of what is left. Directions with less than the share `least_known` of the information of the
    best known one stay zero. `start`: an estimate to begin with, else that of least absolute deviations. Iteratively
    reweighted least squares: the weight of an observation falls with what the last round left of it.
    """
    count, each = target.shape
    equations = design.reshape(count * each, -1)
    goal = target.ravel()
    weight = np.ones(count)
    left = np.zeros(count) if start is None else np.linalg.norm(target - design @ np.array(start), axis=1)
    for number in range(_ROUNDS):
        spread = max(1.4826 * float(np.median(left)), floor)
        if start is None and number < _ROUNDS // 2:
            weight = floor / np.maximum(left, floor)
        else:
            weight = np.clip(1.0 - (left / (_BIWEIGHT * spread)) ** 2, 0.0, None) ** 2
        weighted = (equations * np.repeat(weight, each)[:, None]).T
        strengths, axes = np.linalg.eigh(weighted @ equations)
        known = strengths > least_known * strengths[-1]
        inverse = (axes[:, known] / strengths[known]) @ axes[:, known].T
        estimate = inverse @ (weighted @ goal)
        left = np.linalg.norm((goal - equations @ estimate).reshape(count, each), axis=1)
    whole = bool(known.all())
    sigma = spread * np.sqrt(np.diag(inverse)) if whole else np.full(len(estimate), np.inf)
    return Regression(estimate, sigma, spread, whole)


def of_halves(fit: Callable[[slice], Regression], count: int) -> list[Floats]:
    """The estimates of the first and the second half of so many observations alone; none of too few."""
    halves = (slice(count // 2), slice(count // 2, count))
    return [fit(half).estimate for half in halves if half.stop - (half.start or 0) >= LEAST]


def explains(share: float, before: float) -> bool:
    """Whether a cause explains a misfit: most of the run agrees with it, and it leaves half of the rest at most."""
    return share >= 0.5 and 1.0 - share <= 0.5 * (1.0 - before)


def sampled(rows: Bools, most: int = 800) -> Bools:
    """At most so many of the true rows, evenly."""
    chosen = np.flatnonzero(rows)
    kept = np.zeros_like(rows)
    kept[chosen[:: max(1, chosen.size // most)]] = True
    return kept


def usual(values: Floats, share: float = 0.5) -> float:
    """Quantile of what is known; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if known.size else float("nan")
