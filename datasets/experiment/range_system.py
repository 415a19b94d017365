"""The pseudorange monitor as a `System`: misses of a ramp, and alarms of healthy ranges, where counting cannot reach.

Range errors are those of each satellite (DIAG Table 1); the train is held on its surveyed track, whose error is
constant in a run. Residuals may be recorded more slowly than positions: the monitor then looks at these epochs only.
Its value is |z|^2 of a Gaussian vector z (the whitened residuals): one Gauss-Markov vector per error source, and the
survey's error, which stays. A miss is a path of z + ramp that stays inside a ball, which is convex again, so the same
twisted population serves (`sampling`). Alarms: an exceedance is forced at an epoch drawn at random.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.special import chdtr, chdtri

from datasets.experiment.geometry import TAUS_S, Geometry
from datasets.experiment.sampling import Limits, matrix_root
from pipeline.stages.monitors.pseudorange import clock_columns, line_of_sight_rows
from schemas.arrays import Bools, Floats
from schemas.frozen import frozen


@frozen
class RangePlan:
    """A sky and the monitor's setting: `period_s` between recorded residuals, `survey_m` sigma of the track survey."""

    geometry: Geometry
    period_s: float = 1.0
    survey_m: float = 1.0
    failure_limit_m: float = 20.0
    false_alarm_probability: float = 1e-7

    def mean_failure_s(self, heading_deg: float, rate_mps: float) -> float:
        """When the mean error along the track of a ramp passes the limit [s]; infinite where it never does."""
        slope = abs(float(self.geometry.axes(heading_deg)[0] @ self.geometry.ramp_direction)) * rate_mps
        return self.failure_limit_m / slope if slope > 0 else float("inf")


class Statistic(NamedTuple):
    """`value = |project @ r|^2` of range errors r, chi-square with `project.shape[0]` degrees of freedom."""

    project: Floats
    threshold: float


def monitor_statistic(plan: RangePlan, heading_deg: float) -> Statistic:
    """The monitor of `pipeline.stages.monitors.pseudorange` for a fixed sky and heading, as one projection.

    Ranges have covariance V = diag(sigma^2) + survey^2 (g_c g_c' + g_u g_u'); along and clocks are free.
    """
    geometry = plan.geometry
    rows = line_of_sight_rows(geometry.azimuth_deg, geometry.elevation_deg)
    axes = geometry.axes(heading_deg)
    held = survey_rows(plan, heading_deg)
    covariance = np.diag(geometry.range_variance_m2.sum(axis=1)) + plan.survey_m**2 * held @ held.T
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    free = whiten @ np.column_stack([rows @ axes[0], clock_columns(geometry.svs)])
    basis, _ = np.linalg.qr(free, mode="complete")
    kept = basis[:, free.shape[1] :].T
    return Statistic(kept @ whiten, float(chdtri(kept.shape[0], plan.false_alarm_probability)))


def survey_rows(plan: RangePlan, heading_deg: float) -> Floats:
    """Range change per metre of survey error across and in height, shape (satellites, 2)."""
    rows = line_of_sight_rows(plan.geometry.azimuth_deg, plan.geometry.elevation_deg)
    return np.asarray(rows @ plan.geometry.axes(heading_deg)[1:].T)


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
        """Dimensions of the whitened residuals."""
        return int(self.metre.size)

    def covariance_by_lag(self, epochs: int) -> Floats:
        """Covariance of residual j at epoch k + lag with residual i at k; (lags, i, j)."""
        share = self.phi[None, :] ** np.abs(np.arange(-epochs + 1, epochs))[:, None]
        return np.asarray(np.einsum("ls,sij->lij", share, self.covariance) + self.survey)

    def draw_start(self, runs: int, rng: np.random.Generator) -> Floats:
        """States at the onset: sources, then the survey, d rows each; (states, runs)."""
        parts = [matrix_root(one) @ rng.standard_normal((self.size, runs)) for one in (*self.covariance, self.survey)]
        return np.concatenate(parts)

    def draw_next(self, state: Floats, rng: np.random.Generator) -> Floats:
        """States at the next epoch; the survey's error stays."""
        sources = len(self.phi)
        moving = state.reshape(sources + 1, self.size, -1).copy()
        fresh = rng.standard_normal((sources, self.size, state.shape[1]))
        moving[:sources] = self.phi[:, None, None] * moving[:sources] + self._driving_matrices @ fresh
        result: Floats = moving.reshape(state.shape)
        return result

    @cached_property
    def _driving_matrices(self) -> Floats:
        """What turns normals into the change of each source over an epoch, (sources, d, d)."""
        push: Floats = np.sqrt(1.0 - self.phi**2)[:, None, None] * np.array(
            [matrix_root(one) for one in self.covariance]
        )
        return push

    def values(self, state: Floats) -> Floats:
        """Whitened residuals of each run, (d, runs)."""
        return np.asarray(state.reshape(-1, self.size, state.shape[1]).sum(axis=0))

    def ramp(self, epochs: int, rate_mps: float) -> Floats:
        """What a range ramp adds to the residuals at epochs 1 .. n, (epochs, d)."""
        return np.asarray((rate_mps * self.period_s * np.arange(1, epochs + 1))[:, None] * self.metre)

    def limits(self, epochs: int, rate_mps: float) -> Limits:
        """Along the ramp alone: what the other directions take of the ball on average is not there for it."""
        radius = np.sqrt(max(self.threshold - (self.size - 1), 1.0))
        one = np.ones((epochs, 1))
        return Limits(self.on_limits(self.ramp(epochs, rate_mps)), radius * one, one, np.ones(1))

    def on_limits(self, values: Floats) -> Floats:
        """The component of the residuals along the ramp."""
        return np.asarray(values @ self._ramp_direction)[..., None]

    @cached_property
    def _ramp_direction(self) -> Floats:
        """Unit vector of the ramp among the residuals, (d,)."""
        return np.asarray(self.metre / np.sqrt(self.metre @ self.metre))

    def towards_limit(self, epochs: int) -> Callable[[int, int], Floats]:
        """Covariance of the residuals with the limit at an epoch, as a function of both."""
        towards = self.covariance_by_lag(epochs) @ self._ramp_direction
        return lambda _, epoch: np.asarray(towards[epochs - epoch : 2 * epochs - epoch])

    def passing(self, epochs: int) -> Callable[[int, Floats], Bools]:
        """Whether each run passes with its residuals: |z|^2 is within the threshold."""
        return lambda _, values: np.asarray(np.square(values).sum(axis=0) <= self.threshold)

    def force_fail(self, values: Floats, rng: np.random.Generator) -> tuple[Floats, float]:
        """|z|^2 beyond the threshold by inversion of the tail; the direction of a healthy z is uniform."""
        probability = float(1.0 - chdtr(self.size, self.threshold))
        radius = np.sqrt(chdtri(self.size, probability * rng.random(len(values))))
        direction = rng.standard_normal((self.size, len(values)))
        return (radius * direction / np.sqrt(np.square(direction).sum(axis=0))).T - values, probability

    def count_fails(self, path: Floats) -> int:
        """Fails of one run, (epochs, d)."""
        return int((np.square(path).sum(axis=1) > self.threshold).sum())


def range_system(plan: RangePlan, heading_deg: float) -> RangeSystem:
    """The monitor of a plan at a heading, as `monitor_statistic` has it."""
    one = monitor_statistic(plan, heading_deg)
    scaled = one.project[:, None, :] * np.sqrt(plan.geometry.range_variance_m2).T[None]
    covariance = np.einsum("asn,bsn->sab", scaled, scaled)
    held = plan.survey_m * one.project @ survey_rows(plan, heading_deg)
    metre = one.project[:, plan.geometry.faulty]
    return RangeSystem(covariance, held @ held.T, np.exp(-plan.period_s / TAUS_S), metre, one.threshold, plan.period_s)


def miss_at_one_epoch(system: RangeSystem, range_error_m: float) -> float:
    """Probability that one epoch with this range error passes: exact, and above that of all epochs before it."""
    from scipy.stats import ncx2  # takes half a second to load

    strength = range_error_m**2 * float(system.metre @ system.metre)
    return float(ncx2.cdf(system.threshold, system.size, strength))
