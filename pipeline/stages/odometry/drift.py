"""By how much GNSS minus odometer moves between two instants without a fault (DOMAIN section 4)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from schemas.arrays import Floats

Number = TypeVar("Number", float, Floats)


def drift_m2(positions_m2: Number, elapsed_s: Number, way_m: Number, sigma_odo_m: float, sigma_scale: float) -> Number:
    """Variance 2 sigma_x^2 + sigma_odo^2 t + (sigma_scale d)^2 [m^2].

    `positions_m2`: 2 sigma_x^2, the sum of the variances of both positions; `elapsed_s` and `way_m`: time and way
    between them; `sigma_odo_m`: of the odometer over one second, as configured; `sigma_scale`: of its scale.
    """
    return positions_m2 + sigma_odo_m**2 * elapsed_s + (sigma_scale * way_m) ** 2


def relink_bound_m(variance_m2: float | Floats, factor: float, failure_limit_m: float) -> Floats:
    """min(failure limit / 2, k_T sqrt(variance)) [m]: beyond it a position does not return; `factor` is k_T."""
    return np.minimum(0.5 * failure_limit_m, factor * np.sqrt(variance_m2))
