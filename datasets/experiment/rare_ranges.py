"""The pseudorange monitor where counting cannot reach: misses of a ramp, and alarms of healthy ranges.

Its value is |z|^2 of a Gaussian vector z (the whitened residuals): one Gauss-Markov vector per error source, and the
survey's error, which stays. A miss is a path of z + ramp that stays inside a ball, which is convex again, so the same
twisted population serves (`splitting`). Alarms: an exceedance is forced at an epoch drawn at random, as in `rare`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy.special import chdtr, chdtri

from datasets.experiment.geometry import TAUS_S
from datasets.experiment.ranges import RangePlan, held_rows, statistic
from datasets.experiment.splitting import Limits
from schemas.arrays import Bools, Floats
from schemas.frozen import frozen


@frozen
class RangeSystem:
    """Whitened residuals z of a fixed sky and heading, in d dimensions, as a `System`.

    `covariance` (sources, d, d): by error source, `survey` (d, d) that of the survey; together the identity.
    `phi` (sources,): decorrelation from one recorded epoch to the next. `metre` (d,): of one metre of range error.
    """

    covariance: Floats
    survey: Floats
    phi: Floats
    metre: Floats
    threshold: float
    period_s: float

    streams: ClassVar[tuple[int, int]] = (37, 35)
    margins: ClassVar[tuple[float, ...]] = (0.4,)
    runs_per_block: ClassVar[int] = 100

    @property
    def size(self) -> int:
        return int(self.metre.size)

    def by_lag(self, epochs: int) -> Floats:
        share = self.phi[None, :] ** np.abs(np.arange(-epochs + 1, epochs))[:, None]
        return np.asarray(np.einsum("ls,sij->lij", share, self.covariance) + self.survey)

    def start(self, runs: int, rng: np.random.Generator) -> Floats:
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

    def ramp(self, epochs: int, rate_mps: float) -> Floats:
        return np.asarray((rate_mps * self.period_s * np.arange(1, epochs + 1))[:, None] * self.metre)

    def limits(self, epochs: int, rate_mps: float) -> Limits:
        """Along the ramp alone: what the other directions take of the ball on average is not there for it."""
        radius = np.sqrt(max(self.threshold - (self.size - 1), 1.0))
        one = np.ones((epochs, 1))
        return Limits(self.seen(self.ramp(epochs, rate_mps)), radius * one, one, np.ones(1))

    def seen(self, values: Floats) -> Floats:
        return np.asarray(values @ self._along)[..., None]

    @cached_property
    def _along(self) -> Floats:
        return np.asarray(self.metre / np.sqrt(self.metre @ self.metre))

    def towards_limit(self, epochs: int) -> Callable[[int, int], Floats]:
        towards = self.by_lag(epochs) @ self._along
        return lambda _, epoch: np.asarray(towards[epochs - epoch : 2 * epochs - epoch])

    def passing(self, epochs: int) -> Callable[[int, Floats], Bools]:
        return lambda _, values: np.asarray(np.square(values).sum(axis=0) <= self.threshold)

    def forced(self, values: Floats, rng: np.random.Generator) -> tuple[Floats, float]:
        """|z|^2 beyond the threshold by inversion of the tail; the direction of a healthy z is uniform."""
        probability = float(1.0 - chdtr(self.size, self.threshold))
        radius = np.sqrt(chdtri(self.size, probability * rng.random(len(values))))
        direction = rng.standard_normal((self.size, len(values)))
        return (radius * direction / np.sqrt(np.square(direction).sum(axis=0))).T - values, probability

    def fails(self, path: Floats) -> int:
        return int((np.square(path).sum(axis=1) > self.threshold).sum())


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
    metre = one.project[:, plan.geometry.faulty]
    return RangeSystem(covariance, held @ held.T, np.exp(-plan.period_s / TAUS_S), metre, one.threshold, plan.period_s)


def miss_at_one_epoch(system: RangeSystem, range_error_m: float) -> float:
    """Probability that one epoch with this range error passes: exact, and above that of all epochs before it."""
    from scipy.stats import ncx2  # takes half a second to load

    strength = range_error_m**2 * float(system.metre @ system.metre)
    return float(ncx2.cdf(system.threshold, system.size, strength))
