"""The pseudorange monitor where counting cannot reach: misses of a ramp, and alarms of healthy ranges.

Its value is |z|^2 of a Gaussian vector z (the whitened residuals): one Gauss-Markov vector per error source, and the
survey's error, which stays. A miss is a path of z + ramp that stays inside a ball, which is convex again, so the same
twisted population serves (`splitting`). Alarms: an exceedance is forced at an epoch drawn at random, as in `rare`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import chdtr, chdtri
from scipy.stats import ncx2

from datasets.experiment.geometry import TAUS_S
from datasets.experiment.ranges import RangePlan, held_rows, statistic
from datasets.experiment.rare import Probability, pooled, populations
from datasets.experiment.splitting import least_norm, log_survival
from datasets.experiment.workers import generator, in_blocks
from schemas.arrays import Floats

_MOST_CONSTRAINTS = 60
_MARGIN = 0.4
_RUNS_PER_BLOCK = 100


@dataclass(frozen=True)
class RangeSystem:
    """Whitened residuals z of a fixed sky and heading, in d dimensions.

    `covariance` (sources, d, d): by error source, `survey` (d, d) that of the survey; together the identity.
    `phi` (sources,): decorrelation from one recorded epoch to the next. `ramp` (d,): of one metre of range error.
    """

    covariance: Floats
    survey: Floats
    phi: Floats
    ramp: Floats
    threshold: float
    period_s: float

    @property
    def size(self) -> int:
        return int(self.ramp.size)

    def by_lag(self, lags: npt.NDArray[np.int64]) -> Floats:
        """Covariance of z between epochs so far apart, (lags, d, d)."""
        share = self.phi[None, :] ** np.abs(lags)[:, None]
        return np.asarray(np.einsum("ls,sij->lij", share, self.covariance) + self.survey)

    def paths_start(self, runs: int, rng: np.random.Generator) -> Floats:
        """States at the onset: sources, then the survey, d rows each; (states, runs)."""
        parts = [_root(one) @ rng.standard_normal((self.size, runs)) for one in (*self.covariance, self.survey)]
        return np.concatenate(parts)

    def following(self, state: Floats, rng: np.random.Generator) -> Floats:
        """States at the next recorded epoch."""
        sources = len(self.phi)
        moving = state.reshape(sources + 1, self.size, -1).copy()
        fresh = rng.standard_normal((sources, self.size, state.shape[1]))
        moving[:sources] = self.phi[:, None, None] * moving[:sources] + self._push @ fresh
        result: Floats = moving.reshape(state.shape)
        return result

    @cached_property
    def _push(self) -> Floats:
        push: Floats = np.sqrt(1.0 - self.phi**2)[:, None, None] * np.array([_root(one) for one in self.covariance])
        return push

    def values(self, state: Floats) -> Floats:
        """Whitened residuals of each run, (d, runs)."""
        return np.asarray(state.reshape(-1, self.size, state.shape[1]).sum(axis=0))

    def ramp_m(self, epochs: int, rate_mps: float) -> Floats:
        """Range error at epochs 1 .. n of a ramp that begins at 0 s [m]."""
        return np.asarray(rate_mps * self.period_s * np.arange(1, epochs + 1))


def _root(covariance: Floats) -> Floats:
    """A matrix with this covariance, which may be singular (the survey's has two dimensions)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def range_system(plan: RangePlan, heading_deg: float) -> RangeSystem:
    """The monitor of a plan at a heading, as `ranges.statistic` has it."""
    one = statistic(plan, heading_deg)
    scaled = one.project[:, None, :] * np.sqrt(plan.geometry.range_variance_m2).T[None]
    covariance = np.einsum("asn,bsn->sab", scaled, scaled)
    held = plan.survey_m * one.project @ held_rows(plan, heading_deg)
    ramp = one.project[:, plan.geometry.faulty]
    return RangeSystem(covariance, held @ held.T, np.exp(-plan.period_s / TAUS_S), ramp, one.threshold, plan.period_s)


def miss_at_one_epoch(system: RangeSystem, range_error_m: float) -> float:
    """Probability that one epoch with this range error passes: exact, and above that of all epochs before it."""
    strength = range_error_m**2 * float(system.ramp @ system.ramp)
    return float(ncx2.cdf(system.threshold, system.size, strength))


@dataclass(frozen=True)
class _Work:
    system: RangeSystem
    epochs: int
    rate_mps: float
    key: tuple[int, ...]
    runs: int


def missed_by_ranges(
    system: RangeSystem, epochs: int, rate_mps: float, runs: int = 20_000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that the monitor passes at all recorded epochs 1 .. n of a range ramp."""
    works = [_Work(system, epochs, rate_mps, (seed, 35, number), size) for number, size in enumerate(populations(runs))]
    return pooled(_miss_block, works, runs, jobs)


def false_alarm_by_ranges(
    system: RangeSystem, epochs: int, runs: int = 2_000, seed: int = 1, jobs: int = 1
) -> Probability:
    """Probability that healthy ranges alarm at least once in this many recorded epochs."""
    sizes = in_blocks(runs, _RUNS_PER_BLOCK)
    works = [_Work(system, epochs, 0.0, (seed, 37, number), size) for number, size in enumerate(sizes)]
    return pooled(_alarm_block, works, runs, jobs)


def _most_probable(system: RangeSystem, epochs: int, rate_mps: float) -> tuple[Floats, Floats, float]:
    """Multiplier at each epoch of z along the ramp, the shifted mean path (epochs, d), half the squared norm."""
    strength = float(np.sqrt(system.ramp @ system.ramp))
    along = system.ramp / strength
    ramp = strength * system.ramp_m(epochs, rate_mps)
    # What the other directions take of the ball on average is not there for the ramp.
    limit = np.sqrt(max(system.threshold - (system.size - 1), 1.0)) - _MARGIN
    towards = system.by_lag(np.arange(-epochs + 1, epochs)) @ along
    scalar = towards @ along
    chosen: list[int] = []
    multiplier, mean = np.zeros(0), np.zeros((epochs, system.size))
    gram = np.zeros((0, 0))
    for _ in range(_MOST_CONSTRAINTS):
        excess = ramp + mean @ along - limit
        worst = int(excess.argmax())
        if excess[worst] < 0.5 * _MARGIN:
            break
        chosen.append(worst)
        at = np.array(chosen)
        gram = scalar[at[:, None] - at[None, :] + epochs - 1]
        multiplier = least_norm(gram, ramp[at] - limit)
        mean = -np.sum(
            [x * towards[epochs - 1 - k : 2 * epochs - 1 - k] for x, k in zip(multiplier, chosen, strict=True)], axis=0
        )
    each = np.zeros(epochs)
    if chosen:
        each[np.array(chosen)] = multiplier
    return each, np.asarray(mean), 0.5 * float(multiplier @ gram @ multiplier) if chosen else 0.0


def _miss_block(work: _Work) -> Floats:
    system, rng = work.system, generator(*work.key)
    multiplier, mean, half = _most_probable(system, work.epochs, work.rate_mps)
    along = system.ramp / np.sqrt(system.ramp @ system.ramp)
    moved = mean + system.ramp_m(work.epochs, work.rate_mps)[:, None] * system.ramp

    def step(k: int, state: Floats) -> tuple[Floats, Floats]:
        following = system.following(state, rng)
        z = system.values(following)
        inside = np.square(z + moved[k][:, None]).sum(axis=0) <= system.threshold
        return following, np.where(inside, multiplier[k] * (along @ z), -np.inf)

    start = system.paths_start(work.runs, rng)
    return np.array([np.exp(log_survival(start, step, work.epochs, rng) - half)])


def _alarm_block(work: _Work) -> Floats:
    system, rng = work.system, generator(*work.key)
    z = np.empty((work.epochs, system.size, work.runs))
    state = system.paths_start(work.runs, rng)
    for k in range(work.epochs):
        state = system.following(state, rng)
        z[k] = system.values(state)
    at = rng.integers(0, work.epochs, work.runs)
    probability = float(1.0 - chdtr(system.size, system.threshold))
    # |z|^2 beyond the threshold by inversion of the tail; the direction of a healthy z is uniform.
    radius = np.sqrt(chdtri(system.size, probability * rng.random(work.runs)))
    direction = rng.standard_normal((system.size, work.runs))
    forced = radius * direction / np.sqrt(np.square(direction).sum(axis=0))
    together = system.by_lag(np.arange(-work.epochs + 1, work.epochs))
    estimates = np.empty(work.runs)
    for run, place in enumerate(at):
        lacking = forced[:, run] - z[place, :, run]
        moved = z[:, :, run] + together[work.epochs - 1 - place : 2 * work.epochs - 1 - place] @ lacking
        count = int((np.square(moved).sum(axis=1) > system.threshold).sum())
        estimates[run] = work.epochs * probability / max(count, 1)
    return estimates
