"""One axis of the bank: rates between consecutive usable epochs, raw and through EWMAs, with their sigmas."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from pipeline.monitors.recursion import (
    AxisState,
    before_steps,
    ewma_weight,
    increment_variance,
    linear_recurrence,
    variance_of_ewma,
)
from schemas.arrays import Bools, Floats
from schemas.config import MonitorConfig

# Half of the fastest average's memory: so the variance of all averages is that of rows up to 5 s apart, or above it.
_LASTS_S = 5.0


@dataclass(frozen=True)
class AxisSeries:
    """Increments of one axis, one row per usable epoch, in order; all arrays of the same length m.

    `epoch`: index of the row among all epochs. `fresh`: no increment leads here (start, long gap, lost distance).
    `rate_mps`: increment of GNSS minus odometer or track over `dt_s`. `border`: the increment crosses into another
    net element, whose survey offset is another (`border_m2`, its variance). `sigma_m`, `sigma_before_m` and
    `decorrelation` (m, sources): sqrt R_j here and at the row before (see `before_steps`), and
    1 - phi_j. `white_m2`: odometer noise of
    the increment. `steady_mps`, `latency_mps`: what one sigma of an error that stays (odometer scale; the position
    error that a curve turns into this axis) and of the latency makes of the rate, signed.
    """

    epoch: npt.NDArray[np.int64]
    fresh: Bools
    border: Bools
    dt_s: Floats
    rate_mps: Floats
    sigma_m: Floats
    sigma_before_m: Floats
    decorrelation: Floats
    white_m2: Floats
    border_m2: Floats
    steady_mps: Floats
    latency_mps: Floats

    def between(self, low: int, high: int) -> AxisSeries:
        """Rows [low, high)."""
        return AxisSeries(**{item.name: getattr(self, item.name)[low:high] for item in fields(self)})


@dataclass(frozen=True)
class AxisResult:
    """Statistic and its sigma [m/s], shape (rows, 1 + alphas): raw first, then the EWMAs."""

    value: Floats
    sigma: Floats


def with_memory(sigma_m: Floats, decorrelation: Floats) -> dict[str, Floats]:
    """The error fields of a series from sqrt R_j (m, sources) and 1 - phi_j, best in Fortran order.

    The recursions go along the rows, one source after the other.
    """
    before = before_steps(sigma_m, decorrelation)
    return {"sigma_m": sigma_m, "sigma_before_m": before, "decorrelation": decorrelation}


def along_errors(
    sigma_m: Floats, jitter_m: Floats, dt_s: Floats, shares: Floats, taus_s: Floats, reading: Reading | None = None
) -> dict[str, Floats]:
    """Error fields of the along-track axis: the Gauss-Markov errors, stamps that scatter, rows of the odometer that do.

    `jitter_m`: standard deviation of the way that the stamp's jitter makes; it has no memory (phi = 0).
    """
    sigmas = [np.outer(np.sqrt(shares), sigma_m), np.abs(jitter_m)]
    decorrelations = [decorrelation_of(dt_s, taus_s), np.ones(dt_s.size)]
    if reading is not None:
        sigmas.append(reading.sigma_m)
        decorrelations.append(reading.decorrelation(dt_s))
    return with_memory(np.vstack(sigmas).T, np.vstack(decorrelations).T)


def calibrated(sigma_m: Floats, config: MonitorConfig) -> Floats:
    """Position sigma that the monitors count with [m]: `calibrate` may have fitted a + b sigma."""
    return config.sigma_intercept_m + config.sigma_slope * sigma_m


@dataclass(frozen=True)
class Reading:
    """Noise of the odometer's rows: its deviation at each epoch [m], shape (m,), and the time between rows [s]."""

    sigma_m: Floats
    period_s: float

    def decorrelation(self, dt_s: Floats) -> Floats:
        """1 - phi over these steps: none is left from row to row; between rows, on straight lines, little changes.

        The square is what a step changes on a straight line. Errors that change so little and at random would last for
        `period_s`^2 / dt, and averages would follow them: they have none that lasts longer than `_LASTS_S`.
        """
        changed = np.minimum(dt_s / max(self.period_s, 1e-9), 1.0) ** 2
        lost: Floats = np.maximum(changed, np.minimum(dt_s / _LASTS_S, 1.0))
        return lost


@dataclass(frozen=True)
class AlongSteps:
    """Steps along the track from one usable epoch to the next, shapes (m,), and the errors at their ends.

    `path_m` by GNSS, `odometer_m` and the change of speed `speed_mps` by the corrected odometer; `jitter_s`: how the
    stamps scatter; `digits_m`: how coarsely positions are written down; `white_m2_per_s`: variance that the odometer's
    distance gathers in a second; `reading`: what its rows scatter beside.
    """

    dt_s: Floats
    path_m: Floats
    odometer_m: Floats
    speed_mps: Floats
    sigma_m: Floats
    jitter_s: Floats | float
    white_m2_per_s: Floats | float
    scale_sigma: Floats
    latency_sigma_s: Floats
    digits_m: Floats
    reading: Reading | None = None


def along_axis(
    epoch: npt.NDArray[np.int64], fresh: Bools, steps: AlongSteps, shares: Floats, taus_s: Floats
) -> AxisSeries:
    """Increments of GNSS minus odometer (DIAG eq. 1-3), with what scale and latency leave uncertain."""
    dt = steps.dt_s
    memoryless_m = np.hypot(steps.jitter_s * steps.odometer_m / dt, steps.digits_m)
    return AxisSeries(
        epoch=epoch,
        fresh=fresh,
        border=np.zeros(dt.size, dtype=np.bool_),
        dt_s=dt,
        rate_mps=(steps.path_m - steps.odometer_m) / dt,
        **along_errors(steps.sigma_m, memoryless_m, dt, shares, taus_s, steps.reading),
        white_m2=steps.white_m2_per_s * dt,
        border_m2=np.zeros(dt.size),
        steady_mps=steps.scale_sigma * steps.odometer_m / dt,
        latency_mps=steps.latency_sigma_s * steps.speed_mps / dt,
    )


def decorrelation_of(dt_s: Floats, taus_s: Floats) -> Floats:
    """1 - phi of first-order Gauss-Markov errors over these steps; shape (sources, steps)."""
    return -np.expm1(-dt_s / taus_s[:, None])


def run_axis(series: AxisSeries, alphas: Floats, state: AxisState | None = None) -> tuple[AxisResult, AxisState]:
    """Values and sigmas of the axis from `state`, or from a restart, on, and the state to carry on with."""
    state = state or AxisState.at_restart(alphas.size, series.sigma_m.shape[1])
    moving = ~series.fresh
    weight = ewma_weight(alphas, series.dt_s) * moving[:, None]
    keep = (1.0 - weight) * moving[:, None]
    gain = weight / series.dt_s[:, None]
    errors = series.sigma_m, series.sigma_before_m, series.decorrelation
    increment_m2 = increment_variance(*errors) + series.white_m2
    variance, covariance = variance_of_ewma(keep, gain, *errors, increment_m2, series.white_m2, state)
    # A step between the surveys of two elements is no motion of the GNSS error: only the raw monitor, with the
    # survey's sigma, judges it; inside the EWMAs it would ring for long.
    smooth_rate = np.where(series.border, 0.0, series.rate_mps)
    ewma = linear_recurrence(keep, weight * smooth_rate[:, None], state.ewma)
    steady = _response(keep, weight, series.steady_mps, state.steady_response)
    latency = _response(keep, weight, series.latency_mps, state.latency_response)
    raw_variance = _raw_variance(series, increment_m2)
    sigma = np.sqrt(np.column_stack([raw_variance, variance + steady**2 + latency**2]))
    result = AxisResult(np.column_stack([series.rate_mps, ewma]), sigma)
    if series.epoch.size == 0:
        return result, state
    return result, AxisState(ewma[-1], variance[-1], covariance, steady[-1], latency[-1])


def _response(keep: Floats, weight: Floats, rate_mps: Floats, before: Floats) -> Floats:
    """What one sigma of an error that stays has made of the EWMAs [m/s]; most axes know none."""
    if not (rate_mps.any() or before.any()):
        return np.zeros_like(keep)
    return linear_recurrence(keep, weight * rate_mps[:, None], before)


def _raw_variance(series: AxisSeries, increment_m2: Floats) -> Floats:
    """Variance of the raw rate (DIAG eq. 4-7 with correlated GNSS errors) [m^2/s^2]."""
    border = np.where(series.border, series.border_m2, 0.0)
    noise: Floats = (increment_m2 + border) / series.dt_s**2
    return noise + series.steady_mps**2 + series.latency_mps**2
