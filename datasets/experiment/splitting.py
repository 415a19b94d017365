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
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from scipy.optimize import nnls

from schemas.arrays import Bools, Floats, Ints

Step = Callable[[int, Floats], tuple[Floats, Floats]]

_MOST_CONSTRAINTS = 120
# The shifted path stays so many sigmas (`System.margins`) inside the limits: with many constraints at once more runs
# survive. A slow ramp whose mean never comes near a limit needs more of it, until the shift is worth something.
_LEAST_HALF_SQUARE = 2.0
# Runs are drawn anew where the weights are worth fewer than this share of them.
_LEAST_EFFECTIVE = 0.5


class MeanShift(NamedTuple):
    """Constraints (epoch, limit) on the noise, their multipliers, and the shifted mean path of the values."""

    epoch: Ints
    limit: Ints
    multiplier: Floats
    mean: Floats
    half_square: float


class Limits(NamedTuple):
    """What holds the ramp back, each (epochs, limits): its own size there, the threshold, and sigma of the noise.

    `towards` (limits,): +1 or -1, the side that the ramp pushes to.
    """

    ramp: Floats
    threshold: Floats
    sigma: Floats
    towards: Floats


class System(Protocol):
    """Linear and Gaussian: states that follow each other, and the values that the monitors see of them.

    `streams`: numbers of the random streams for alarms and misses. `margins`: see `most_probable_miss`.
    """

    streams: ClassVar[tuple[int, int]]
    margins: ClassVar[tuple[float, ...]]
    runs_per_block: ClassVar[int]

    @property
    def size(self) -> int:
        """How many values there are."""

    def start(self, runs: int, rng: np.random.Generator) -> Floats:
        """States at the fault's onset, (states, runs)."""

    def following(self, state: Floats, rng: np.random.Generator) -> Floats:
        """States at the next epoch."""

    def values(self, state: Floats) -> Floats:
        """(values, runs)."""

    def ramp(self, epochs: int, rate_mps: float) -> Floats:
        """What a range ramp adds to the values at epochs 1 .. n, (epochs, values)."""

    def limits(self, epochs: int, rate_mps: float) -> Limits:
        """Half-spaces around all values without a fail."""

    def seen(self, values: Floats) -> Floats:
        """Of (..., values) what the limits hold, (..., limits)."""

    def towards_limit(self, epochs: int) -> Callable[[int, int], Floats]:
        """Covariance of the values at epochs 1 .. n with a limit at an epoch (from 1), (epochs, values)."""

    def passing(self, epochs: int) -> Callable[[int, Floats], Bools]:
        """Which runs pass at epoch k (from 0) with these values (values, runs)."""

    def by_lag(self, epochs: int) -> Floats:
        """Covariance of value j at epoch k + lag with value i at k, lags -(n-1) .. n-1; (lags, i, j)."""

    def forced(self, values: Floats, rng: np.random.Generator) -> tuple[Floats, float]:
        """What, times the covariance, brings each run's values (runs, values) to a fail drawn at random, and how many
        fails an epoch has on average.
        """

    def fails(self, path: Floats) -> int:
        """Fails of one run, (epochs, values)."""


def most_probable_miss(system: System, epochs: int, rate_mps: float) -> MeanShift:
    """Least-norm noise that keeps the values within every limit on the side that the ramp pushes to.

    Constraints are added one by one where the path still exceeds; with multipliers l and covariance C of the
    constrained values, the noise of all values moves by -C l and its squared norm is l' C l.
    """
    towards_limit = system.towards_limit(epochs)
    limits = system.limits(epochs, rate_mps)
    for margin in system.margins:
        shift = _shift(system, limits, margin, towards_limit)
        if shift.half_square >= _LEAST_HALF_SQUARE:
            break
    return shift


def _shift(system: System, limits: Limits, margin: float, towards_limit: Callable[[int, int], Floats]) -> MeanShift:
    ramp, threshold, sigma, towards = limits
    epoch: list[int] = []
    limit: list[int] = []
    columns: list[Floats] = []
    mean = np.zeros((len(ramp), system.size))
    multiplier = np.zeros(0)
    gram = np.zeros((0, 0))
    for _ in range(_MOST_CONSTRAINTS):
        excess = (towards * (ramp + system.seen(mean)) - threshold) / sigma
        worst = np.unravel_index(int(excess.argmax()), excess.shape)
        if excess[worst] < -0.5 * margin:
            break
        epoch.append(int(worst[0]) + 1)
        limit.append(int(worst[1]))
        columns.append(towards[worst[1]] * towards_limit(limit[-1], epoch[-1]))
        at = np.array(epoch) - 1
        which = np.array(limit)
        gram = np.array([(towards[which] * system.seen(column)[at, which]) for column in columns])
        needed = towards[which] * ramp[at, which] - threshold[at, which] + margin * sigma[at, which]
        multiplier = least_norm(gram, needed)
        mean = -np.einsum("c,ckm->km", multiplier, np.array(columns))
    signed = multiplier * towards[np.array(limit, dtype=np.int64)] if limit else multiplier
    half = 0.5 * float(multiplier @ gram @ multiplier) if limit else 0.0
    return MeanShift(np.array(epoch, dtype=np.int64), np.array(limit, dtype=np.int64), signed, mean, half)


def least_norm(gram: Floats, needed: Floats) -> Floats:
    """Multipliers l >= 0 of min l' C l / 2 - l' needed."""
    ridge = 1e-10 * float(np.trace(gram))
    factor = np.linalg.cholesky(gram + ridge * np.eye(len(gram)))
    multiplier, _ = nnls(factor.T, np.linalg.solve(factor, needed), maxiter=50 * len(gram))
    return np.asarray(multiplier)


def miss_estimate(
    system: System, epochs: int, rate_mps: float, shift: MeanShift, runs: int, rng: np.random.Generator
) -> float:
    """Unbiased estimate of the probability that no monitor fails at epochs 1 .. n, of one population of `runs`."""
    moved = shift.mean + system.ramp(epochs, rate_mps)
    passing = system.passing(epochs)

    def step(k: int, state: Floats) -> tuple[Floats, Floats]:
        following = system.following(state, rng)
        noise = system.values(following)
        weight = np.where(passing(k, noise + moved[k][:, None]), 0.0, -np.inf)
        # Density of the true noise over that of the shifted one: exp(l' m - l' C l / 2), m the noise at constraints.
        for index in np.flatnonzero(shift.epoch == k + 1):
            weight += shift.multiplier[index] * system.seen(noise.T)[:, shift.limit[index]]
        return following, weight

    return float(np.exp(log_survival(system.start(runs, rng), step, epochs, rng) - shift.half_square))


def log_survival(state: Floats, step: Step, epochs: int, rng: np.random.Generator) -> float:
    """Logarithm of the mean product of weights over the epochs; -inf where no run is left.

    `state` (states, runs); `step(k, state)` moves all runs to epoch k (from 0) and gives the logarithms of their
    weights there.
    """
    runs = state.shape[1]
    total = 0.0
    weight = np.zeros(runs)
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
            state = state[:, _copies(shares, rng)]
            weight = np.zeros(runs)
    greatest = float(weight.max())
    return total + greatest + float(np.log(np.exp(weight - greatest).mean()))


def _copies(shares: Floats, rng: np.random.Generator) -> Ints:
    """Systematic resampling: which run each of the next ones continues, in proportion to the shares."""
    ends = np.cumsum(shares) / shares.sum()
    places = (np.arange(shares.size) + rng.random()) / shares.size
    return np.asarray(np.searchsorted(ends, places).clip(max=shares.size - 1))
