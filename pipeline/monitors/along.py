"""The along-track axis: the one builder of increments of GNSS minus odometer (DIAG eq. 1-3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.monitors.axis import AxisSeries, errors_of, time_steps
from pipeline.odometry.odometry import Increments
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, MonitorConfig


@dataclass(frozen=True)
class AlongEpochs:
    """Epochs with a position and an odometer, in order, and the errors there; all arrays of one length m.

    `epoch`: row among all epochs; `segment`: the odometer's continuity segment; `sigma_m`: of the Gauss-Markov errors;
    `digits_m`: how coarsely positions are written down; `jitter_s`: how the stamps scatter about the receiver's clock;
    `scale_sigma`, `latency_sigma_s`: of the estimates in use; `white_m2_per_s`: what the odometer's distance gathers in
    a second; `rows_m`: quantisation noise of its rows, `period_s` apart, None where the odometer has none at
    all: the same over a whole run, for the recursions carry each source on.
    """

    epoch: Ints
    t_s: Floats
    along_m: Floats
    segment: Ints
    sigma_m: Floats
    digits_m: Floats
    jitter_s: Floats | float
    scale_sigma: Floats
    latency_sigma_s: Floats
    white_m2_per_s: Floats | float
    rows_m: Floats | None
    period_s: Floats | float


def along_series(epochs: AlongEpochs, odometer: Increments, config: Configuration) -> AxisSeries:
    """Increments from each epoch to the next, with what scale and latency leave uncertain."""
    dt, fresh = time_steps(epochs.t_s, config.align.gap_reset_s)
    zero = np.zeros(dt.size)
    memoryless_m = np.hypot(epochs.jitter_s * odometer.distance_m / dt, epochs.digits_m)
    beside = [(np.abs(memoryless_m), np.ones(dt.size))]
    if epochs.rows_m is not None:
        beside.append((epochs.rows_m, _rows_decorrelation(dt, epochs.period_s, config.monitors)))
    return AxisSeries(
        epoch=epochs.epoch,
        fresh=fresh | (np.diff(epochs.segment, prepend=epochs.segment[:1]) != 0),
        border=np.zeros(dt.size, dtype=np.bool_),
        dt_s=dt,
        rate_mps=(np.diff(epochs.along_m, prepend=epochs.along_m[:1]) - odometer.distance_m) / dt,
        **errors_of(epochs.sigma_m, dt, beside, config.monitors),
        white_m2=epochs.white_m2_per_s * dt,
        border_m2=zero,
        steady_mps=epochs.scale_sigma * odometer.distance_m / dt,
        latency_mps=epochs.latency_sigma_s * odometer.speed_mps / dt,
    )


def _rows_decorrelation(dt_s: Floats, period_s: Floats | float, config: MonitorConfig) -> Floats:
    """1 - phi of the rows' noise over these steps: none is left from row to row; between them little changes.

    The square is what a step changes on a straight line between two rows. Errors that change so little and at random
    would last for `period_s`^2 / dt, and averages would follow them: they have none that lasts longer than half of
    the fastest average's memory. So the variance of all averages is that of rows up to so far apart, or above it.
    """
    changed = np.minimum(dt_s / np.maximum(period_s, 1e-9), 1.0) ** 2
    lasts_s = 0.5 / config.ewma_alphas[0]
    lost: Floats = np.maximum(changed, np.minimum(dt_s / lasts_s, 1.0))
    return lost


def most_scatter_m(config: Configuration) -> float:
    """The largest deviation of an odometer's row, or of digits, that the thresholds allow for [m].

    With more, a position that leaves its place by the failure limit would be no more than rows of the odometer, or the
    digits, make of it. Alarms of a record that scatters by more are its own, but no failure passes.
    """
    factor = config.monitors.threshold_factor
    return config.hazards.failure_limit_m / (factor * float(np.sqrt(2.0)))
