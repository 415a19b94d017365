"""May a negated position return? Recovery time and re-link (DOMAIN section 4).

The position returns only where GNSS minus odometer is what it was at the *anchor*. A slow drift has moved the last TVB
before an alarm already, so the anchor lies `anchor_lag_s` before the first alarm; alarms that follow may be about the
same fault, so a return does not move it. A physical balise says where the train is: only a telegram renews the anchor.
The same test decides on the first position after an outage over which the bank began anew (`breaks`), or after noise
that hid for as long what the position does, for nobody looked on meanwhile, and after slip that the odometer reports.
No alarm stands there, so that the last TVB is the anchor. A
wheel that slips is counted wrongly: that widens the bound, up to half the failure limit; if the count may be off by
more, there is no re-link but at a telegram.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple

import numpy as np

from pipeline.stages.lds.crossings import Crossing
from pipeline.stages.lds.journey import Journey
from pipeline.stages.monitors.bank import MonitorBank
from pipeline.stages.odometry.drift import drift_m2, relink_bound_m
from schemas.arrays import NS_PER_S, Ints
from schemas.config import Configuration, LdsConfig
from schemas.enums import BaliseKind, NotEvaluated

SWITCHED_OFF = NotEvaluated.RELINK_OFF
NO_ANCHOR = NotEvaluated.RELINK_NO_ANCHOR
LOST = NotEvaluated.RELINK_DISTANCE_LOST
SLIPPED = NotEvaluated.RELINK_SLIPPED
NO_VEHICLE = NotEvaluated.RELINK_NO_VEHICLE


@dataclass(frozen=True, slots=True)
class Anchor:
    """GNSS minus odometer [m] where it was trusted: at a TVB, or at a telegram of a physical balise.

    `sigma_m`: of the position, or of the read. `epoch`: of a telegram the first one at or after it.
    """

    epoch: int
    t_ns: int
    offset_m: float
    sigma_m: float
    travelled_m: float
    segment: int
    counter: int
    slip_doubt_m: float
    is_read: bool = False

    @classmethod
    def at_epoch(cls, journey: Journey, k: int) -> Anchor:
        return cls(
            epoch=k,
            t_ns=int(journey.t_ns[k]),
            offset_m=float(journey.path_m[k] - journey.odometer_m[k]),
            sigma_m=float(journey.sigma_m[k]),
            travelled_m=float(journey.travelled_m[k]),
            segment=int(journey.segment[k]),
            counter=int(journey.counter[k]),
            slip_doubt_m=float(journey.slip_doubt_m[k]),
        )

    @classmethod
    def at_crossing(cls, journey: Journey, crossing: Crossing, sigma_m: float) -> Anchor | None:
        """The balise's own place against the odometer; None where that is not known, or its distance was lost there."""
        k = crossing.epoch
        whole = journey.segment[k] == journey.segment[crossing.before]
        if crossing.odometer_m is None or not whole or not isfinite(crossing.travelled_m):
            return None
        return cls(
            epoch=k,
            t_ns=crossing.t_ns,
            offset_m=crossing.balise.path_m - crossing.odometer_m,
            sigma_m=sigma_m,
            travelled_m=crossing.travelled_m,
            segment=int(journey.segment[k]),
            counter=int(journey.counter[k]),
            slip_doubt_m=float(journey.slip_doubt_m[k]),
            is_read=crossing.balise.kind is BaliseKind.PHYSICAL,
        )


@dataclass(frozen=True, slots=True)
class Comparison:
    """How far GNSS minus odometer moved since the anchor, and how far it may have; else why nothing can be told."""

    moved_m: float = np.nan
    bound_m: float = np.nan
    reason: NotEvaluated | None = None

    @property
    def holds(self) -> bool:
        """The position is where the anchor and the odometer expect it."""
        return self.reason is None and abs(self.moved_m) <= self.bound_m


class Held(NamedTuple):
    """A re-link that held: at which epoch, against the position of which one (None: a telegram)."""

    epoch: int
    anchor_epoch: int | None
    moved_m: float
    bound_m: float


class Relink:
    """The anchor of one solution, and the comparison with it. `tvb`: flags of the epochs, as far as they are known."""

    def __init__(self, journey: Journey, tvb: list[bool], config: Configuration) -> None:
        self._journey, self._tvb, self._config = journey, tvb, config
        self._factor = config.monitors.threshold_factor
        self._anchor: Anchor | None = None
        self._before_slip: Anchor | None = None
        self._alarmed = False
        self._mission_from = 0
        self.held: list[Held] = []

    def begin_mission(self, k: int) -> None:
        """What was before epoch `k` does not count."""
        self._anchor = self._before_slip = None
        self._alarmed = False
        self._mission_from = k

    def note_read(self, read: Crossing) -> None:
        """A telegram says where the train is."""
        anchor = Anchor.at_crossing(self._journey, read, self._config.hazards.balise_read_sigma_m)
        if anchor is not None:
            self._anchor = self._before_slip = anchor

    def note_slip(self, k: int) -> None:
        """Nothing watches the position from epoch `k` on: it has to re-link to what was validated last before."""
        self._before_slip = self.anchor_at(k, 0.0)

    def note_alarm(self, k: int) -> None:
        """The first alarm with an anchor before it fixes that; only a telegram moves it from there."""
        self._anchor = self.anchor_at(k)
        self._alarmed = self._anchor is not None

    def anchor_at(self, k: int, lag_s: float | None = None) -> Anchor | None:
        """Before the first alarm: the last TVB `lag_s` before epoch `k`, else the first TVB, or a later read.

        `lag_s`: `anchor_lag_s` unless given.
        """
        if self._alarmed:
            return self._anchor
        lag_s = self._config.lds.anchor_lag_s if lag_s is None else lag_s
        old_ns = int(self._journey.t_ns[k]) - round(lag_s * NS_PER_S)
        tvbs = self._mission_from + np.flatnonzero(self._tvb[self._mission_from : k])
        if not tvbs.size:
            return self._anchor
        last_old = int(np.searchsorted(self._journey.t_ns[tvbs], old_ns, side="right")) - 1
        tvb = Anchor.at_epoch(self._journey, int(tvbs[max(last_old, 0)]))
        return tvb if self._anchor is None or tvb.t_ns > self._anchor.t_ns else self._anchor

    def compare(self, k: int, *, slipped: bool = False) -> Comparison:
        """Hold the position at epoch `k` against the anchor; `slipped`: after slip that no alarm went before."""
        begun_before = slipped and not self._alarmed
        anchor = self._before_slip if begun_before else self.anchor_at(k)
        if not self._config.lds.relink:
            return Comparison(reason=SWITCHED_OFF)
        if anchor is None:
            return Comparison(reason=NO_ANCHOR)
        if anchor.counter != self._journey.counter[k]:
            return Comparison(reason=LOST)
        if self._journey.scale_sigma is None and not (anchor.is_read and anchor.epoch == k):
            return Comparison(reason=NO_VEHICLE)
        offset_m = float(self._journey.path_m[k] - self._journey.odometer_m[k])
        most_m = 0.5 * self._config.hazards.failure_limit_m
        doubt_m = float(self._journey.slip_doubt_m[k]) - anchor.slip_doubt_m
        if doubt_m > most_m:
            return Comparison(reason=SLIPPED)
        # What slip explains is no fault of the position; yet with both halves a fault stays within the failure limit.
        found = Comparison(offset_m - anchor.offset_m, min(most_m, self._bound_m(anchor, k) + doubt_m))
        if found.holds:
            self.held.append(Held(k, None if anchor.is_read else anchor.epoch, found.moved_m, found.bound_m + doubt_m))
        return found

    def _bound_m(self, anchor: Anchor, k: int) -> float:
        """min(failure limit / 2, k_T sqrt(2 sigma_x^2 + sigma_odo^2 t + (sigma_scale d)^2)) (DOMAIN section 4).

        2 sigma_x^2 is the sum of both variances: of the anchor, and of the position now.
        """
        waited_s = (int(self._journey.t_ns[k]) - anchor.t_ns) / NS_PER_S
        way_m = float(self._journey.travelled_m[k]) - anchor.travelled_m
        positions_m2 = anchor.sigma_m**2 + float(self._journey.sigma_m[k]) ** 2
        monitors, scale_sigma = self._config.monitors, self._journey.scale_sigma or 0.0
        variance_m2 = drift_m2(positions_m2, waited_s, way_m, monitors.odometer_sigma_mps, scale_sigma)
        return float(relink_bound_m(variance_m2, self._factor, self._config.hazards.failure_limit_m))


class Recovery:
    """One negation: since when nothing has failed fast."""

    def __init__(self, k: int, journey: Journey, bank: MonitorBank, config: LdsConfig) -> None:
        self._journey, self._bank = journey, bank
        self._recovery_ns = config.recovery_s * NS_PER_S
        self._failed_at_ns = self._seen_at_ns = int(journey.t_ns[k])

    def is_over(self, k: int, evaluated: bool, failing: bool) -> bool:
        """`recovery_s` without a failure of the raw and fastest monitors, all of it seen, and a usable position now.

        Without an odometer there is no along bank to look on; the position itself has to do.
        """
        t_ns = int(self._journey.t_ns[k])
        seen = evaluated if self._journey.has_odometer else bool(self._journey.usable[k])
        if seen:
            if t_ns - self._seen_at_ns > self._journey.gap_ns:
                self._failed_at_ns = t_ns
            self._seen_at_ns = t_ns
        if failing or self._bank.fast_failed(k):
            self._failed_at_ns = t_ns
        return seen and bool(self._journey.usable[k]) and t_ns - self._failed_at_ns >= self._recovery_ns


def breaks(journey: Journey, after_outages: Ints) -> frozenset[int]:
    """The first usable epochs after outages of position or odometer over which the bank began anew.

    A position whose track is in doubt is not used, but the bank goes on watching it: that is no outage.
    """
    usable = np.flatnonzero(journey.comparable & journey.usable)
    rows = np.searchsorted(usable, after_outages)
    return frozenset(usable[rows[rows < usable.size]].tolist())
