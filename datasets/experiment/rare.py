"""Probabilities down to 1e-9 and below: missed detection and false alarm of any linear bank, by importance sampling.

False alarm within a horizon (Adler, Blanchet and Liu 2012): an exceedance is forced at a monitor and epoch drawn
at random, the rest of the path follows by conditioning, and the expected number of exceedances over the number seen is
an unbiased estimate of the probability of at least one.

Missed detection until the failure: all monitors stay inside their thresholds although the ramp pushes them out. That
set is convex in the noise, so the noise is shifted by its most probable point (the least-norm solution, a small
quadratic programme), and weights are then bounded by the probability's own order of magnitude.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import nnls
from scipy.special import log_ndtr, ndtri_exp

from datasets.experiment.linear_bank import LinearBank
from datasets.experiment.workers import generator, in_blocks, mapped

Array = npt.NDArray[np.float64]

# Small enough for one thread of the linear algebra library, whose threads would cost more than they bring.
_RUNS_PER_BLOCK = 250
_LARGEST_BLOCK = 8_000_000
_MOST_CONSTRAINTS = 120
# The shifted path stays this many sigmas inside the thresholds: with many constraints at once more runs survive.
_MARGIN = 0.4


class Probability(NamedTuple):
    """An estimate with its relative standard error, and how many plain runs it is worth per run made."""

    value: float
    relative_error: float
    variance_reduction: float
    runs: int


class Shift(NamedTuple):
    """Constraints (epoch, monitor) that hold the noise back, their multipliers, and the shifted mean path."""

    epoch: npt.NDArray[np.int64]
    monitor: npt.NDArray[np.int64]
    multiplier: Array
    mean: Array
    half_square: float


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
    """Probability that a fault-free bank fails at least once in this many epochs."""
    return _pooled(_false_alarm_block, _works(bank, epochs, 0.0, None, (seed, 31), runs), jobs)


def missed_detection_probability(
    bank: LinearBank, epochs: int, rate_mps: float, runs: int = 50_000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that no monitor fails at epochs 1 .. n of a range ramp of `rate_mps`."""
    shift = most_probable_miss(bank, epochs, rate_mps)
    return _pooled(_miss_block, _works(bank, epochs, rate_mps, shift, (seed, 32), runs), jobs)


def plain_false_alarm(bank: LinearBank, epochs: int, runs: int, seed: int = 1, jobs: int = 1) -> Probability:
    """The same by counting, to verify where counting can reach."""
    return _pooled(_plain_alarm_block, _works(bank, epochs, 0.0, None, (seed, 33), runs), jobs)


def plain_missed_detection(
    bank: LinearBank, epochs: int, rate_mps: float, runs: int, seed: int = 1, jobs: int = 1
) -> Probability:
    """The same by counting, to verify where counting can reach."""
    return _pooled(_plain_miss_block, _works(bank, epochs, rate_mps, None, (seed, 34), runs), jobs)


def most_probable_miss(bank: LinearBank, epochs: int, rate_mps: float) -> Shift:
    """Least-norm noise that keeps every monitor below its threshold on the side the ramp pushes to.

    Constraints are added one by one where the path still exceeds; with multipliers l and covariance C of the
    constrained values, the noise of all monitors moves by -C l and its squared norm is l' C l.
    """
    towards = np.where(bank.slope < 0, -1.0, 1.0)
    ramp = rate_mps * bank.response(epochs)
    epoch: list[int] = []
    monitor: list[int] = []
    columns: list[Array] = []
    mean = np.zeros_like(ramp)
    multiplier = np.zeros(0)
    gram = np.zeros((0, 0))
    for _ in range(_MOST_CONSTRAINTS):
        excess = (towards * (ramp + mean) - bank.threshold) / bank.sigma
        worst = np.unravel_index(int(excess.argmax()), excess.shape)
        if excess[worst] < -0.5 * _MARGIN:
            break
        epoch.append(int(worst[0]) + 1)
        monitor.append(int(worst[1]))
        columns.append(towards[worst[1]] * bank.covariance_with(monitor[-1], epoch[-1], epochs))
        at, which = np.array(epoch) - 1, np.array(monitor)
        gram = np.array([(towards[which] * column[at, which]) for column in columns])
        needed = towards[which] * ramp[at, which] - bank.threshold[which] + _MARGIN * bank.sigma[which]
        multiplier = _least_norm(gram, needed)
        mean = -np.einsum("c,ckm->km", multiplier, np.array(columns))
    signed = multiplier * towards[np.array(monitor, dtype=np.int64)] if monitor else multiplier
    half = 0.5 * float(multiplier @ gram @ multiplier) if monitor else 0.0
    return Shift(np.array(epoch, dtype=np.int64), np.array(monitor, dtype=np.int64), signed, mean, half)


def _least_norm(gram: Array, needed: Array) -> Array:
    """Multipliers l >= 0 of min l' C l / 2 - l' needed."""
    ridge = 1e-10 * float(np.trace(gram))
    factor = np.linalg.cholesky(gram + ridge * np.eye(len(gram)))
    multiplier, _ = nnls(factor.T, np.linalg.solve(factor, needed), maxiter=50 * len(gram))
    return np.asarray(multiplier)


def _works(
    bank: LinearBank, epochs: int, rate_mps: float, shift: Shift | None, key: tuple[int, ...], runs: int
) -> list[_Work]:
    return [
        _Work(bank, epochs, rate_mps, shift, (*key, number), size)
        for number, size in enumerate(in_blocks(runs, _block_size(bank, epochs)))
    ]


def _block_size(bank: LinearBank, epochs: int) -> int:
    """Runs that are simulated together; paths of all monitors must fit into some 64 MB."""
    return max(1, min(_RUNS_PER_BLOCK, _LARGEST_BLOCK // (epochs * bank.slope.size)))


def _pooled(block: Callable[[_Work], tuple[float, float]], works: list[_Work], jobs: int) -> Probability:
    """Mean of independent unbiased estimates, its relative error, and the gain over counting."""
    sums = np.array(mapped(block, works, jobs))
    runs = sum(work.runs for work in works)
    mean = float(sums[:, 0].sum()) / runs
    variance = max(float(sums[:, 1].sum()) / runs - mean**2, 0.0)
    if mean == 0.0:
        return Probability(0.0, float("inf"), 1.0, runs)
    gain = mean * (1.0 - mean) / variance if variance > 0 else float("inf")
    return Probability(mean, float(np.sqrt(variance / runs)) / mean, gain, runs)


def _sums(estimates: Array) -> tuple[float, float]:
    return float(estimates.sum()), float((estimates**2).sum())


def _false_alarm_block(work: _Work) -> tuple[float, float]:
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
    return _sums(estimates)


def _miss_block(work: _Work) -> tuple[float, float]:
    bank, shift = work.bank, work.shift
    if shift is None:
        raise ValueError("missed detection is sampled around the most probable miss")
    rng = generator(*work.key)
    moved = shift.mean + work.rate_mps * bank.response(work.epochs)
    alive, exponent = np.ones(work.runs, dtype=np.bool_), np.zeros(work.runs)
    for k, noise in enumerate(bank.paths(work.epochs, work.runs, rng)):
        alive &= (np.abs(noise + moved[k][:, None]) <= bank.threshold[:, None]).all(axis=0)
        for index in np.flatnonzero(shift.epoch == k + 1):
            exponent += shift.multiplier[index] * noise[shift.monitor[index]]
    # Density of the true noise over that of the shifted one: exp(l' m - l' C l / 2), m the noise at the constraints.
    return _sums(np.where(alive, np.exp(exponent - shift.half_square), 0.0))


def _plain_alarm_block(work: _Work) -> tuple[float, float]:
    alarm = np.zeros(work.runs, dtype=np.bool_)
    for noise in work.bank.paths(work.epochs, work.runs, generator(*work.key)):
        alarm |= (np.abs(noise) > work.bank.threshold[:, None]).any(axis=0)
    return _sums(alarm.astype(np.float64))


def _plain_miss_block(work: _Work) -> tuple[float, float]:
    bank = work.bank
    ramp = work.rate_mps * bank.response(work.epochs)
    alive = np.ones(work.runs, dtype=np.bool_)
    for k, noise in enumerate(bank.paths(work.epochs, work.runs, generator(*work.key))):
        alive &= (np.abs(noise + ramp[k][:, None]) <= bank.threshold[:, None]).all(axis=0)
        if not alive.any():
            break
    return _sums(alive.astype(np.float64))
