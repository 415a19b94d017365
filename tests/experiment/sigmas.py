"""Sigmas of EWMA monitors by the replay's own recursion and by the closed form, beside the experiment's bank."""

from __future__ import annotations

import numpy as np

from pipeline.stages.monitors.axis import AxisState, increment_variance, variance_of_ewma
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
    """Sigma of the EWMAs of a rate [m/s], epochs after a restart by alphas, by the recursion of the replay's own bank.

    `variances_m2`, `taus_s`: Gauss-Markov errors of the position along the axis. `white_m`: white noise on
    increments over 1 s, growing with the root of the step; `position_white_m`: white noise on position,
    which is a Gauss-Markov error with no memory. Alpha 1 is the raw monitor.
    """
    sigma_m, loss = _sources(variances_m2, taus_s, position_white_m, rate_hz)
    sigma_m, loss = (np.broadcast_to(one, (epochs, one.size)) for one in (sigma_m, loss))
    keep = np.broadcast_to((1.0 - alphas) ** (1.0 / rate_hz), (epochs, alphas.size))
    white_m2 = np.full(epochs, white_m**2 / rate_hz)
    increment_m2 = increment_variance(sigma_m, sigma_m, loss) + white_m2
    errors = (sigma_m, sigma_m, loss)
    restart = AxisState.at_restart(alphas.size, sigma_m.shape[1])
    variance, _ = variance_of_ewma(keep, (1.0 - keep) * rate_hz, *errors, increment_m2, white_m2, restart)
    return np.sqrt(variance)


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
    sigma_m, loss = _sources(variances_m2, taus_s, position_white_m, rate_hz)
    variance = sigma_m**2
    sources = 2.0 * variance * loss - 2.0 * variance * loss**2 * keep / (1.0 - keep * (1.0 - loss))
    total = sources.sum(axis=1) + white_m**2 / rate_hz
    return np.asarray(np.sqrt(rate_hz**2 * alpha / (2.0 - alpha) * total))


def _sources(variances_m2: Floats, taus_s: Floats, position_white_m: float, rate_hz: float) -> tuple[Floats, Floats]:
    """Sigma of each error of the position [m], and what an epoch decorrelates of it; the last has no memory."""
    return np.append(np.sqrt(variances_m2), position_white_m), np.append(-np.expm1(-1.0 / (rate_hz * taus_s)), 1.0)
