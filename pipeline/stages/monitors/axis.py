"""One axis of the bank: increments between usable epochs as rates, raw and through EWMAs, with their sigmas.

Along the track (DIAG eq. 1-3) for the bank and for learning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from pipeline.stages.monitors.recursion import (
    AxisState,
    before_steps,
    ewma_weight,
    increment_variance,
    linear_recurrence,
    noise_of_ewma,
    variance_of_ewma,
)
from pipeline.stages.odometry.odometry import Increments
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, MonitorConfig
from schemas.frozen import frozen

# Rows evaluated at once: few after a restart, which may soon be followed by another; never more than the cache holds.
FIRST_BLOCK, BLOCK = 2048, 8192


@frozen
class AxisSeries:
    """Increments of one axis, one row per usable epoch, in order; all arrays of one length m.

    `epoch`: row among all epochs. `fresh`: no increment leads here. `rate_mps`: increment over `dt_s`. `border`: into
    another net element, whose survey has another offset, of variance `border_m2`. `sigma_m`, `sigma_before_m`,
    `decorrelation` (m, sources): sqrt R_j here and at the row before (`before_steps`), 1 - phi_j. `white_m2`: odometer
    noise of the increment. `lasting_mps` (m, errors): what one sigma of each error that stays makes of the rate,
    signed: scale, latency, the position error that a curve turns into this axis.
    """

    epoch: Ints
    fresh: Bools
    border: Bools
    dt_s: Floats
    rate_mps: Floats
    sigma_m: Floats
    sigma_before_m: Floats
    decorrelation: Floats
    white_m2: Floats
    border_m2: Floats
    lasting_mps: Floats

    def between(self, low: int, high: int) -> AxisSeries:
        return AxisSeries(**{item.name: getattr(self, item.name)[low:high] for item in fields(self)})


Source = tuple[Floats, Floats]
"""An error that positions share from row to row: its deviation [m], and 1 - phi over the step to each row."""


def errors_of(sigma_m: Floats, dt_s: Floats, beside: Sequence[Source], config: MonitorConfig) -> dict[str, Floats]:
    """The error fields of a series: four Gauss-Markov errors of positions of this sigma, and those `beside` them.

    Error j of a share of the variance has sigma_j = sqrt(share_j) sigma and 1 - phi_j = 1 - exp(-dt / tau_j) (DIAG
    Table 1). Transposed into Fortran order, as the recursions go along the rows.
    """
    sources = [
        (np.sqrt(share) * sigma_m, -np.expm1(-dt_s / tau_s)) for share, tau_s in zip(*error_model(config), strict=True)
    ]
    sources += beside
    sigmas = np.vstack([sigma for sigma, _ in sources]).T
    decorrelations = np.vstack([lost for _, lost in sources]).T
    before = before_steps(sigmas, decorrelations, config.sigma_step_factor)
    return {"sigma_m": sigmas, "sigma_before_m": before, "decorrelation": decorrelations}


def error_model(config: MonitorConfig) -> tuple[Floats, Floats]:
    """Shares of the position variance and correlation times [s] (DIAG Table 1)."""
    shares = [config.ionosphere_share, config.troposphere_share, config.orbit_clock_share, config.user_share]
    taus = [config.ionosphere_tau_s, config.troposphere_tau_s, config.orbit_clock_tau_s, config.user_tau_s]
    return np.array(shares), np.array(taus)


def time_steps(t_s: Floats, gap_reset_s: float) -> tuple[Floats, Bools]:
    """Time since the row before [s], 1 s where there is none, and rows that nothing leads to."""
    dt_s = np.diff(t_s, prepend=t_s[:1] - 1.0)
    fresh = dt_s > gap_reset_s
    fresh[:1] = True
    return dt_s, fresh


def run_axis(
    series: AxisSeries, alphas: Floats, state: AxisState | None = None, noise_m2: Floats | None = None
) -> tuple[Floats, Floats, AxisState]:
    """Values and sigmas of the axis [m/s] from `state`, or from a restart, on, and the state to carry on with.

    Shapes (rows, 1 + alphas): raw, then the EWMAs. `noise_m2`: of the same shape, the fast noise beyond the model;
    where it is NaN, so is the sigma.
    """
    noise_m2 = np.zeros((series.dt_s.size, 1 + alphas.size)) if noise_m2 is None else noise_m2
    known_m2 = np.nan_to_num(noise_m2)
    state = state or AxisState.at_restart(alphas.size, series.sigma_m.shape[1], series.lasting_mps.shape[1])
    moving = ~series.fresh
    weight = ewma_weight(alphas, series.dt_s) * moving[:, None]
    keep = (1.0 - weight) * moving[:, None]
    gain = weight / series.dt_s[:, None]
    errors = series.sigma_m, series.sigma_before_m, series.decorrelation
    increment_m2 = increment_variance(*errors) + series.white_m2
    variance, smooth = variance_of_ewma(keep, gain, *errors, increment_m2, series.white_m2, state)
    noise, fast = noise_of_ewma(keep, gain, known_m2[:, 1:], state)
    # A step between the surveys of two elements is no motion of the GNSS error: only the raw monitor, with the
    # survey's sigma, judges it; inside the EWMAs it would ring for long.
    smooth_rate = np.where(series.border, 0.0, series.rate_mps)
    ewma = linear_recurrence(keep, weight * smooth_rate[:, None], state.ewma)
    lasting = zip(series.lasting_mps.T, state.lasting, strict=True)
    responses = [linear_recurrence(keep, weight * rate_mps[:, None], before) for rate_mps, before in lasting]
    averaged_m2 = variance + noise + sum(response**2 for response in responses)
    raw_m2 = _raw_variance(series, increment_m2 + 2.0 * known_m2[:, 0])
    sigma = np.sqrt(np.column_stack([raw_m2, averaged_m2]))
    sigma[np.isnan(noise_m2)] = np.nan
    carried = np.array([response[-1] for response in responses]).reshape(state.lasting.shape)
    return np.column_stack([series.rate_mps, ewma]), sigma, AxisState(ewma[-1], *smooth, *fast, carried)


def _raw_variance(series: AxisSeries, increment_m2: Floats) -> Floats:
    """Variance of the raw rate (DIAG eq. 4-7 with correlated GNSS errors) [m^2/s^2]."""
    border = np.where(series.border, series.border_m2, 0.0)
    return np.asarray((increment_m2 + border) / series.dt_s**2 + (series.lasting_mps**2).sum(axis=1))


@frozen
class AlongEpochs:
    """Epochs with a position and an odometer, in order, and the errors there; all arrays of one length m.

    `doubt_m`: in the odometer's distance, a sum; `sigma_m`: of the Gauss-Markov errors; `digits_m`: how coarsely
    positions are written; `jitter_s`: scatter of the stamps; `white_m2_per_s`: what the odometer's distance gathers;
    `rows_m`: quantisation noise of its rows, `period_s` apart.
    """

    epoch: Ints
    t_s: Floats
    along_m: Floats
    doubt_m: Floats
    sigma_m: Floats
    digits_m: Floats
    jitter_s: Floats | float
    scale_sigma: Floats
    latency_sigma_s: Floats
    white_m2_per_s: Floats | float
    rows_m: Floats
    period_s: Floats | float


def along_series(epochs: AlongEpochs, odometer: Increments, config: Configuration) -> AxisSeries:
    dt, fresh = time_steps(epochs.t_s, config.align.gap_reset_s)
    zero = np.zeros(dt.size)
    # New at each epoch: a stamp's error times the speed, and the digits. The odometer's rows lose theirs by and by.
    memoryless_m = np.hypot(epochs.jitter_s * odometer.distance_m / dt, epochs.digits_m)
    beside = [
        (np.abs(memoryless_m), np.ones(dt.size)),
        (epochs.rows_m, _rows_decorrelation(dt, epochs.period_s, config.monitors)),
    ]
    return AxisSeries(
        epoch=epochs.epoch,
        fresh=fresh | (np.diff(epochs.doubt_m, prepend=epochs.doubt_m[:1]) != 0.0),
        border=np.zeros(dt.size, dtype=np.bool_),
        dt_s=dt,
        rate_mps=(np.diff(epochs.along_m, prepend=epochs.along_m[:1]) - odometer.distance_m) / dt,
        **errors_of(epochs.sigma_m, dt, beside, config.monitors),
        white_m2=epochs.white_m2_per_s * dt,
        border_m2=zero,
        lasting_mps=np.column_stack(
            [epochs.scale_sigma * odometer.distance_m / dt, epochs.latency_sigma_s * odometer.speed_mps / dt]
        ),
    )


def _rows_decorrelation(dt_s: Floats, period_s: Floats | float, config: MonitorConfig) -> Floats:
    """1 - phi of the rows' noise over these steps: none is left from row to row.

    The square is what a step changes on a straight line between two rows. Errors that change so little at random would
    last for `period_s`^2 / dt, and averages would follow them: so they last half of the fastest average's memory at
    most, and the variance of all averages is that of rows so far apart, or above it.
    """
    changed = np.minimum(dt_s / np.maximum(period_s, 1e-9), 1.0) ** 2
    lasts_s = 0.5 / config.ewma_alphas[0]
    lost: Floats = np.maximum(changed, np.minimum(dt_s / lasts_s, 1.0))
    return lost
