"""One robust regression for every comparison, and what is asked of its result."""

from __future__ import annotations

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
class Regression:
    """`estimate` with `sigma` (inf: not known); `weight` of each observation, `spread` of what is left [m].

    `halves`: the estimates of the first and the second half of the run alone. `whole`: every part of the estimate is
    known.
    """

    estimate: Floats
    sigma: Floats
    weight: Floats
    spread: float
    halves: tuple[Floats, ...]
    whole: bool


def halves_of(count: int) -> tuple[slice, slice]:
    return slice(None, count // 2), slice(count // 2, None)


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
    best known one stay zero. `start`: an estimate to begin with, else that of least absolute deviations.
    """
    weight = np.ones(len(target))
    left = np.zeros(len(target)) if start is None else np.linalg.norm(target - design @ np.array(start), axis=1)
    for number in range(_ROUNDS):
        spread = max(1.4826 * float(np.median(left)), floor)
        if start is None and number < _ROUNDS // 2:
            weight = floor / np.maximum(left, floor)
        else:
            weight = np.clip(1.0 - (left / (_BIWEIGHT * spread)) ** 2, 0.0, None) ** 2
        estimate, variance = _solved(design, target, weight, least_known)
        left = np.linalg.norm(target - design @ estimate, axis=1)
    alone = (_solved(design[part], target[part], weight[part], least_known)[0] for part in halves_of(len(target)))
    halves = tuple(alone) if len(target) >= 2 * LEAST else ()
    whole = bool(np.isfinite(variance).all())
    return Regression(estimate, spread * np.sqrt(variance), weight, spread, halves, whole)


def _solved(design: Floats, target: Floats, weight: Floats, least_known: float) -> tuple[Floats, Floats]:
    """Weighted least squares, and the variance of each part at a spread of 1 (inf where a direction is not known)."""
    weighted = design * weight[:, None, None]
    normal = np.einsum("nmk,nml->kl", weighted, design)
    strengths, axes = np.linalg.eigh(normal)
    known = strengths > least_known * max(float(strengths[-1]), 1e-300)
    inverse = (axes[:, known] / strengths[known]) @ axes[:, known].T
    variance = np.diag(inverse) if known.all() else np.full(len(inverse), np.inf)
    return inverse @ np.einsum("nmk,nm->k", weighted, target), variance


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
