"""Recursions along time: EWMA of the rates (DIAG eq. 8) and its exact variance (DOMAIN section 3), vectorised."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dtbtrs

from schemas.arrays import Floats
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
    band = np.ones((2, len(y)), order="F")
    for channel in range(y.shape[1]):
        np.negative(decay[1:, channel], out=band[1, :-1])
        y[:, channel : channel + 1], _ = dtbtrs(band, y[:, channel : channel + 1], uplo="L", diag="U", overwrite_b=1)
    return y


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
    carried, fresh_m2, change = _memory(sigma_m, sigma_before_m, decorrelation)
    coupling = np.empty_like(gain)
    covariances = np.empty_like(state.covariance)
    for index, before in enumerate(state.covariance):
        drive = np.asfortranarray(gain[:, index, None] * fresh_m2)
        covariance = _solved(keep[:, index, None] * carried, drive, before)
        coupling[1:, index] = (covariance[:-1] * change[1:]).sum(axis=1)
        coupling[:1, index] = (before * change[:1]).sum(axis=1)
        covariances[index] = covariance[-1]
    fresh = gain**2 * increment_m2[:, None] + 2.0 * gain * keep * coupling
    variance = linear_recurrence(keep**2, fresh, state.variance)
    # A sigma that falls quickly, though not by the step, can bring the printed recursion below what is new in it.
    new_m2 = (sigma_m**2 * decorrelation * (2.0 - decorrelation)).sum(axis=1) + white_m2
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
    before = np.concatenate([state.noise_covariance[None], covariance[:-1]])
    variance = linear_recurrence(keep**2, 2.0 * gain * (covariance - keep * before), state.noise_variance)
    # Noise that falls from one renewal to the next can bring this below what is new in it.
    return np.maximum(variance, gain * covariance), (variance[-1], covariance[-1])


def _memory(sigma_m: Floats, sigma_before_m: Floats, decorrelation: Floats) -> tuple[Floats, Floats, Floats]:
    """Of the recursion: phi r, s_k (s_k - phi s_p) and phi r - 1; shapes (n, sources)."""
    if np.array_equal(sigma_m, sigma_before_m):
        return 1.0 - decorrelation, sigma_m * (decorrelation * sigma_m), -decorrelation
    ratio = np.divide(sigma_m, sigma_before_m, out=np.ones_like(sigma_m), where=sigma_before_m > 0.0)
    carried = (1.0 - decorrelation) * ratio
    fresh_m2 = sigma_m * (sigma_m - sigma_before_m + decorrelation * sigma_before_m)
    return carried, fresh_m2, np.where(ratio == 1.0, -decorrelation, carried - 1.0)


def before_steps(sigma_m: Floats, decorrelation: Floats, factor: float) -> Floats:
    """Per source the sigma s_p at the row before, for the recursion; shapes (n, sources).

    Before the first step of a source (a change of its sigma by more than `factor`) the row's own, as printed. Sources
    without memory have no step.
    """
    before = sigma_m
    for source, (sigma, lost) in enumerate(zip(sigma_m.T, decorrelation.T, strict=True)):
        earlier = np.concatenate([sigma[:1], sigma[:-1]])
        is_step = np.maximum(sigma, earlier) > factor * np.minimum(sigma, earlier)
        is_step &= lost < 1.0
        if is_step.any():
            before = before.copy(order="F") if before is sigma_m else before
            before[:, source] = np.where(np.logical_or.accumulate(is_step), earlier, sigma)
    return before


def increment_variance(sigma_m: Floats, sigma_before_m: Floats, decorrelation: Floats) -> Floats:
    """Of all sources together [m^2]; shape (n,). 2 R (1-phi) where R stays."""
    correlated = 2.0 * decorrelation * sigma_m * sigma_before_m
    if np.array_equal(sigma_m, sigma_before_m):
        return np.asarray(correlated.sum(axis=1))
    return np.asarray(((sigma_m - sigma_before_m) ** 2 + correlated).sum(axis=1))
