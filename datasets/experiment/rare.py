"""Probabilities down to 1e-9 and below: missed detection and false alarm of any linear bank.

False alarm within a horizon (Adler, Blanchet and Liu 2012): an exceedance is forced at a monitor and epoch drawn
at random, the rest of the path follows by conditioning, and the expected number of exceedances over the number seen is
an unbiased estimate of the probability of at least one. Missed detections: `splitting`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from datasets.experiment.linear_bank import LinearBank
from datasets.experiment.splitting import Shift, miss_estimate, most_probable_miss
from datasets.experiment.workers import generator, in_blocks
from pipeline.campaign.workers import mapped
from schemas.arrays import Floats

W = TypeVar("W")

# Small enough for one thread of the linear algebra library, whose threads would cost more than they bring.
_RUNS_PER_BLOCK = 250
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
    bank: LinearBank
    epochs: int
    rate_mps: float
    shift: Shift | None
    key: tuple[int, ...]
    runs: int


def false_alarm_probability(
    bank: LinearBank, epochs: int, runs: int = 4000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that a fault-free bank, long after its restart, fails at least once in this many epochs."""
    if bank.spec.age_s is not None:
        raise ValueError("false alarms are sampled of a stationary bank")
    return pooled(_false_alarm_block, _works(bank, epochs, 0.0, (seed, 31), runs), runs, jobs)


def missed_detection_probability(
    bank: LinearBank, epochs: int, rate_mps: float, runs: int = 20_000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that no monitor fails at epochs 1 .. n of a range ramp of `rate_mps`."""
    shift = most_probable_miss(bank, epochs, rate_mps)
    works = [
        _Work(bank, epochs, rate_mps, shift, (seed, 32, number), size) for number, size in enumerate(populations(runs))
    ]
    return pooled(_miss_block, works, runs, jobs)


def populations(runs: int) -> list[int]:
    """Sizes of the independent populations that share the runs; too small ones would lose all of theirs."""
    return in_blocks(runs, min(max(runs // _POPULATIONS, _SMALLEST_POPULATION), _LARGEST_POPULATION))


def _works(bank: LinearBank, epochs: int, rate_mps: float, key: tuple[int, ...], runs: int) -> list[_Work]:
    return [
        _Work(bank, epochs, rate_mps, None, (*key, number), size)
        for number, size in enumerate(in_blocks(runs, _block_size(bank, epochs)))
    ]


def _block_size(bank: LinearBank, epochs: int) -> int:
    """Runs that are simulated together; paths of all monitors must fit into some 64 MB."""
    return max(1, min(_RUNS_PER_BLOCK, _LARGEST_BLOCK // (epochs * bank.slope.size)))


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


def _false_alarm_block(work: _Work) -> Floats:
    bank, rng = work.bank, generator(*work.key)
    monitors = bank.slope.size
    paths = np.empty((work.epochs, monitors, work.runs))
    for path, noise in zip(paths, bank.paths(work.epochs, work.runs, rng), strict=True):
        path[:] = noise
    epoch = rng.integers(1, work.epochs + 1, work.runs)
    monitor = rng.integers(0, monitors, work.runs)
    factor = bank.threshold / bank.sigma
    log_tail = float(log_ndtr(-factor[0]))
    # A normal beyond its threshold, by inversion of the tail in logarithms: no underflow at 1e-15.
    target = -ndtri_exp(log_tail + np.log(rng.random(work.runs))) * bank.sigma[monitor]
    target *= rng.choice([-1.0, 1.0], work.runs)
    expected_count = work.epochs * monitors * 2.0 * np.exp(log_tail)
    estimates = np.empty(work.runs)
    by_lag = bank.covariances_by_lag(work.epochs)
    for run in range(work.runs):
        at, which = int(epoch[run]), int(monitor[run])
        # Stationary: the covariance depends on the lag alone, and lag zero is in the middle.
        together = by_lag[work.epochs - at : 2 * work.epochs - at, which]
        lacking = target[run] - paths[at - 1, which, run]
        path = paths[:, :, run] + together * (lacking / bank.sigma[which] ** 2)
        # The forced one counts, whatever rounding does to it.
        count = int((np.abs(path) > bank.threshold).sum())
        estimates[run] = expected_count / max(count, 1)
    return estimates


def _miss_block(work: _Work) -> Floats:
    if work.shift is None:
        raise ValueError("missed detection is sampled around the most probable miss")
    rng = generator(*work.key)
    return np.array([miss_estimate(work.bank, work.epochs, work.rate_mps, work.shift, work.runs, rng)])
