"""When a negated position comes back: the recovery time, then the re-link test (DOMAIN section 4)."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np

from pipeline.lds.bank_protocol import Bank, LdsLimits
from pipeline.lds.journey import Journey
from pipeline.lds.reads import Read
from schemas.config import LdsConfig


@dataclass(frozen=True, slots=True)
class Anchor:
    """A position that the diagnosis stands behind: GNSS minus odometer there, and its sigma [m]."""

    offset_m: float
    sigma_m: float
    t_ns: int
    travelled_m: float

    @classmethod
    def at_epoch(cls, journey: Journey, k: int) -> Anchor:
        return cls(
            float(journey.path_m[k] - journey.odometer_m[k]),
            float(journey.sigma_m[k]),
            int(journey.t_ns[k]),
            float(journey.travelled_m[k]),
        )


def relink_bound_m(anchor: Anchor, k: int, journey: Journey, limits: LdsLimits) -> float | None:
    """Bound on (GNSS - odometer) minus what it was at the anchor; `None` once nothing can be told.

    k_T sqrt(2 sigma_x^2 + sigma_odo^2 t + (sigma_scale d)^2), with the sigma of both epochs for
    2 sigma_x^2. Beyond the failure limit a persisting failure would pass: no re-link then.
    """
    waited_s = (int(journey.t_ns[k]) - anchor.t_ns) * 1e-9
    scale_m = float(journey.scale_sigma[k]) * (float(journey.travelled_m[k]) - anchor.travelled_m)
    variance_m2 = anchor.sigma_m**2 + float(journey.sigma_m[k]) ** 2
    variance_m2 += limits.odometer_sigma_mps**2 * waited_s + scale_m**2
    bound_m = limits.threshold_factor * sqrt(variance_m2)
    return bound_m if bound_m <= limits.failure_limit_m else None


def read_anchor(read: Read, journey: Journey) -> Anchor | None:
    """A physical balise says where the train is, so what GNSS minus odometer should be."""
    if read.odometer_m is None or not isfinite(read.travelled_m):
        return None
    sigma_m = float(np.nan_to_num(journey.sigma_m[read.epoch]))
    return Anchor(read.balise.path_m - read.odometer_m, sigma_m, read.t_ns, read.travelled_m)


class Recovery:
    """One negation: since when nothing has failed fast, and what was read of physical balises meanwhile."""

    def __init__(self, k: int, journey: Journey, bank: Bank, config: LdsConfig, limits: LdsLimits) -> None:
        self._journey, self._bank, self._limits = journey, bank, limits
        self._recovery_ns = config.recovery_s * 1e9
        self._failed_at_ns = self._seen_at_ns = int(journey.t_ns[k])
        self.read: Anchor | None = None

    def stand_on(self, read: Read) -> None:
        """From now on the re-link is measured from this balise."""
        self.read = read_anchor(read, self._journey) or self.read

    def is_over(self, k: int, t_ns: int, seen: bool, usable: bool, disordered: bool) -> bool:
        """`recovery_s` without a failure of the fast monitors, all of it seen, and a usable position now."""
        if seen:
            if t_ns - self._seen_at_ns > self._journey.gap_ns:
                self._failed_at_ns = t_ns
            self._seen_at_ns = t_ns
        if disordered or self._bank.fast_failed(k):
            self._failed_at_ns = t_ns
        return seen and usable and t_ns - self._failed_at_ns >= self._recovery_ns

    def relinks(self, k: int, anchor: Anchor) -> bool:
        """GNSS minus odometer is what it was at the anchor."""
        offset_m = float(self._journey.path_m[k] - self._journey.odometer_m[k])
        moved_m = abs(offset_m - anchor.offset_m)
        if moved_m > self._limits.failure_limit_m:
            return False
        bound_m = relink_bound_m(anchor, k, self._journey, self._limits)
        return bound_m is not None and moved_m <= bound_m
