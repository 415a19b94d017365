"""May a position, or what is learned from it, be used again after an alarm? The one rule (DOMAIN section 4)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from schemas.arrays import Bools, Floats
from schemas.config import Configuration
from schemas.frozen import frozen

Number = TypeVar("Number", float, Floats)


@frozen
class RecoveryRule:
    """`recovery_s` without a fast failure, and GNSS minus odometer what it was at the anchor, within the bound."""

    config: Configuration

    @property
    def most_m(self) -> float:
        """Half of the failure limit [m]: no bound is wider, and no more may be in doubt."""
        return self.config.hazards.limits.relink_m

    def is_quiet(self, quiet_s: float | Floats) -> Bools:
        return np.asarray(quiet_s) >= self.config.lds.recovery_s

    def variance_m2(self, positions_m2: Number, elapsed_s: Number, way_m: Number, sigma_scale: float) -> Number:
        """What GNSS minus odometer moves by without a fault [m^2]; `positions_m2`: variances of both positions."""
        return positions_m2 + self.config.monitors.odometer_sigma_mps**2 * elapsed_s + (sigma_scale * way_m) ** 2

    def bound_m(self, variance_m2: float | Floats) -> Floats:
        """min(failure limit / 2, k_T sqrt(variance)) [m]."""
        factor = self.config.monitors.threshold_factor
        return np.minimum(self.most_m, factor * np.sqrt(variance_m2))
