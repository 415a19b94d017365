"""Missed detections down to 1e-9 and far below: noise twisted towards the most probable miss, runs split as they go.

A miss is a path of the monitors that stays inside all thresholds although the fault pushes it out. That set is
convex in the noise, so the noise is shifted by its most probable point (the least-norm solution of a small
quadratic programme). Shifting alone fails where many thresholds are near at once: hardly a run survives, and one
lucky weight decides. So the runs are carried as a population (sequential Monte Carlo, Del Moral 2004, section 9.4):
where weights differ too much, those that were lost are replaced by copies of the others. The product of mean weights
is an unbiased estimate for any number of runs; independent populations give its error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from datasets.experiment.linear_bank import LinearBank
from schemas.arrays import Floats, Ints

Step = Callable[[int, Floats], tuple[Floats, Floats]]

_MOST_CONSTRAINTS = 120
# The shifted path stays this many sigmas inside the thresholds: with many constraints at once more runs survive. A slow
# ramp whose mean never comes near a threshold needs more of it, until the shift is worth something.
_MARGINS = (0.4, 1.0, 1.5, 2.0, 2.5)
_LEAST_HALF_SQUARE = 2.0
# Runs are drawn anew where the weights are worth fewer than this share of them.
_LEAST_EFFECTIVE = 0.5


class Shift(NamedTuple):
    """Constraints (epoch, monitor) that hold the noise back, their multipliers, and the shifted mean path."""

    epoch: Ints
    monitor: Ints
    multiplier: Floats
    mean: Floats
    half_square: float


def most_probable_miss(bank: LinearBank, epochs: int, rate_mps: float) -> Shift:
    """Least-norm noise that keeps every monitor below its threshold on the side the ramp pushes to.

    Constraints are added one by one where the path still exceeds; with multipliers l and covariance C of the
    constrained values, the noise of all monitors moves by -C l and its squared norm is l' C l.
    """
    covariances = bank.covariances(epochs)
    for margin in _MARGINS:
        shift = _shift(bank, epochs, rate_mps, margin, covariances)
        if shift.half_square >= _LEAST_HALF_SQUARE:
            break
    return shift


def _shift(bank: LinearBank, epochs: int, rate_mps: float, margin: float, covariances: Floats) -> Shift:
    towards = np.where(bank.slope < 0, -1.0, 1.0)
    ramp, threshold, sigma = rate_mps * bank.response(epochs), bank.thresholds(epochs), bank.sigmas(epochs)
    epoch: list[int] = []
    monitor: list[int] = []
    columns: list[Floats] = []
    mean = np.zeros_like(ramp)
    multiplier = np.zeros(0)
    gram = np.zeros((0, 0))
    for _ in range(_MOST_CONSTRAINTS):
        excess = (towards * (ramp + mean) - threshold) / sigma
        worst = np.unravel_index(int(excess.argmax()), excess.shape)
        if excess[worst] < -0.5 * margin:
            break
        epoch.append(int(worst[0]) + 1)
        monitor.append(int(worst[1]))
        columns.append(towards[worst[1]] * bank.covariance_with(monitor[-1], epoch[-1], covariances))
        at, which = np.array(epoch) - 1, np.array(monitor)
        gram = np.array([(towards[which] * column[at, which]) for column in columns])
        needed = towards[which] * ramp[at, which] - threshold[at, which] + margin * sigma[at, which]
        multiplier = least_norm(gram, needed)
        mean = -np.einsum("c,ckm->km", multiplier, np.array(columns))
    signed = multiplier * towards[np.array(monitor, dtype=np.int64)] if monitor else multiplier
    half = 0.5 * float(multiplier @ gram @ multiplier) if monitor else 0.0
    return Shift(np.array(epoch, dtype=np.int64), np.array(monitor, dtype=np.int64), signed, mean, half)


def least_norm(gram: Floats, needed: Floats) -> Floats:
    """Multipliers l >= 0 of min l' C l / 2 - l' needed."""
    ridge = 1e-10 * float(np.trace(gram))
    factor = np.linalg.cholesky(gram + ridge * np.eye(len(gram)))
    multiplier, _ = nnls(factor.T, np.linalg.solve(factor, needed), maxiter=50 * len(gram))
    return np.asarray(multiplier)


def miss_estimate(
    bank: LinearBank, epochs: int, rate_mps: float, shift: Shift, runs: int, rng: np.random.Generator
) -> float:
    """Unbiased estimate of the probability that no monitor fails at epochs 1 .. n, of one population of `runs`."""
    moved, threshold = shift.mean + rate_mps * bank.response(epochs), bank.thresholds(epochs)

    def step(k: int, state: Floats) -> tuple[Floats, Floats]:
        following = bank.advance @ state
        following += bank.noise @ rng.standard_normal((bank.noise.shape[1], state.shape[1]))
        noise = following[bank.sources :]
        inside = (np.abs(noise + moved[k][:, None]) <= threshold[k][:, None]).all(axis=0)
        weight = np.where(inside, 0.0, -np.inf)
        # Density of the true noise over that of the shifted one: exp(l' m - l' C l / 2), m the noise at constraints.
        for index in np.flatnonzero(shift.epoch == k + 1):
            weight += shift.multiplier[index] * noise[shift.monitor[index]]
        return following, weight

    return float(np.exp(log_survival(bank.start(runs, rng), step, epochs, rng) - shift.half_square))


def log_survival(state: Floats, step: Step, epochs: int, rng: np.random.Generator) -> float:
    """Logarithm of the mean product of weights over the epochs; -inf where no run is left.

    `state` (states, runs); `step(k, state)` moves all runs to epoch k (from 0) and gives the logarithms of their
    weights there.
    """
    runs = state.shape[1]
    total, weight = 0.0, np.zeros(runs)
    for k in range(epochs):
        state, change = step(k, state)
        if not change.any():
            continue
        weight += change
        greatest = float(weight.max())
        if greatest == -np.inf:
            return greatest
        shares = np.exp(weight - greatest)
        if shares.sum() ** 2 < _LEAST_EFFECTIVE * runs * (shares @ shares):
            total += greatest + float(np.log(shares.mean()))
            state, weight = state[:, _copies(shares, rng)], np.zeros(runs)
    greatest = float(weight.max())
    return total + greatest + float(np.log(np.exp(weight - greatest).mean()))


def _copies(shares: Floats, rng: np.random.Generator) -> Ints:
    """Systematic resampling: which run each of the next ones continues, in proportion to the shares."""
    ends = np.cumsum(shares) / shares.sum()
    places = (np.arange(shares.size) + rng.random()) / shares.size
    return np.asarray(np.searchsorted(ends, places).clip(max=shares.size - 1))
