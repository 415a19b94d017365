"""Probabilities down to 1e-9 and below: missed detection and false alarm of any linear system.

False alarm within a horizon (Adler, Blanchet and Liu 2012): an exceedance is forced at a monitor and epoch drawn
at random, the rest of the path follows by conditioning, and the expected number of exceedances over the number seen is
an unbiased estimate of the probability of at least one. Missed detections: `splitting`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import isfinite
from typing import NamedTuple

import numpy as np

from datasets.experiment.splitting import System, miss_estimate, most_probable_miss
from datasets.experiment.tables import Row
from datasets.experiment.workers import in_pieces
from schemas.arrays import Floats

# Paths of all monitors must fit into some 64 MB.
_LARGEST_BLOCK = 8_000_000
# Independent populations of a split estimate: their scatter is its error.
_POPULATIONS = 20
_SMALLEST_POPULATION, _LARGEST_POPULATION = 250, 1_000
_CLOSE_ENOUGH = 0.02
SMALLEST = 1e-12
"""No probability smaller than this is given, only that it is below."""


class Probability(NamedTuple):
    """An estimate with its relative standard error, and how many plain runs it is worth per run made."""

    value: float
    relative_error: float
    variance_reduction: float
    runs: int


def false_alarm_probability(system: System, epochs: int, runs: int = 4000, seed: int = 1, jobs: int = 1) -> Probability:
    """Probability that healthy monitors, long after their restart, fail at least once in this many epochs."""
    # Small enough for one thread of the linear algebra library, whose threads would cost more than they bring.
    size = max(1, min(system.runs_per_block, _LARGEST_BLOCK // (epochs * system.size)))
    alarms = partial(_alarms, system, epochs)
    return pooled(np.concatenate(in_pieces(alarms, runs, size, (seed, system.streams[0]), jobs)), runs)


def missed_detection_probability(
    system: System, epochs: int, rate_mps: float, runs: int = 20_000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that no monitor fails at epochs 1 .. n of a range ramp of `rate_mps`."""
    miss = partial(miss_estimate, system, epochs, rate_mps, most_probable_miss(system, epochs, rate_mps))
    return pooled(np.array(in_pieces(miss, runs, population_of(runs), (seed, system.streams[1]), jobs)), runs)


def population_of(runs: int) -> int:
    """Size of the independent populations that share the runs; too small ones would lose all of theirs."""
    return min(max(runs // _POPULATIONS, _SMALLEST_POPULATION), _LARGEST_POPULATION)


def pooled(estimates: Floats, runs: int) -> Probability:
    """Mean of independent unbiased estimates of equal weight, its relative error, and the gain over counting."""
    greatest = float(estimates.max())
    if greatest == 0.0:
        return Probability(0.0, float("inf"), 1.0, runs)
    # In units of the greatest, so that the squares of 1e-200 are still numbers.
    shares = estimates / greatest
    error = float(np.sqrt(shares.var(ddof=1) / shares.size) / shares.mean()) if shares.size > 1 else float("inf")
    mean = greatest * float(shares.mean())
    gain = (1.0 - mean) / mean / runs / error**2 if error > 0 else float("inf")
    return Probability(mean, error, gain, runs)


def _alarms(system: System, epochs: int, runs: int, rng: np.random.Generator) -> Floats:
    # Stationary: the covariance depends on the lag alone, and lag zero is in the middle.
    by_lag = system.by_lag(epochs)
    paths = np.empty((epochs, system.size, runs))
    state = system.start(runs, rng)
    for path in paths:
        state = system.following(state, rng)
        path[:] = system.values(state)
    at = rng.integers(0, epochs, runs)
    pulls, per_epoch = system.forced(paths[at, :, np.arange(runs)], rng)
    estimates = np.empty(runs)
    for run, (place, pull) in enumerate(zip(at, pulls, strict=True)):
        pulled = np.flatnonzero(pull)
        together = by_lag[epochs - 1 - place : 2 * epochs - 1 - place, pulled]
        # The forced one counts, whatever rounding does to it.
        count = max(system.fails(paths[:, :, run] + pull[pulled] @ together), 1)
        estimates[run] = epochs * per_epoch / count
    return estimates


def figures(result: Probability) -> Row:
    """The estimate as it stands in a table; nulls where no run came through, which says nothing of the probability.

    Below `SMALLEST` it is not given: the model of the noise does not hold so far out. `below` says so in its place.
    """
    shown = result.value >= SMALLEST
    return {
        "probability": result.value if shown else None,
        "below": SMALLEST if 0.0 < result.value < SMALLEST else None,
        "relative_error": result.relative_error if shown and isfinite(result.relative_error) else None,
        "variance_reduction": result.variance_reduction if shown and isfinite(result.variance_reduction) else None,
        "runs": result.runs,
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
        low = high
        high = min(2 * high, most_epochs)
    while high - low > max(1, _CLOSE_ENOUGH * high):
        middle = (low + high) // 2
        low, high = (low, middle) if below(middle, target) else (middle, high)
    return high
