"""How an estimate of a rare event stands in a table, and after what time it is rare enough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite

from datasets.experiment.rare import Probability

_CLOSE_ENOUGH = 0.02
SMALLEST = 1e-12
"""No probability smaller than this is told, only that it is below."""


def figures(result: Probability) -> dict[str, float | int | None]:
    """The estimate; nulls where no run came through, which says nothing of the probability.

    Below `SMALLEST` it is not told: the model of the noise does not hold so far out. `below` says so in its place.
    """
    told = result.value >= SMALLEST
    return {
        "probability": result.value if told else None,
        "below": SMALLEST if 0.0 < result.value < SMALLEST else None,
        "relative_error": _finite(result.relative_error) if told else None,
        "variance_reduction": _finite(result.variance_reduction) if told else None,
        "runs": result.runs,
    }


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def first_below(probability: Callable[[int], float], targets: Sequence[float], most_epochs: int) -> list[int | None]:
    """Epochs after which a falling probability is below each target, within 2 %; None if that takes too many.

    Few runs per step do: time is found far better than probability, which falls steeply. An estimate of zero, all
    runs lost, says nothing and counts as not below.
    """
    known: dict[int, float] = {}

    def below(epochs: int, target: float) -> bool:
        if epochs not in known:
            known[epochs] = probability(epochs)
        return 0.0 < known[epochs] < target

    return [_bisected(below, target, most_epochs) for target in targets]


def _bisected(below: Callable[[int, float], bool], target: float, most_epochs: int) -> int | None:
    low, high = 1, 8
    while not below(high, target):
        if high >= most_epochs:
            return None
        low, high = high, min(2 * high, most_epochs)
    while high - low > max(1, _CLOSE_ENOUGH * high):
        middle = (low + high) // 2
        low, high = (low, middle) if below(middle, target) else (middle, high)
    return high
