"""Exact standard deviations of EWMA monitors at a constant rate and sigma (DOMAIN section 3)."""

from __future__ import annotations

import numpy as np

from pipeline.monitors.recursion import linear_recurrence
from schemas.arrays import Floats


def bank_sigmas(
    alphas: Floats,
    epochs: int,
    variances_m2: Floats,
    taus_s: Floats,
    white_m: float,
    position_white_m: float,
    rate_hz: float = 1.0,
) -> Floats:
    """Sigma of the EWMAs of a rate [m/s], epochs after a restart by alphas (DOMAIN section 3).

    `variances_m2`, `taus_s`: Gauss-Markov errors of the position along the axis. `white_m`: white noise on
    increments over 1 s, growing with the root of the step; `position_white_m`: white noise on position,
    which is a Gauss-Markov error with no memory. Alpha 1 is the raw monitor.
    """
    variance = np.append(variances_m2, position_white_m**2)
    loss = np.append(-np.expm1(-1.0 / (rate_hz * taus_s)), 1.0)
    keep = (1.0 - alphas) ** (1.0 / rate_hz)
    gain = (1.0 - keep) * rate_hz
    decay = np.outer(keep, 1.0 - loss).ravel()
    drive = np.outer(gain, variance * loss).ravel()
    shape = (epochs, alphas.size, variance.size)
    covariance = linear_recurrence(
        np.broadcast_to(decay, (epochs, decay.size)),
        np.broadcast_to(drive, (epochs, drive.size)),
        np.zeros(decay.size),
    ).reshape(shape)
    before = np.concatenate([np.zeros((1, *shape[1:])), covariance[:-1]])
    increment = 2.0 * float(variance @ loss) + white_m**2 / rate_hz
    fresh = gain**2 * increment - 2.0 * gain * keep * (before @ loss)
    kept = np.broadcast_to(keep**2, fresh.shape)
    return np.asarray(np.sqrt(linear_recurrence(kept, fresh, np.zeros(alphas.size))))


def limit_sigmas(
    alphas: Floats,
    variances_m2: Floats,
    taus_s: Floats,
    white_m: float,
    position_white_m: float,
    rate_hz: float = 1.0,
) -> Floats:
    """The same long after the restart: the closed form of DOMAIN section 3, for any alpha in (0, 1]."""
    alpha = 1.0 - (1.0 - alphas) ** (1.0 / rate_hz)
    keep = 1.0 - alpha[:, None]
    variance = np.append(variances_m2, position_white_m**2)
    loss = np.append(-np.expm1(-1.0 / (rate_hz * taus_s)), 1.0)
    sources = 2.0 * variance * loss - 2.0 * variance * loss**2 * keep / (1.0 - keep * (1.0 - loss))
    total = sources.sum(axis=1) + white_m**2 / rate_hz
    return np.asarray(np.sqrt(rate_hz**2 * alpha / (2.0 - alpha) * total))
