"""How an estimate of a rare event, and a count beside it, stand in a table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import isfinite

from datasets.experiment.rare import Probability
from pipeline.figures.bounds import clopper_pearson

_NORMAL_95 = 1.959963984540054
_CLOSE_ENOUGH = 0.02


def figures(result: Probability) -> dict[str, float | int | None]:
    """The estimate; nulls where no run came through, which says nothing of the probability."""
    seen = result.value > 0.0
    return {
        "probability": result.value if seen else None,
        "relative_error": _finite(result.relative_error),
        "variance_reduction": _finite(result.variance_reduction) if seen else None,
        "runs": result.runs,
    }


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None


def agreement_row(event: str, sensors: str, epochs: int, clever: Probability, plain: Probability) -> dict[str, object]:
    """An estimate, the count beside it with exact bounds, and whether the two intervals of 95 % meet."""
    counted = clopper_pearson(round(plain.value * plain.runs), plain.runs)
    half = _NORMAL_95 * clever.relative_error * clever.value if clever.value > 0.0 else 0.0
    low, high = counted.low or 0.0, 1.0 if counted.high is None else counted.high
    return {
        "event": event,
        "sensors": sensors,
        "epochs": epochs,
        **figures(clever),
        "counted": counted.value,
        "counted_low": counted.low,
        "counted_high": counted.high,
        "counted_runs": plain.runs,
        "agrees": clever.value - half <= high and clever.value + half >= low,
    }


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
