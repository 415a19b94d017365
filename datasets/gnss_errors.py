"""Correlated errors: sums of first-order Gauss-Markov processes as in DIAG Table 1."""

from __future__ import annotations

import numpy as np

from pipeline.stages.monitors.axis import linear_recurrence
from schemas.arrays import Floats
from schemas.frozen import frozen


@frozen
class Process:
    """A stationary first-order Gauss-Markov process: its share of the variance and its correlation time."""

    share: float
    tau_s: float


# DIAG Table 1 at 45 degrees of elevation: ionosphere, troposphere, orbit and clock, user (DOMAIN section 3).
# The shares are rounded there to a sum of 0.999; the user's takes the rest, so that the stated sigma is the true one.
POSITION_PROCESSES: tuple[Process, ...] = (
    Process(0.083, 360.0),
    Process(0.014, 1800.0),
    Process(0.150, 3600.0),
    Process(0.753, 100.0),
)


def gauss_markov(
    sigma: Floats | float, tau_s: float, step_s: float, shape: tuple[int, ...], rng: np.random.Generator
) -> Floats:
    """A stationary process along the first axis of `shape`, one independent path per column.

    Exact at any step: x_k = phi x_(k-1) + sqrt(1 - phi^2) w_k with phi = exp(-step / tau).
    """
    phi = float(np.exp(-step_s / tau_s))
    drive = rng.standard_normal(shape)
    drive[1:] *= np.sqrt(1.0 - phi * phi)
    columns = drive.reshape(len(drive), -1)
    path = linear_recurrence(np.broadcast_to(phi, columns.shape), columns, np.zeros(columns.shape[1]))
    return path.reshape(shape) * sigma


def position_errors(
    sigmas_m: tuple[float, float, float], epochs: int, step_s: float, rng: np.random.Generator
) -> Floats:
    """Errors east, north, up [m], shape (epochs, 3), whose variance is the square of the given sigmas."""
    total = np.zeros((epochs, 3))
    for process in POSITION_PROCESSES:
        sigma = np.sqrt(process.share) * np.asarray(sigmas_m)
        total += gauss_markov(sigma, process.tau_s, step_s, (epochs, 3), rng)
    return total
