"""The bank of monitors as one linear Gaussian system: its thresholds, its covariances, and how it answers a ramp.

State: Gauss-Markov errors by source and axis, white noise on positions (a Gauss-Markov error without memory),
then the monitors. With s(k+1) = A s(k) + B w(k+1) and w standard normal, every covariance between monitors at any
two epochs follows from powers of A.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import field
from functools import cached_property, partial
from typing import ClassVar, Literal

import numpy as np
from scipy.linalg import solve_discrete_lyapunov
from scipy.special import log_ndtr, ndtri_exp

from datasets.experiment.geometry import SOURCES, TAUS_S, Geometry
from datasets.experiment.sampling import Limits, matrix_root
from schemas.arrays import Bools, Floats
from schemas.config import MonitorConfig, threshold_factor
from schemas.frozen import frozen

Reading = Literal["increments", "position"]
Sensors = Literal["odometer", "odometer_and_track"]

READINGS: tuple[Reading, ...] = ("increments", "position")
SENSORS: tuple[Sensors, ...] = ("odometer", "odometer_and_track")
# The two readings of the odometer's noise and the slowest average that goes with each (DOMAIN section 7).
PUBLISHED_WEIGHTS: dict[Reading, tuple[float, ...]] = {
    "increments": (1.0, 0.1, 0.01, 0.001),
    "position": (1.0, 0.1, 0.01, 0.002),
}
_MOST_AXES = 3


@frozen
class BankSpec:
    """A bank that a user may configure: EWMA weights at 1 s (1 = raw), sensors, probability, rate of epochs.

    Without alphas it is the bank that goes with the reading of the odometer's noise. `age_s`: how long the bank has
    run since its restart when a fault begins; none is so long that nothing of the restart is left.
    """

    alphas: tuple[float, ...] = ()
    reading: Reading = "increments"
    sensors: Sensors = "odometer"
    false_alarm_probability: float = 1e-7
    rate_hz: float = 1.0
    odometer_m: float = 0.05
    map_m: float = 1.0
    age_s: float | None = None

    @classmethod
    def from_configuration(cls, config: MonitorConfig, sensors: Sensors, rate_hz: float = 1.0) -> BankSpec:
        """The bank of a replay's configuration; recorded odometers are noisy on increments."""
        return cls(
            alphas=(1.0, *config.ewma_alphas),
            sensors=sensors,
            false_alarm_probability=config.false_alarm_probability,
            rate_hz=rate_hz,
            odometer_m=config.odometer_sigma_mps,
        )

    @property
    def weights(self) -> tuple[float, ...]:
        """EWMA weights of the averages at 1 s, the raw monitor's (1) first."""
        return self.alphas or PUBLISHED_WEIGHTS[self.reading]

    @property
    def weights_text(self) -> str:
        """The EWMA weights as they stand in tables."""
        return ", ".join(f"{alpha:g}" for alpha in self.weights)


@frozen
class LinearBank:
    """Monitors along, and with track across and up, as a `System`; stationary, unless the bank has an age.

    `advance` A and `noise` B as above; `sources` is the number of error states before the monitors; `slope`
    (monitors,) final response to a range ramp of 1 m/s; `alpha` (monitors,) weight of one epoch.
    """

    spec: BankSpec
    advance: Floats
    noise: Floats
    sources: int
    slope: Floats
    alpha: Floats
    along_error: Floats = field(repr=False)

    streams: ClassVar[tuple[int, int]] = (31, 32)
    margins: ClassVar[tuple[float, ...]] = (0.4, 1.0, 1.5, 2.0, 2.5)
    runs_per_block: ClassVar[int] = 250

    @property
    def size(self) -> int:
        """How many monitors there are."""
        return int(self.slope.size)

    @cached_property
    def covariance(self) -> Floats:
        """Stationary covariance P of the state: P = A P A' + B B'."""
        result: Floats = solve_discrete_lyapunov(self.advance, self.noise @ self.noise.T)
        return 0.5 * (result + result.T)

    @property
    def sigma(self) -> Floats:
        """Standard deviation of each monitor long after the restart [m/s], shape (monitors,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[self.sources :]))

    @property
    def threshold(self) -> Floats:
        """k_T sigma (DIAG eq. 17), long after the restart [m/s]."""
        return threshold_factor(self.spec.false_alarm_probability) * self.sigma

    def covariances(self, epochs: int) -> Floats:
        """Covariance of the state at epochs 0 .. n of the fault, (epochs + 1, states, states)."""
        states = len(self.advance)
        if self.spec.age_s is None:
            return np.broadcast_to(self.covariance, (epochs + 1, states, states))
        pushed = self.noise @ self.noise.T
        current = np.zeros((states, states))
        # At a restart the position errors go on as they were, and the averages begin at zero.
        current[: self.sources, : self.sources] = self.covariance[: self.sources, : self.sources]
        result = np.empty((epochs + 1, states, states))
        age = round(self.spec.age_s * self.spec.rate_hz)
        for k in range(age + epochs + 1):
            if k >= age:
                result[k - age] = current
            current = self.advance @ current @ self.advance.T + pushed
        return result

    def sigmas(self, epochs: int) -> Floats:
        """Standard deviations of the monitors at epochs 1 .. n of the fault [m/s], shape (epochs, monitors)."""
        variances = np.diagonal(self.covariances(epochs)[1:], axis1=1, axis2=2)
        return np.asarray(np.sqrt(variances[:, self.sources :]))

    def thresholds(self, epochs: int) -> Floats:
        """k_T sigma at epochs 1 .. n of the fault [m/s], (epochs, monitors)."""
        return threshold_factor(self.spec.false_alarm_probability) * self.sigmas(epochs)

    def ramp(self, epochs: int, rate_mps: float) -> Floats:
        """An average answers a range ramp that starts at epoch 0 with 1 - (1 - alpha)^k of its final value."""
        k = np.arange(1, epochs + 1)[:, None]
        return rate_mps * np.asarray((1.0 - (1.0 - self.alpha) ** k) * self.slope)

    def limits(self, epochs: int, rate_mps: float) -> Limits:
        """The thresholds, on the side that the ramp pushes to."""
        towards = np.where(self.slope < 0, -1.0, 1.0)
        return Limits(self.ramp(epochs, rate_mps), self.thresholds(epochs), self.sigmas(epochs), towards)

    def on_limits(self, values: Floats) -> Floats:
        """What the limits bound: the values themselves."""
        return values

    def towards_limit(self, epochs: int) -> Callable[[int, int], Floats]:
        """Covariance of the values with the monitor of a limit at an epoch, as a function of both."""
        return partial(self.covariance_with, covariances=self.covariances(epochs))

    def passing(self, epochs: int) -> Callable[[int, Floats], Bools]:
        """Whether each run passes at an epoch with its values, as a function of both."""
        threshold = self.thresholds(epochs)
        return lambda k, values: np.asarray((np.abs(values) <= threshold[k][:, None]).all(axis=0))

    def covariance_with(self, monitor: int, epoch: int, covariances: Floats) -> Floats:
        """Covariance of all monitors at epochs 1 .. n with one monitor at one epoch (1-based), (epochs, monitors).

        `covariances` (n + 1, states, states): those of the state, as above.
        """
        P = covariances
        A = self.advance
        epochs = len(covariances) - 1
        result = np.empty((epochs, self.size))
        place = self.sources + monitor
        later = P[epoch, :, place].copy()
        for k in range(epoch, epochs + 1):
            result[k - 1] = later[self.sources :]
            later = A @ later
        earlier = np.zeros(len(A))
        earlier[place] = 1.0
        for k in range(epoch, 0, -1):
            result[k - 1] = (P[k] @ earlier)[self.sources :]
            earlier = A.T @ earlier
        return result

    def covariance_by_lag(self, epochs: int) -> Floats:
        """Covariance of value j at epoch k + lag with value i at k, lags -(n-1) .. n-1; (lags, i, j)."""
        if self.spec.age_s is not None:
            raise ValueError("false alarms are sampled of a stationary bank")
        result = np.empty((2 * epochs - 1, self.size, self.size))
        later = self.covariance[:, self.sources :].copy()
        for lag in range(epochs):
            result[epochs - 1 + lag] = later[self.sources :].T
            result[epochs - 1 - lag] = later[self.sources :]
            later = self.advance @ later
        return result

    def force_fail(self, values: Floats, rng: np.random.Generator) -> tuple[Floats, float]:
        """A monitor drawn at random beyond its threshold; the tail in logarithms does not underflow at 1e-15."""
        runs = len(values)
        sigma = self.sigma
        monitor = rng.integers(0, self.size, runs)
        log_tail = float(log_ndtr(-self.threshold[0] / sigma[0]))
        target = -ndtri_exp(log_tail + np.log(rng.random(runs))) * sigma[monitor]
        target *= rng.choice([-1.0, 1.0], runs)
        each = np.arange(runs)
        pull = np.zeros((runs, self.size))
        pull[each, monitor] = (target - values[each, monitor]) / sigma[monitor] ** 2
        return pull, self.size * 2.0 * float(np.exp(log_tail))

    def count_fails(self, path: Floats) -> int:
        """Fails of one run, (epochs, values)."""
        return int((np.abs(path) > self.threshold).sum())

    def draw_start(self, runs: int, rng: np.random.Generator) -> Floats:
        """States at the fault's onset, (states, runs)."""
        return np.asarray(matrix_root(self.covariances(0)[0]) @ rng.standard_normal((len(self.advance), runs)))

    def draw_next(self, state: Floats, rng: np.random.Generator) -> Floats:
        """States at the next epoch, A x + B w."""
        following = self.advance @ state
        following += self.noise @ rng.standard_normal((self.noise.shape[1], state.shape[1]))
        return np.asarray(following)

    def values(self, state: Floats) -> Floats:
        """Values of the monitors, (values, runs)."""
        return state[self.sources :]


def linear_bank(geometry: Geometry, heading_deg: float, spec: BankSpec) -> LinearBank:
    """The monitors of a fixed sky and heading (DIAG eq. 1-16); the fault is a ramp in the range of one satellite.

    `heading_deg`: clockwise from the faulty satellite on.
    """
    vectors = geometry.axes(heading_deg)[: _MOST_AXES if spec.sensors == "odometer_and_track" else 1]
    covariances = np.einsum("ai,jik,bk->jab", vectors, geometry.source_covariances_m2, vectors)
    dt_s = 1.0 / spec.rate_hz
    return _assemble_bank(spec, covariances, np.exp(-dt_s / TAUS_S), vectors @ geometry.ramp_direction)


def bank_of_axis(spec: BankSpec, variances_m2: Floats, taus_s: Floats, white_m: float) -> LinearBank:
    """The monitors of one axis, along the track if not said otherwise; the fault is a ramp of the position along it.

    `variances_m2`, `taus_s` (sources,): Gauss-Markov errors in the order of `SOURCES`. `white_m`: white noise on
    position.
    """
    covariances = variances_m2[:, None, None]
    return _assemble_bank(spec, covariances, np.exp(-1.0 / spec.rate_hz / taus_s), np.ones(1), white_m)


def _assemble_bank(spec: BankSpec, covariances: Floats, phi: Floats, slope: Floats, white_m: float = 0.0) -> LinearBank:
    """`covariances` (sources, axes, axes) [m2] of the position; `phi` (sources,) correlation of successive epochs."""
    count = slope.size
    gauss_markov = len(SOURCES) * count
    position_white = np.full(count, spec.map_m)
    position_white[0] = np.hypot(white_m, spec.odometer_m) if spec.reading == "position" else white_m
    sources = gauss_markov + count
    alphas = 1.0 - (1.0 - np.array(spec.weights)) ** (1.0 / spec.rate_hz)
    alpha = np.tile(alphas, count)
    axis = np.repeat(np.arange(count), alphas.size)
    states = sources + alpha.size
    A = np.zeros((states, states))
    B = np.zeros((states, sources + 1))
    decay = np.concatenate([np.repeat(phi, count), np.zeros(count)])
    A[:sources, :sources] = np.diag(decay)
    colour = np.linalg.cholesky(covariances + 1e-18 * np.eye(count))
    for j, one in enumerate(colour):
        rows = slice(j * count, (j + 1) * count)
        B[rows, rows] = np.sqrt(1.0 - phi[j] ** 2) * one
    B[gauss_markov:sources, gauss_markov:sources] = np.diag(position_white)
    # A monitor m(k+1) = (1 - alpha) m(k) + gain (e(k+1) - e(k)), e the error of its axis, summed over the sources.
    gain = alpha * spec.rate_hz
    lies_on = np.tile(np.arange(count), len(SOURCES) + 1)[None, :] == axis[:, None]
    A[sources:, :sources] = gain[:, None] * lies_on * (decay - 1.0)
    A[sources:, sources:] = np.diag(1.0 - alpha)
    B[sources:, :sources] = gain[:, None] * (lies_on @ B[:sources, :sources])
    if spec.reading == "increments":
        B[sources:, sources] = np.where(axis == 0, gain * spec.odometer_m / np.sqrt(spec.rate_hz), 0.0)
    return LinearBank(spec, A, B, sources, slope[axis], alpha, slope)
