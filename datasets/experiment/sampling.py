"""Probabilities down to 1e-9 and far below, of any linear Gaussian system: false alarms and missed detections.

False alarm within a horizon (Adler, Blanchet and Liu 2012): an exceedance is forced at a monitor and epoch drawn
at random, the rest of the path follows by conditioning, and the expected number of exceedances over the number seen is
an unbiased estimate of the probability of at least one.

Missed detection: a path of the monitors that stays inside all thresholds although the fault pushes it out. That set is
convex in the noise, so the noise is shifted by its most probable point (the least-norm solution of a small
quadratic programme). Shifting alone fails where many thresholds are near at once: hardly a run survives, and one
lucky weight decides. So the runs are carried as a population (sequential Monte Carlo, Del Moral 2004, section 9.4):
where weights differ too much, those that were lost are replaced by copies of the others. The product of mean weights
is an unbiased estimate for any number of runs; independent populations give its error.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from math import isfinite
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from scipy.optimize import nnls

from datasets.experiment.tables import Row
from datasets.experiment.workers import in_pieces
from schemas.arrays import Bools, Floats, Ints

Step = Callable[[int, Floats], tuple[Floats, Floats]]

# Paths of all monitors must fit into some 64 MB.
_LARGEST_BLOCK = 8_000_000
# Independent populations of a split estimate: their scatter is its error.
_POPULATIONS = 20
_SMALLEST_POPULATION, _LARGEST_POPULATION = 250, 1_000
_CLOSE_ENOUGH = 0.02
SMALLEST = 1e-12
"""No probability smaller than this is given, only that it is below."""
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

    def draw_start(self, runs: int, rng: np.random.Generator) -> Floats:
        """States at the fault's onset, (states, runs)."""

    def draw_next(self, state: Floats, rng: np.random.Generator) -> Floats:
        """States at the next epoch."""

    def values(self, state: Floats) -> Floats:
        """What the monitors see of the states, (values, runs)."""

    def ramp(self, epochs: int, rate_mps: float) -> Floats:
        """What a range ramp adds to the values at epochs 1 .. n, (epochs, values)."""

    def limits(self, epochs: int, rate_mps: float) -> Limits:
        """Half-spaces around all values without a fail."""

    def on_limits(self, values: Floats) -> Floats:
        """What each limit bounds, of `values` (..., values): (..., limits)."""

    def towards_limit(self, epochs: int) -> Callable[[int, int], Floats]:
        """Covariance of the values at epochs 1 .. n with a limit at an epoch (from 1), (epochs, values)."""

    def passing(self, epochs: int) -> Callable[[int, Floats], Bools]:
        """Which runs pass at epoch k (from 0) with these values (values, runs)."""

    def covariance_by_lag(self, epochs: int) -> Floats:
        """Covariance of value j at epoch k + lag with value i at k, lags -(n-1) .. n-1; (lags, i, j)."""

    def force_fail(self, values: Floats, rng: np.random.Generator) -> tuple[Floats, float]:
        """What, times the covariance, brings each run's values (runs, values) to a fail drawn at random, and how many
        fails an epoch has on average.
        """

    def count_fails(self, path: Floats) -> int:
        """Fails of one run, (epochs, values)."""


def matrix_root(covariance: Floats) -> Floats:
    """A matrix R with R R' = `covariance` (n, n), which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


class Probability(NamedTuple):
    """An estimate with its relative standard error, and how many plain runs it is worth per run made."""

    value: float
    relative_error: float
    variance_reduction: float
    runs: int


def false_alarm_probability(system: System, epochs: int, runs: int = 4000, seed: int = 1, jobs: int = 1) -> Probability:
    """Probability that healthy monitors, long after their restart, fail at least once in this many epochs.

    `runs`: sampled paths. Raises `ValueError` for a bank whose restart is not long ago.
    """
    # Small enough for one thread of the linear algebra library, whose threads would cost more than they bring.
    size = max(1, min(system.runs_per_block, _LARGEST_BLOCK // (epochs * system.size)))
    alarms = partial(_alarm_estimates, system, epochs)
    return pool_estimates(np.concatenate(in_pieces(alarms, runs, size, (seed, system.streams[0]), jobs)), runs)


def missed_detection_probability(
    system: System, epochs: int, rate_mps: float, runs: int = 20_000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that no monitor fails at epochs 1 .. n of a range ramp of `rate_mps`; `runs`: sampled paths."""
    miss = partial(miss_estimate, system, epochs, rate_mps, most_probable_miss(system, epochs, rate_mps))
    return pool_estimates(np.array(in_pieces(miss, runs, population_size(runs), (seed, system.streams[1]), jobs)), runs)


def population_size(runs: int) -> int:
    """Size of the independent populations that share the runs; too small ones would lose all of theirs."""
    return min(max(runs // _POPULATIONS, _SMALLEST_POPULATION), _LARGEST_POPULATION)


def pool_estimates(estimates: Floats, runs: int) -> Probability:
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


def _alarm_estimates(system: System, epochs: int, runs: int, rng: np.random.Generator) -> Floats:
    """Estimates of the probability of an alarm, one for each of the sampled runs."""
    # Stationary: the covariance depends on the lag alone, and lag zero is in the middle.
    by_lag = system.covariance_by_lag(epochs)
    paths = np.empty((epochs, system.size, runs))
    state = system.draw_start(runs, rng)
    for path in paths:
        state = system.draw_next(state, rng)
        path[:] = system.values(state)
    at = rng.integers(0, epochs, runs)
    pulls, per_epoch = system.force_fail(paths[at, :, np.arange(runs)], rng)
    estimates = np.empty(runs)
    for run, (place, pull) in enumerate(zip(at, pulls, strict=True)):
        pulled = np.flatnonzero(pull)
        together = by_lag[epochs - 1 - place : 2 * epochs - 1 - place, pulled]
        # The forced one counts, whatever rounding does to it.
        count = max(system.count_fails(paths[:, :, run] + pull[pulled] @ together), 1)
        estimates[run] = epochs * per_epoch / count
    return estimates


def probability_figures(result: Probability) -> Row:
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
    """Epochs after which a falling probability is is_below each target, within 2 %; None if that takes too many.

    Few runs per step do: time is found far better than probability, which falls steeply. An estimate of zero, all
    runs lost, says nothing and counts as not is_below.
    """
    known: dict[int, float] = {}

    def is_below(epochs: int, target: float) -> bool:
        """Whether the probability after so many epochs is is_below a target, and not an estimate of zero."""
        if epochs not in known:
            known[epochs] = probability(epochs)
        return 0.0 < known[epochs] < target

    return [_bisect_epochs(is_below, target, most_epochs) for target in targets]


def _bisect_epochs(below: Callable[[int, float], bool], target: float, most_epochs: int) -> int | None:
    """Epochs after which a falling probability is below the target, by doubling and halving; None if too many."""
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


def most_probable_miss(system: System, epochs: int, rate_mps: float) -> MeanShift:
    """Least-norm noise that keeps the values within every limit on the side that the ramp pushes to.

    Constraints are added one by one where the path still exceeds; with multipliers l and covariance C of the
    constrained values, the noise of all values moves by -C l and its squared norm is l' C l.
    """
    towards_limit = system.towards_limit(epochs)
    limits = system.limits(epochs, rate_mps)
    for margin in system.margins:
        shift = _shift_with_margin(system, limits, margin, towards_limit)
        if shift.half_square >= _LEAST_HALF_SQUARE:
            break
    return shift


def _shift_with_margin(
    system: System, limits: Limits, margin: float, towards_limit: Callable[[int, int], Floats]
) -> MeanShift:
    """The shift whose path stays within every limit, but for a share of the margin."""
    ramp, threshold, sigma, towards = limits
    epoch: list[int] = []
    limit: list[int] = []
    columns: list[Floats] = []
    mean = np.zeros((len(ramp), system.size))
    multiplier = np.zeros(0)
    gram = np.zeros((0, 0))
    for _ in range(_MOST_CONSTRAINTS):
        excess = (towards * (ramp + system.on_limits(mean)) - threshold) / sigma
        worst = np.unravel_index(int(excess.argmax()), excess.shape)
        if excess[worst] < -0.5 * margin:
            break
        epoch.append(int(worst[0]) + 1)
        limit.append(int(worst[1]))
        columns.append(towards[worst[1]] * towards_limit(limit[-1], epoch[-1]))
        at = np.array(epoch) - 1
        which = np.array(limit)
        gram = np.array([(towards[which] * system.on_limits(column)[at, which]) for column in columns])
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

    def shifted_step(k: int, state: Floats) -> tuple[Floats, Floats]:
        """States at epoch k under the shift, and the logarithms of their weights."""
        following = system.draw_next(state, rng)
        noise = system.values(following)
        weight = np.where(passing(k, noise + moved[k][:, None]), 0.0, -np.inf)
        # Density of the true noise over that of the shifted one: exp(l' m - l' C l / 2), m the noise at constraints.
        for index in np.flatnonzero(shift.epoch == k + 1):
            weight += shift.multiplier[index] * system.on_limits(noise.T)[:, shift.limit[index]]
        return following, weight

    return float(np.exp(log_survival(system.draw_start(runs, rng), shifted_step, epochs, rng) - shift.half_square))


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
            state = state[:, _resample(shares, rng)]
            weight = np.zeros(runs)
    greatest = float(weight.max())
    return total + greatest + float(np.log(np.exp(weight - greatest).mean()))


def _resample(shares: Floats, rng: np.random.Generator) -> Ints:
    """Systematic resampling: which run each of the next ones continues, in proportion to the shares."""
    ends = np.cumsum(shares) / shares.sum()
    places = (np.arange(shares.size) + rng.random()) / shares.size
    return np.asarray(np.searchsorted(ends, places).clip(max=shares.size - 1))
