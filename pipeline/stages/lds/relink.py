"""The re-link: is GNSS minus odometer what it was at the anchor? (DOMAIN section 4)

After an alarm the anchor is a TVB well before it, for a slow drift has moved the last one already; a return does not
move it, only a telegram does. After slip that the odometer reports no fault is suspected: the anchor is the last TVB
before it, but the first one while a position is held to that. What the odometer may have miscounted widens the bound,
up to half the failure limit; if that is more, only a telegram re-links.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

import numpy as np

from pipeline.stages.lds.crossings import Crossing
from pipeline.stages.lds.journey import Journey
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.odometry.recovery import RecoveryRule
from schemas.arrays import NS_PER_S, Floats
from schemas.config import Configuration
from schemas.enums import BaliseKind, NotEvaluated


@dataclass(frozen=True, slots=True)
class Anchor:
    """GNSS minus odometer [m] where it was trusted: at a TVB, or a telegram. `sigma_m`: of the position or the read."""

    epoch: int
    t_ns: int
    offset_m: float
    sigma_m: float
    travelled_m: float
    is_read: bool = False

    @classmethod
    def at_epoch(cls, journey: Journey, epoch: int) -> Anchor:
        offset_m = float(journey.path_m[epoch] - journey.odometer_m[epoch])
        return cls(
            epoch, int(journey.t_ns[epoch]), offset_m, float(journey.sigma_m[epoch]), float(journey.travelled_m[epoch])
        )

    @classmethod
    def at_crossing(cls, journey: Journey, crossing: Crossing, sigma_m: float) -> Anchor | None:
        """By the balise's own place; None where the odometer is not known there."""
        whole = journey.segment[crossing.epoch] == journey.segment[crossing.before]
        if crossing.odometer_m is None or not whole or not isfinite(crossing.travelled_m):
            return None
        offset_m = crossing.balise.path_m - crossing.odometer_m
        is_read = crossing.balise.kind is BaliseKind.PHYSICAL
        return cls(crossing.epoch, crossing.t_ns, offset_m, sigma_m, crossing.travelled_m, is_read)


@dataclass(frozen=True, slots=True)
class Comparison:
    """How far GNSS minus odometer moved since the anchor, and may have; else why nothing can be said."""

    moved_m: float = np.nan
    bound_m: float = np.nan
    reason: NotEvaluated | None = None

    @property
    def holds(self) -> bool:
        return self.reason is None and abs(self.moved_m) <= self.bound_m


class Held(NamedTuple):
    """A re-link that held: at which epoch, against the position of which one (None: a telegram)."""

    epoch: int
    anchor_epoch: int | None
    moved_m: float
    bound_m: float


class Relink:
    """The anchor of one solution, and the comparison with it. `tvb`: flags of the epochs so far."""

    def __init__(self, journey: Journey, tvb: list[bool], config: Configuration) -> None:
        self._journey = journey
        self._tvb = tvb
        self._config = config
        self._rule = RecoveryRule(config)
        self._fixed: Anchor | None = None  # by an alarm or a telegram
        self._alarmed = False
        self._mission_from = 0
        self.held: list[Held] = []

    def begin_mission(self, epoch: int) -> None:
        self._fixed = None
        self._alarmed = False
        self._mission_from = epoch

    def note_read(self, read: Crossing) -> None:
        self._fixed = Anchor.at_crossing(self._journey, read, self._config.hazards.balise_read_sigma_m) or self._fixed

    def note_alarm(self, epoch: int, memory_s: float = 0.0) -> None:
        """The first alarm with an anchor before it fixes that. `memory_s`: the drift may be so old."""
        self._fixed = self.anchor_at(epoch, memory_s)
        self._alarmed = self._fixed is not None

    def anchor_at(self, epoch: int, least_s: float = 0.0) -> Anchor | None:
        """Before the first alarm: the last TVB `anchor_lag_s` before `epoch`, else the first TVB, or a later read."""
        lag_s = max(self._config.lds.anchor_lag_s, least_s)
        return self._fixed if self._alarmed else self._last_validated(epoch, lag_s)

    def anchor_before_slip(self, epoch: int) -> Anchor | None:
        """The last TVB before slip that began at `epoch`, or a later telegram."""
        return self._last_validated(epoch, 0.0)

    def _last_validated(self, epoch: int, lag_s: float) -> Anchor | None:
        """The last TVB `lag_s` before `epoch`, else the first of the mission; or a later telegram."""
        tvbs = self._mission_from + np.flatnonzero(self._tvb[self._mission_from : epoch])
        if not tvbs.size:
            return self._fixed
        old_ns = int(self._journey.t_ns[epoch]) - round(lag_s * NS_PER_S)
        last_old = int(np.searchsorted(self._journey.t_ns[tvbs], old_ns, side="right")) - 1
        tvb = Anchor.at_epoch(self._journey, int(tvbs[max(last_old, 0)]))
        return tvb if self._fixed is None or tvb.t_ns > self._fixed.t_ns else self._fixed

    def compare(self, epoch: int, anchor: Anchor | None) -> Comparison:
        if not self._config.lds.relink:
            return Comparison(reason=NotEvaluated.RELINK_OFF)
        if anchor is None:
            return Comparison(reason=NotEvaluated.RELINK_NO_ANCHOR)
        if self._journey.counter[anchor.epoch] != self._journey.counter[epoch]:
            return Comparison(reason=NotEvaluated.RELINK_DISTANCE_LOST)
        if self._journey.scale_sigma is None and not (anchor.is_read and anchor.epoch == epoch):
            return Comparison(reason=NotEvaluated.RELINK_NO_VEHICLE)
        doubt_m = float(self._journey.slip_doubt_m[epoch] - self._journey.slip_doubt_m[anchor.epoch])
        if doubt_m > self._rule.most_m:
            # Slip at each start counts too much each time, and would soon explain any fault.
            return Comparison(reason=NotEvaluated.RELINK_SLIPPED)
        moved_m, bound_m = (float(values[0]) for values in self.moved_m(anchor, epoch, epoch + 1))
        comparison = Comparison(moved_m, bound_m)
        if comparison.holds:
            self.held.append(Held(epoch, None if anchor.is_read else anchor.epoch, moved_m, bound_m + doubt_m))
        return comparison

    def moved_m(self, anchor: Anchor, epoch: int, end: int) -> tuple[Floats, Floats]:
        """How far GNSS minus odometer moved since the anchor at these epochs, and how far it may have [m].

        NaN where the odometer lost its distance, or may have miscounted too much through slip.
        """
        journey = self._journey
        at = slice(epoch, end)
        moved_m = journey.path_m[at] - journey.odometer_m[at] - anchor.offset_m
        waited_s = (journey.t_ns[at] - anchor.t_ns) / NS_PER_S
        way_m = journey.travelled_m[at] - anchor.travelled_m
        positions_m2 = anchor.sigma_m**2 + journey.sigma_m[at] ** 2
        bound_m = self._rule.bound_m(self._rule.variance_m2(positions_m2, waited_s, way_m, journey.scale_sigma or 0.0))
        doubt_m = journey.slip_doubt_m[at] - journey.slip_doubt_m[anchor.epoch]
        known = (journey.counter[at] == journey.counter[anchor.epoch]) & (doubt_m <= self._rule.most_m)
        return np.where(known, moved_m, np.nan), np.minimum(self._rule.most_m, bound_m + doubt_m)


class Recovery:
    """While the position is negated: for how long no fast monitor has failed."""

    def __init__(self, journey: Journey, bank: MonitorBank, config: Configuration) -> None:
        self._journey = journey
        self._bank = bank
        self._rule = RecoveryRule(config)
        self._failed_at_ns = self._observed_at_ns = 0

    def begin(self, epoch: int) -> None:
        self._failed_at_ns = self._observed_at_ns = int(self._journey.t_ns[epoch])

    def is_over(self, epoch: int, evaluated: bool, failing: bool) -> bool:
        """`recovery_s` without a failure of the raw and fastest monitors, observed without a gap, and usable now.

        Observed is an epoch with a verdict of `along_raw` (`evaluated`); without an odometer, with a usable position.
        """
        t_ns = int(self._journey.t_ns[epoch])
        usable = bool(self._journey.usable[epoch])
        observed = evaluated if self._journey.has_odometer else usable
        if observed:
            if t_ns - self._observed_at_ns > self._journey.gap_ns[epoch]:
                self._failed_at_ns = t_ns
            self._observed_at_ns = t_ns
        if failing or self._bank.fast_failed(epoch):
            self._failed_at_ns = t_ns
        quiet = bool(self._rule.is_quiet((t_ns - self._failed_at_ns) / NS_PER_S))
        return observed and usable and quiet
