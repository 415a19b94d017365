"""Shares of time, outages and time between outages of one solution's epochs.

A state at an epoch holds until the next one; across a gap nothing is known to hold. All functions
take the epochs' times as int64 nanoseconds in order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.config import LdsConfig

# CONTRACT section 3, `outages`: what is longer lacks an epoch.
GAP_PERIODS = 1.5


@dataclass(frozen=True)
class Uptime:
    """How long a condition held, and how often it was lost after it had held."""

    up_s: float
    losses: int

    @property
    def mean_time_between_losses_h(self) -> float | None:
        """None without a loss: that only says that it is longer than the time observed."""
        return self.up_s / self.losses / 3600.0 if self.losses and self.up_s > 0 else None


def nominal_period_s(t_ns: Ints) -> float | None:
    """Median distance of consecutive epochs [s]; None for fewer than two."""
    return float(np.median(np.diff(t_ns))) / NS_PER_S if len(t_ns) > 1 else None


def linking_gap_s(period_s: float | None, crossing_gap_s: float = 1.0) -> float:
    """Longest time between epochs [s] over which a movement is interpolated (DOMAIN section 4)."""
    return max(GAP_PERIODS * (period_s or 0.0), crossing_gap_s)


def crossing_gap_ns(t_ns: Ints, lds: LdsConfig) -> int:
    """The same of these epochs, as configured [ns]: for so long at most a position stands for what comes before it."""
    return round(linking_gap_s(nominal_period_s(t_ns), lds.crossing_gap_s) * NS_PER_S)


def gap_limit_s(period_s: float | None, gap_reset_s: float) -> float:
    """Longest distance of epochs [s] that is not yet a gap (CONTRACT section 3, `outages`)."""
    return min(gap_reset_s, linking_gap_s(period_s))


def outages_s(t_ns: Ints, usable: Bools, limit_s: float) -> Floats:
    """Lengths [s] of the stretches over `limit_s` without a usable epoch, in order of time.

    From one usable epoch to the next; at the ends from the first and to the last epoch.
    """
    bounds = np.concatenate([t_ns[:1], t_ns[usable], t_ns[-1:]])
    stretches = np.diff(bounds) / NS_PER_S
    return stretches[stretches > limit_s]


def uptime(t_ns: Ints, good: Bools, limit_s: float) -> Uptime:
    """Time during which `good` held [s], and its losses: outages that followed upon a good epoch."""
    held = t_ns[good]
    stretches = np.diff(np.concatenate([held, t_ns[-1:]])) / NS_PER_S
    lost = stretches > limit_s
    return Uptime(float(stretches[~lost].sum()), int(lost.sum()))


def held_s(t_ns: Ints, limit_s: float) -> Floats:
    """For how long the state of each epoch is known to hold [s]: to the next epoch, 0 before a gap."""
    steps = np.diff(t_ns, append=t_ns[-1:]) / NS_PER_S
    return np.where(steps <= limit_s, steps, 0.0)


def share_of_time(held: Floats, where: Bools) -> float | None:
    """Share of the time held that `where` covers; None without any."""
    total = held.sum()
    return min(1.0, float(held[where].sum() / total)) if total > 0 else None


def availability(t_ns: Ints, valid: Bools, moving: Bools, limit_s: float) -> float | None:
    """Share of moving time, gaps included, during which `valid` held; None if it never moved.

    `moving[k]` says whether the train moved from epoch k to the next. A gap is time without validity.
    """
    if len(t_ns) < 2:
        return None
    steps = np.diff(t_ns) / NS_PER_S
    total = steps[moving[:-1]].sum()
    held = held_s(t_ns, limit_s)[:-1]
    return min(1.0, float(held[moving[:-1] & valid[:-1]].sum() / total)) if total > 0 else None
