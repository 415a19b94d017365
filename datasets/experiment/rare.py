"""Probabilities down to 1e-9 and below: missed detection and false alarm of any linear system.

False alarm within a horizon (Adler, Blanchet and Liu 2012): an exceedance is forced at a monitor and epoch drawn
at random, the rest of the path follows by conditioning, and the expected number of exceedances over the number seen is
an unbiased estimate of the probability of at least one. Missed detections: `splitting`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np

from datasets.experiment.splitting import Shift, System, miss_estimate, most_probable_miss
from datasets.experiment.workers import generator, in_blocks
from pipeline.campaign.workers import mapped
from schemas.arrays import Floats

W = TypeVar("W")

# Paths of all monitors must fit into some 64 MB.
_LARGEST_BLOCK = 8_000_000
# Independent populations of a split estimate: their scatter is its error.
_POPULATIONS = 20
_SMALLEST_POPULATION, _LARGEST_POPULATION = 250, 1_000


class Probability(NamedTuple):
    """An estimate with its relative standard error, and how many plain runs it is worth per run made."""

    value: float
    relative_error: float
    variance_reduction: float
    runs: int


@dataclass(frozen=True)
class _Work:
    system: System
    epochs: int
    rate_mps: float
    shift: Shift | None
    key: tuple[int, ...]
    runs: int


def false_alarm_probability(system: System, epochs: int, runs: int = 4000, seed: int = 1, jobs: int = 1) -> Probability:
    """Probability that healthy monitors, long after their restart, fail at least once in this many epochs."""
    # Small enough for one thread of the linear algebra library, whose threads would cost more than they bring.
    size = max(1, min(system.runs_per_block, _LARGEST_BLOCK // (epochs * system.size)))
    works = [
        _Work(system, epochs, 0.0, None, (seed, system.streams[0], number), block)
        for number, block in enumerate(in_blocks(runs, size))
    ]
    return pooled(_alarm_block, works, runs, jobs)


def missed_detection_probability(
    system: System, epochs: int, rate_mps: float, runs: int = 20_000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that no monitor fails at epochs 1 .. n of a range ramp of `rate_mps`."""
    shift = most_probable_miss(system, epochs, rate_mps)
    works = [
        _Work(system, epochs, rate_mps, shift, (seed, system.streams[1], number), size)
        for number, size in enumerate(populations(runs))
    ]
    return pooled(_miss_block, works, runs, jobs)


def populations(runs: int) -> list[int]:
    """Sizes of the independent populations that share the runs; too small ones would lose all of theirs."""
    return in_blocks(runs, min(max(runs // _POPULATIONS, _SMALLEST_POPULATION), _LARGEST_POPULATION))


def pooled(block: Callable[[W], Floats], works: list[W], runs: int, jobs: int) -> Probability:
    """Mean of independent unbiased estimates of equal weight, its relative error, and the gain over counting."""
    estimates = np.concatenate(mapped(block, works, jobs))
    greatest = float(estimates.max())
    if greatest == 0.0:
        return Probability(0.0, float("inf"), 1.0, runs)
    # In units of the greatest, so that the squares of 1e-200 are still numbers.
    shares = estimates / greatest
    error = float(np.sqrt(shares.var(ddof=1) / shares.size) / shares.mean()) if shares.size > 1 else float("inf")
    mean = greatest * float(shares.mean())
    gain = (1.0 - mean) / mean / runs / error**2 if error > 0 else float("inf")
    return Probability(mean, error, gain, runs)


def _alarm_block(work: _Work) -> Floats:
    system, epochs, rng = work.system, work.epochs, generator(*work.key)
    # Stationary: the covariance depends on the lag alone, and lag zero is in the middle.
    by_lag = system.by_lag(epochs)
    paths = np.empty((epochs, system.size, work.runs))
    state = system.start(work.runs, rng)
    for path in paths:
        state = system.following(state, rng)
        path[:] = system.values(state)
    at = rng.integers(0, epochs, work.runs)
    pulls, per_epoch = system.forced(paths[at, :, np.arange(work.runs)], rng)
    estimates = np.empty(work.runs)
    for run, (place, pull) in enumerate(zip(at, pulls, strict=True)):
        pulled = np.flatnonzero(pull)
        together = by_lag[epochs - 1 - place : 2 * epochs - 1 - place, pulled]
        # The forced one counts, whatever rounding does to it.
        count = max(system.fails(paths[:, :, run] + pull[pulled] @ together), 1)
        estimates[run] = epochs * per_epoch / count
    return estimates


def _miss_block(work: _Work) -> Floats:
    if work.shift is None:
        raise ValueError("missed detection is sampled around the most probable miss")
    rng = generator(*work.key)
    return np.array([miss_estimate(work.system, work.epochs, work.rate_mps, work.shift, work.runs, rng)])
