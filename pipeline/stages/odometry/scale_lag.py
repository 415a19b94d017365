"""Scale and lag of a counter against another recorder of the same journey: one equation, however it is weighed.

way of the other = scale * way counted - scale * lag * change of speed,

with ways and speeds counted at the stamps less an assumed lag, and `lag` what is left of it: linear in scale and scale
* lag. The causal filter (`alignment.odometer_filter`) follows it from epoch to epoch. Calibration weighs observations
of whole runs, the fit of a run (`plausibility.pairs`) windows without outliers; both solve it here.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from schemas.arrays import Floats

# Numerics: with less independent information about scale and lag, as a share of the whole, they are not told apart.
_LEAST_INDEPENDENT = 1e-12


class ScaleLag(NamedTuple):
    """True over counted distance; stamp of the other recorder minus the counter's [s]; standard deviations."""

    scale: float
    scale_sigma: float
    lag_s: float
    lag_sigma_s: float


def scale_and_lag(normal: Floats, right: Floats, spread: float = 1.0, assumed_s: float = 0.0) -> ScaleLag | None:
    """Solve the normal equations (2, 2), (2,) of way counted and minus change of speed; None where they cannot be."""
    information = float(np.prod(np.diag(normal)))
    if not np.linalg.det(normal) > _LEAST_INDEPENDENT * information:
        return None
    covariance = spread**2 * np.linalg.inv(normal)
    scale, scaled_lag_s = np.linalg.solve(normal, right).tolist()
    if scale == 0.0:
        return None
    sigma, scaled_sigma_s = np.sqrt(np.diag(covariance)).tolist()
    return ScaleLag(scale, sigma, assumed_s + scaled_lag_s / scale, scaled_sigma_s / abs(scale))
