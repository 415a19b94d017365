"""Recursions along time: EWMA of the rates (DIAG eq. 8) and its exact variance (DOMAIN section 3), vectorised."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import fields

import numpy as np
from scipy.linalg.lapack import dtbtrs

from pipeline.stages.odometry.odometry import Increments
from schemas.arrays import Bools, Floats, Ints
from schemas.config import Configuration, MonitorConfig
from schemas.frozen import frozen


def linear_recurrence(decay: Floats, drive: Floats, initial: Floats) -> Floats:
    """Solve `y[k] = decay[k] * y[k-1] + drive[k]` with `y[-1] = initial`, shapes (n, c), (n, c), (c,).

    A triangular system of two diagonals, which LAPACK solves row by row: term by term that loop.
    """
    y = np.array(np.broadcast_to(drive, (len(decay), len(initial))), dtype=np.float64, order="F")
    return _solved(decay, y, initial)


def _solved(decay: Floats, y: Floats, initial: Floats) -> Floats:
    """`y`: the drive, in Fortran order; the result takes its place."""
    if not len(y):
        return y
    y[0] += decay[0] * initial
    band = _band(len(y))
    for channel in range(y.shape[1]):
        y[:, channel] = _solved_column(band, decay[:, channel], y[:, channel])
    return y


def _band(rows: int) -> Floats:
    """The two diagonals of the system: ones, and room for the decays."""
    return np.ones((2, rows), order="F")


def _solved_column(band: Floats, decay: Floats, y: Floats) -> Floats:
    """One column `y`, overwritten, which begins with what was carried on."""
    np.negative(decay[1:], out=band[1, :-1])
    solved, _ = dtbtrs(band, y[:, None], uplo="L", diag="U", overwrite_b=1)
    return np.asarray(solved[:, 0])


def ewma_weight(alpha: Floats, dt_s: Floats) -> Floats:
    """1 - (1 - alpha)^(dt / 1 s); shape (n, alphas), in Fortran order."""
    return 1.0 - ((1.0 - alpha[:, None]) ** dt_s[None, :]).T


@frozen
class AxisState:
    """What the recursions of one axis carry on; all zero at a restart. Shapes (alphas,), (alphas, sources).

    `noise_*`: of the noise that each average has of its own; `lasting` (errors, alphas).
    """

    ewma: Floats
    variance: Floats
    covariance: Floats
    noise_variance: Floats
    noise_covariance: Floats
    lasting: Floats

    @classmethod
    def at_restart(cls, alphas: int, sources: int, lasting: int = 0) -> AxisState:
        """All zero; `lasting`: number of errors that stay."""
        zero = np.zeros(alphas)
        return cls(zero, zero, np.zeros((alphas, sources)), zero, zero, np.zeros((lasting, alphas)))


def variance_of_ewma(
    keep: Floats,
    gain: Floats,
    sigma_m: Floats,
    sigma_before_m: Floats,
    decorrelation: Floats,
    increment_m2: Floats,
    white_m2: Floats,
    state: AxisState,
) -> tuple[Floats, tuple[Floats, Floats]]:
    """Variance of the EWMAs of a rate [m^2/s^2], epoch by epoch, from a restart or a carried state.

    `keep` (n, alphas): b = 1 - alpha(dt), `gain` (n, alphas): alpha(dt) / dt, both zero at a row that restarts;
    `decorrelation`: 1 - phi_j, given as such because it is tiny at 10 Hz; `increment_m2` (n,): variance of the
    increment, of which `white_m2` (n,) is white. Returns the variance (n, alphas) and what is carried on: its last
    value (alphas,) and covariances c_j = cov(u, e_j) (alphas, sources).

    The recursion of DOMAIN section 3. Where sigma changes by the step (s_p to s_k: a fix lost to dead reckoning), the
    error goes with it as e = s n with n of unit variance, from there on; with r = s_k / s_p,

    v <- b^2 v + (alpha g)^2 [s_k^2 + s_p^2 - 2 phi s_k s_p] + 2 alpha g b c (phi r - 1) + (alpha g)^2 white

    c <- b phi r c + alpha g s_k (s_k - phi s_p)
    """
    coupling = np.zeros_like(gain)
    covariances = np.empty_like(state.covariance)
    new_m2 = np.zeros(len(gain))
    band = _band(len(gain))
    # Column by column, which the cache holds.
    for source, column in enumerate(_by_source(sigma_m, sigma_before_m, decorrelation)):
        carried, fresh_m2, change = _memory(*column)
        has_memory = carried[1:].any()
        for average, before in enumerate(state.covariance[:, source].tolist()):
            covariance = gain[:, average] * fresh_m2
            covariance[0] += keep[0, average] * carried[0] * before
            if has_memory:  # else the drive is all there is
                covariance = _solved_column(band, keep[:, average] * carried, covariance)
            coupling[0, average] += before * change[0]
            coupling[1:, average] += covariance[:-1] * change[1:]
            covariances[average, source] = covariance[-1]
        sigma, _, lost = column
        new_m2 += sigma**2 * lost * (2.0 - lost)
    fresh = gain**2 * increment_m2[:, None] + 2.0 * gain * keep * coupling
    variance = linear_recurrence(keep**2, fresh, state.variance)
    # A sigma that falls quickly, though not by the step, can bring the printed recursion below what is new in it.
    new_m2 += white_m2
    return np.maximum(variance, gain**2 * new_m2[:, None]), (variance[-1], covariances)


def noise_of_ewma(
    keep: Floats, gain: Floats, noise_m2: Floats, state: AxisState
) -> tuple[Floats, tuple[Floats, Floats]]:
    """Variance of the EWMAs by memoryless noise [m^2/s^2], of its own size for each; all shapes (n, alphas).

    The recursion with phi = 0 and R = `noise_m2`; at a constant step M 2 alpha^2 g^2 / (2 - alpha). Returns what is
    carried on too: last variance and covariances (alphas,).
    """
    covariance = gain * noise_m2
    if not (noise_m2.any() or state.noise_variance.any()):
        return np.zeros_like(gain), (np.zeros_like(covariance[-1]), covariance[-1])
    before = np.empty_like(covariance)
    before[0] = state.noise_covariance
    before[1:] = covariance[:-1]
    variance = linear_recurrence(keep**2, 2.0 * gain * (covariance - keep * before), state.noise_variance)
    # Noise that falls from one renewal to the next can bring this below what is new in it.
    return np.maximum(variance, gain * covariance), (variance[-1], covariance[-1])


def _by_source(
    sigma_m: Floats, sigma_before_m: Floats, decorrelation: Floats
) -> Iterator[tuple[Floats, Floats, Floats]]:
    """The columns of each source."""
    sigmas = list(sigma_m.T)
    before = sigmas if sigma_before_m is sigma_m else list(sigma_before_m.T)
    return zip(sigmas, before, decorrelation.T, strict=True)


def _same(sigma_m: Floats, sigma_before_m: Floats) -> bool:
    """No sigma changed by the step."""
    return sigma_m is sigma_before_m or np.array_equal(sigma_m, sigma_before_m)


def _memory(sigma_m: Floats, sigma_before_m: Floats, decorrelation: Floats) -> tuple[Floats, Floats, Floats]:
    """Terms of the recursion of one source: phi r, s_k (s_k - phi s_p) and phi r - 1; shapes (n,)."""
    if _same(sigma_m, sigma_before_m):
        return 1.0 - decorrelation, sigma_m * (decorrelation * sigma_m), -decorrelation
    ratio = np.divide(sigma_m, sigma_before_m, out=np.ones_like(sigma_m), where=sigma_before_m > 0.0)
    carried = (1.0 - decorrelation) * ratio
    fresh_m2 = sigma_m * (sigma_m - sigma_before_m + decorrelation * sigma_before_m)
    return carried, fresh_m2, np.where(ratio == 1.0, -decorrelation, carried - 1.0)


def before_steps(sigma_m: Floats, decorrelation: Floats, factor: float) -> Floats:
    """Sigma s_p of each source at the row before, for the recursion; shapes (n, sources).

    Before the first step of a source (a change of its sigma by more than `factor`) the row's own, as printed. Sources
    without memory have no step.
    """
    before = sigma_m
    for source, (sigma, lost) in enumerate(zip(sigma_m.T, decorrelation.T, strict=True)):
        if not sigma.size or sigma.max() <= factor * sigma.min():
            continue
        earlier = np.concatenate([sigma[:1], sigma[:-1]])
        is_step = np.maximum(sigma, earlier) > factor * np.minimum(sigma, earlier)
        is_step &= lost < 1.0
        if is_step.any():
            before = before.copy(order="F") if before is sigma_m else before
            before[:, source] = np.where(np.logical_or.accumulate(is_step), earlier, sigma)
    return before


def increment_variance(sigma_m: Floats, sigma_before_m: Floats, decorrelation: Floats) -> Floats:
    """Variance of the increments by all sources together [m^2], shape (n,); 2 R (1-phi) where R stays."""
    variance_m2 = np.zeros(len(sigma_m))
    for sigma, before, lost in _by_source(sigma_m, sigma_before_m, decorrelation):
        correlated = 2.0 * lost * sigma * before
        variance_m2 += correlated if _same(sigma, before) else (sigma - before) ** 2 + correlated
    return variance_m2


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

    def rows_between(self, low: int, high: int) -> AxisSeries:
        """The series of its rows [low, high) alone."""
        parts = {item.name: getattr(self, item.name)[low:high] for item in fields(self)}
        if self.sigma_before_m is self.sigma_m:
            parts["sigma_before_m"] = parts["sigma_m"]
        return AxisSeries(**parts)


Source = tuple[Floats, Floats]
"""An error that positions share from row to row: its deviation [m], and 1 - phi over the step to each row."""


def errors_of(sigma_m: Floats, dt_s: Floats, further: Sequence[Source], config: MonitorConfig) -> dict[str, Floats]:
    """The error fields of a series: four Gauss-Markov errors of positions of this sigma, and `further` ones.

    Error j of a share of the variance has sigma_j = sqrt(share_j) sigma and 1 - phi_j = 1 - exp(-dt / tau_j) (DIAG
    Table 1). Transposed into Fortran order, as the recursions go along the rows.
    """
    sources = [
        (np.sqrt(share) * sigma_m, -np.expm1(-dt_s / tau_s)) for share, tau_s in zip(*error_model(config), strict=True)
    ]
    sources += further
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
    """Values and sigmas of the monitors of one axis, from `state` or from a restart on.

    Args:
        series: increments of the axis, m rows.
        alphas: weights of the EWMAs over one second [1], shape (a,).
        state: what the recursions carry on from the row before; None: a restart.
        noise_m2: fast noise beyond the model [m^2], shape (m, 1 + a); None: none; where NaN, so is the sigma.

    Returns:
        Values and sigmas [m/s], shape (m, 1 + a): raw, then the EWMAs; and the state to carry on with.

    Source:
        DIAG eq. 4-9; DOMAIN section 3, rule 2.
    """
    noise_m2 = np.zeros((series.dt_s.size, 1 + alphas.size), order="F") if noise_m2 is None else noise_m2
    unknown = np.isnan(noise_m2)
    known_m2 = np.where(unknown, 0.0, noise_m2) if unknown.any() else noise_m2
    state = state or AxisState.at_restart(alphas.size, series.sigma_m.shape[1], series.lasting_mps.shape[1])
    moving = ~series.fresh
    # A row that restarts has weight, keep and gain 0: nothing of before is carried over it.
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
    sigma = np.sqrt(_stack_columns(raw_m2, averaged_m2))
    sigma[unknown] = np.nan
    carried = np.array([response[-1] for response in responses]).reshape(state.lasting.shape)
    return _stack_columns(series.rate_mps, ewma), sigma, AxisState(ewma[-1], *smooth, *fast, carried)


def _stack_columns(raw: Floats, averages: Floats) -> Floats:
    """The raw monitor's column before those of the averages, in Fortran order."""
    return np.vstack([raw[None, :], averages.T]).T


def _raw_variance(series: AxisSeries, increment_m2: Floats) -> Floats:
    """Variance of the raw rate (DIAG eq. 4-7 with correlated GNSS errors) [m^2/s^2]."""
    border = np.where(series.border, series.border_m2, 0.0)
    return np.asarray((increment_m2 + border) / series.dt_s**2 + (series.lasting_mps**2).sum(axis=1))


@frozen
class AlongEpochs:
    """Epochs with a position and an odometer, in order, and the errors there; all arrays of one length m.

    `doubt_m`: in the odometer's distance, a sum; `sigma_m`: of the Gauss-Markov errors; `digits_m`: how coarsely
    positions are written; `jitter_s`: scatter of the stamps; `white_m2_per_s`: what the odometer's distance gathers;
    `rows_m`: quantisation noise of its rows, `period_s` apart; None where no row of the run has any.
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
    rows_m: Floats | None
    period_s: Floats | float


def along_series(epochs: AlongEpochs, odometer: Increments, config: Configuration) -> AxisSeries:
    """Increments of GNSS minus odometer along the track, divided by their time, with their errors.

    Args:
        epochs: epochs with a position and an odometer, arrays of shape (m,).
        odometer: distance [m] and change of speed [m/s] from the epoch before, shape (m,).
        config: the configuration; used are `align.gap_reset_s` and `monitors`.

    Returns:
        The series, arrays of m rows.

    Source:
        DIAG eq. 1-3.
    """
    dt, fresh = time_steps(epochs.t_s, config.align.gap_reset_s)
    zero = np.zeros(dt.size)
    # New at each epoch: a stamp's error times the speed, and the digits. The odometer's rows lose theirs by and by.
    memoryless_m = np.hypot(epochs.jitter_s * odometer.distance_m / dt, epochs.digits_m)
    further = [(np.abs(memoryless_m), np.ones(dt.size))]
    if epochs.rows_m is not None:
        further.append((epochs.rows_m, _rows_decorrelation(dt, epochs.period_s, config.monitors)))
    return AxisSeries(
        epoch=epochs.epoch,
        fresh=fresh | (np.diff(epochs.doubt_m, prepend=epochs.doubt_m[:1]) != 0.0),
        border=np.zeros(dt.size, dtype=np.bool_),
        dt_s=dt,
        rate_mps=(np.diff(epochs.along_m, prepend=epochs.along_m[:1]) - odometer.distance_m) / dt,
        **errors_of(epochs.sigma_m, dt, further, config.monitors),
        white_m2=epochs.white_m2_per_s * dt,
        border_m2=zero,
        lasting_mps=np.vstack(
            [epochs.scale_sigma * odometer.distance_m / dt, epochs.latency_sigma_s * odometer.speed_mps / dt]
        ).T,
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
