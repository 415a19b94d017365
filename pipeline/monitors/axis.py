"""One axis of the bank: rates between consecutive usable epochs, raw and through EWMAs, with their sigmas."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from pipeline.monitors.recursion import Array, AxisState, ewma_weight, linear_recurrence, variance_of_ewma

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class AxisSeries:
    """Increments of one axis, one row per usable epoch, in order; all arrays of the same length m.

    `epoch`: index of the row among all epochs. `fresh`: no increment leads here (start, long gap, lost distance).
    `rate_mps`: increment of GNSS minus odometer or track over `dt_s`. `border`: the increment crosses into another
    net element, whose survey offset is another (`border_m2`, its variance). `variance_m2` (m, sources) and
    `decorrelation` (m, sources): R_j and 1 - phi_j. `white_m2`: odometer noise of the increment. `scale_mps`,
    `latency_mps`: what one sigma of scale and of latency makes of the rate, signed.
    """

    epoch: npt.NDArray[np.int64]
    fresh: Mask
    border: Mask
    dt_s: Array
    rate_mps: Array
    variance_m2: Array
    decorrelation: Array
    white_m2: Array
    border_m2: Array
    scale_mps: Array
    latency_mps: Array

    def between(self, low: int, high: int) -> AxisSeries:
        """Rows [low, high)."""
        return AxisSeries(**{item.name: getattr(self, item.name)[low:high] for item in fields(self)})


@dataclass(frozen=True)
class AxisResult:
    """Statistic and its sigma [m/s], shape (rows, 1 + alphas): raw first, then the EWMAs."""

    value: Array
    sigma: Array


def along_errors(variance_m2: Array, jitter_m: Array, dt_s: Array, shares: Array, taus_s: Array) -> dict[str, Array]:
    """R_j and 1 - phi_j of the along-track axis: the Gauss-Markov errors, and stamps that scatter.

    `jitter_m`: standard deviation of the way that the stamp's jitter makes; it has no memory (phi = 0).
    """
    return {
        "variance_m2": np.column_stack([np.outer(variance_m2, shares), jitter_m**2]),
        "decorrelation": np.column_stack([-np.expm1(-dt_s[:, None] / taus_s), np.ones(dt_s.size)]),
    }


def run_axis(series: AxisSeries, alphas: Array, state: AxisState) -> tuple[AxisResult, AxisState]:
    """Values and sigmas of the axis from `state` on, and the state to carry on with."""
    moving = ~series.fresh
    weight = ewma_weight(alphas, series.dt_s) * moving[:, None]
    keep = (1.0 - weight) * moving[:, None]
    gain = weight / series.dt_s[:, None]
    variance, covariance = variance_of_ewma(
        keep, gain, series.variance_m2, series.decorrelation, series.white_m2, state
    )
    # A step between the surveys of two elements is no motion of the GNSS error: only the raw monitor, with the
    # survey's sigma, judges it; inside the EWMAs it would ring for long.
    smooth_rate = np.where(series.border, 0.0, series.rate_mps)
    ewma = linear_recurrence(keep, weight * smooth_rate[:, None], state.ewma)
    scale = linear_recurrence(keep, weight * series.scale_mps[:, None], state.scale_response)
    latency = linear_recurrence(keep, weight * series.latency_mps[:, None], state.latency_response)
    raw_variance = _raw_variance(series)
    sigma = np.sqrt(np.column_stack([raw_variance, variance + scale**2 + latency**2]))
    result = AxisResult(np.column_stack([series.rate_mps, ewma]), sigma)
    if series.epoch.size == 0:
        return result, state
    return result, AxisState(ewma[-1], variance[-1], covariance, scale[-1], latency[-1])


def _raw_variance(series: AxisSeries) -> Array:
    """Variance of the raw rate (DIAG eq. 4-7 with correlated GNSS errors) [m^2/s^2]."""
    gnss = 2.0 * (series.variance_m2 * series.decorrelation).sum(axis=1)
    border = np.where(series.border, series.border_m2, 0.0)
    noise: Array = (gnss + series.white_m2 + border) / series.dt_s**2
    return noise + series.scale_mps**2 + series.latency_mps**2
