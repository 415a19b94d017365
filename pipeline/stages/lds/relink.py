"""The re-link: is GNSS minus odometer what it was at the anchor? (DOMAIN section 4)

What the odometer may have miscounted widens the bound, up to half the failure limit; if that is more, only a telegram
re-links.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

import numpy as np

from pipeline.stages.lds.crossings import Crossing
from pipeline.stages.lds.journey import Journey
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.odometry.bound import is_lost
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
        whole = journey.doubt_m[crossing.epoch] == journey.doubt_m[crossing.before]
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
    """The one way back: what the position is compared with, and how. `tvb`: flags of the epochs so far.

    The anchor is fixed where the position is withheld. After an alarm, or slip that the odometer reports, it is the
    last telegram, else the first TVB of the mission: a slow drift has moved every later one. After time that nothing
    watched it is the last TVB before. A later return does not move it: from a return on the position is held to it
    until the slowest average of the restarted bank is full.
    """

    def __init__(self, journey: Journey, tvb: list[bool], config: Configuration) -> None:
        self._journey = journey
        self._tvb = tvb
        self._config = config
        self._rule = RecoveryRule(config)
        self._memory_ns = round(NS_PER_S / min(config.monitors.ewma_alphas))
        self.held: list[Held] = []
        self.begin_mission(0)

    def begin_mission(self, epoch: int) -> None:
        self._mission_from = epoch
        self._read: Anchor | None = None
        self._anchor: Anchor | None = None
        self._suspected = False
        self._hold_to_ns: int | None = None

    def note_read(self, read: Crossing) -> None:
        anchor = Anchor.at_crossing(self._journey, read, self._config.hazards.balise_read_sigma_m)
        if anchor is not None:
            self._read = self._anchor = anchor

    def withhold(self, epoch: int, suspected: bool) -> None:
        """Fix the anchor; `suspected`: by an alarm or slip, else nothing watched the position."""
        waits = self._hold_to_ns is None
        if suspected or not (self._suspected and (waits or self.is_held(epoch))):
            tvb = self._first_tvb(epoch) if suspected else self._last_tvb(epoch)
            kept = self._read is not None and (suspected or tvb is None or self._read.t_ns >= tvb.t_ns)
            self._anchor = self._read if kept else tvb
            self._suspected = suspected
        self._hold_to_ns = None

    def hold(self, epoch: int) -> None:
        """The position returns: from here on it is held to the anchor."""
        self._hold_to_ns = int(self._journey.t_ns[epoch]) + self._memory_ns

    def is_held(self, epoch: int) -> bool:
        return self._hold_to_ns is not None and int(self._journey.t_ns[epoch]) <= self._hold_to_ns

    def held_m(self, epoch: int) -> tuple[Floats, Floats]:
        """What the position moved since the anchor and may have [m], at each epoch of the hold from this one on."""
        assert self._hold_to_ns is not None
        assert self._anchor is not None
        end = int(np.searchsorted(self._journey.t_ns, self._hold_to_ns, side="right"))
        return self._moved_m(self._anchor, epoch, max(end, epoch))

    def compare(self, epoch: int) -> Comparison:
        """Is GNSS minus odometer at this epoch what it was at the anchor?"""
        anchor = self._anchor
        if not self._config.lds.relink:
            return Comparison(reason=NotEvaluated.RELINK_OFF)
        if anchor is None:
            return Comparison(reason=NotEvaluated.RELINK_NO_ANCHOR)
        doubt_m = float(self._journey.doubt_m[epoch] - self._journey.doubt_m[anchor.epoch])
        if is_lost(np.array(doubt_m)):
            return Comparison(reason=NotEvaluated.RELINK_DISTANCE_LOST)
        if self._journey.scale_sigma is None and not (anchor.is_read and anchor.epoch == epoch):
            return Comparison(reason=NotEvaluated.RELINK_NO_VEHICLE)
        if doubt_m > self._rule.most_m:
            # Slip at each start counts too much each time, and would soon explain any fault.
            return Comparison(reason=NotEvaluated.RELINK_SLIPPED)
        moved_m, bound_m = (float(values[0]) for values in self._moved_m(anchor, epoch, epoch + 1))
        comparison = Comparison(moved_m, bound_m)
        if comparison.holds:
            self.held.append(Held(epoch, None if anchor.is_read else anchor.epoch, moved_m, bound_m + doubt_m))
        return comparison

    def _moved_m(self, anchor: Anchor, epoch: int, end: int) -> tuple[Floats, Floats]:
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
        doubt_m = journey.doubt_m[at] - journey.doubt_m[anchor.epoch]
        known = doubt_m <= self._rule.most_m
        return np.where(known, moved_m, np.nan), np.minimum(self._rule.most_m, bound_m + doubt_m)

    def _first_tvb(self, epoch: int) -> Anchor | None:
        return self._at_tvb(range(self._mission_from, epoch))

    def _last_tvb(self, epoch: int) -> Anchor | None:
        return self._at_tvb(range(epoch - 1, self._mission_from - 1, -1))

    def _at_tvb(self, epochs: Iterable[int]) -> Anchor | None:
        """At the first of these epochs that is a TVB, where the odometer is known."""
        found = next((k for k in epochs if self._tvb[k] and self._journey.comparable[k]), None)
        return None if found is None else Anchor.at_epoch(self._journey, found)


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
