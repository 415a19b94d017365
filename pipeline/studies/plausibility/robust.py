"""One robust regression for every comparison, and what is asked of its result."""

from __future__ import annotations

import numpy as np

from schemas.arrays import Bools, Floats
from schemas.frozen import frozen

# Tukey's biweight, 95 % efficient on Gaussian noise (Huber and Ronchetti 2009), after least absolute deviations.
_BIWEIGHT = 4.685
_ROUNDS = 6
# Numerics: an estimate stays where none of its parts (metres, seconds, shares) moves by more.
_STAYS = 1e-6
# Fewer observations tell nothing.
LEAST = 6
# Lags and factors differ where they are so many sigmas apart: windows overlap and errors last.
SIGNIFICANT_SIGMAS = 5.0


@frozen
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


def regressed(design: Floats, target: Floats, floor: float, least_known: float = 1e-12) -> Regression:
    """Robust regression; `design` (n, m, k), `target` (n, m): the m parts of one observation share a weight.

    `floor`: least spread of what is left. Directions with less than the share `least_known` of the information of the
    best known one stay zero.
    """
    estimate = np.zeros(design.shape[2])
    left = np.zeros(len(target))
    # Least absolute deviations, then the biweight; each until it stays.
    for least_absolute in (True, False):
        for _ in range(_ROUNDS):
            before = estimate
            spread = max(1.4826 * usual(left), floor)
            if least_absolute:
                weight = floor / np.maximum(left, floor)
            else:
                weight = np.clip(1.0 - (left / (_BIWEIGHT * spread)) ** 2, 0.0, None) ** 2
            estimate, variance = _solved(design, target, weight, least_known)
            left = _lengths(target - design @ estimate)
            if np.abs(estimate - before).max() <= _STAYS:
                break
    alone = (_solved(design[part], target[part], weight[part], least_known)[0] for part in halves_of(len(target)))
    halves = tuple(alone) if len(target) >= 2 * LEAST else ()
    whole = bool(np.isfinite(variance).all())
    return Regression(estimate, spread * np.sqrt(variance), weight, spread, halves, whole)


def _lengths(vectors: Floats) -> Floats:
    """Lengths of the rows."""
    return np.asarray(np.sqrt((vectors**2).sum(axis=1)))


def _solved(design: Floats, target: Floats, weight: Floats, least_known: float) -> tuple[Floats, Floats]:
    """Weighted least squares, and the variance of each part at a spread of 1 (inf where a direction is not known)."""
    parts = design.reshape(-1, design.shape[2])
    weighted = (design * weight[:, None, None]).reshape(parts.shape)
    strengths, axes = np.linalg.eigh(weighted.T @ parts)
    known = strengths > least_known * max(float(strengths[-1]), 1e-300)
    inverse = (axes[:, known] / strengths[known]) @ axes[:, known].T
    variance = np.diag(inverse) if known.all() else np.full(len(inverse), np.inf)
    return inverse @ (weighted.T @ target.ravel()), variance


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
    if not known.size:
        return float("nan")
    # As `np.quantile`, which takes ten times as long for some hundred values.
    place = share * (known.size - 1)
    below = int(place)
    above = min(below + 1, known.size - 1)
    part = np.partition(known, (below, above))
    return float(part[below] + (place - below) * (part[above] - part[below]))
