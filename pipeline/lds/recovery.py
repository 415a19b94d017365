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
    """A position that the diagnosis stands behind: GNSS minus odometer there, and its sigma [m].

    `scale_sigma`: as known there, since what is learned later does not mend the way run before. `speed_mps`: by how
    much the latency shifts it, per second; zero for a balise that was read. `slack_m`: location accuracy of such a
    balise.
    """

    offset_m: float
    sigma_m: float
    t_ns: int
    travelled_m: float
    stretch: int
    scale_sigma: float
    speed_mps: float = 0.0
    slack_m: float = 0.0

    @classmethod
    def at_epoch(cls, journey: Journey, k: int) -> Anchor:
        return cls(
            float(journey.path_m[k] - journey.odometer_m[k]),
            float(journey.sigma_m[k]),
            int(journey.t_ns[k]),
            float(journey.travelled_m[k]),
            int(journey.stretch[k]),
            float(journey.scale_sigma[k]),
            float(journey.speed_mps[k]),
        )


def moved_m(anchor: Anchor, k: int, journey: Journey) -> float:
    """(GNSS - odometer) at epoch `k` minus what it was at the anchor."""
    return float(journey.path_m[k] - journey.odometer_m[k]) - anchor.offset_m


def noise_bound_m(anchor: Anchor, k: int, journey: Journey, limits: LdsLimits) -> float:
    """By how much GNSS minus odometer moves from the anchor to epoch `k` without a fault.

    k_T sqrt(2 sigma_x^2 + sigma_odo^2 t + (sigma_scale d)^2) (DOMAIN section 4), with the sigma of both epochs for
    2 sigma_x^2; beside it what an uncertain latency makes of a change of speed (DOMAIN section 3).
    """
    waited_s = (int(journey.t_ns[k]) - anchor.t_ns) * 1e-9
    scale_m = max(anchor.scale_sigma, float(journey.scale_sigma[k])) * (
        float(journey.travelled_m[k]) - anchor.travelled_m
    )
    variance_m2 = anchor.sigma_m**2 + float(journey.sigma_m[k]) ** 2
    latency_m = float(journey.latency_sigma_s[k]) * (float(journey.speed_mps[k]) - anchor.speed_mps)
    variance_m2 += limits.odometer_sigma_mps**2 * waited_s + scale_m**2 + latency_m**2
    return limits.threshold_factor * sqrt(variance_m2)


def relink_bound_m(anchor: Anchor, k: int, journey: Journey, limits: LdsLimits) -> float | None:
    """The bound of the re-link; `None` once it is beyond the failure limit: a persisting failure would pass.

    Where the odometer lost its distance since the anchor, any would.
    """
    if anchor.stretch != journey.stretch[k]:
        return None
    bound_m = noise_bound_m(anchor, k, journey, limits)
    return bound_m if bound_m <= limits.failure_limit_m else None


def read_anchor(read: Read, journey: Journey) -> Anchor | None:
    """A physical balise says where the train is, so what GNSS minus odometer should be."""
    if read.odometer_m is None or not isfinite(read.travelled_m):
        return None
    return Anchor(
        offset_m=read.balise.path_m - read.odometer_m,
        sigma_m=float(np.nan_to_num(journey.sigma_m[read.epoch])),
        t_ns=read.t_ns,
        travelled_m=read.travelled_m,
        stretch=read.stretch,
        scale_sigma=float(journey.scale_sigma[read.epoch]),
        slack_m=read.balise.accuracy_m,
    )


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
        bound_m = relink_bound_m(anchor, k, self._journey, self._limits)
        return bound_m is not None and abs(moved_m(anchor, k, self._journey)) <= bound_m
