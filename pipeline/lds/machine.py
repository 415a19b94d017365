"""The location determination system as a state machine over the epochs of one solution.

States: *initialising* (no reference, no linking), *linked* (reference known, position in use),
*odometry* (reference known, no usable position just now), *fail-safe* (position negated).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, isnan
from typing import Literal

import numpy as np

from pipeline.lds.bank_protocol import Bank, LdsLimits
from pipeline.lds.crossings import Balise, Crossing, Seen, find_crossings
from pipeline.lds.journey import Journey
from pipeline.lds.link_monitors import (
    NO_REFERENCE,
    Anchor,
    LinkRecord,
    disorder,
    distance_threshold_m,
    relink_bound_m,
)
from pipeline.lds.linking import LinkingChain, Offer, Passage, Reference
from schemas.config import LdsConfig
from schemas.enums import LdsMode, PassageStatus

Return = Literal["re-link", "physical balise", "initialisation"]


@dataclass(slots=True)
class Negation:
    """The position was not used from `first_epoch` on until `end_epoch` (`None`: to the end)."""

    first_epoch: int
    end_epoch: int | None = None
    ended_by: Return | None = None


@dataclass(frozen=True, slots=True)
class Read:
    """A telegram of a physical balise; `epoch`: the first epoch not before it."""

    balise: Balise
    t_ns: int
    epoch: int
    odometer_m: float | None


class LocationSystem:
    """Walks once along a journey; afterwards the columns and passages stand in its attributes."""

    def __init__(
        self,
        journey: Journey,
        bank: Bank,
        virtual: Sequence[Balise],
        physical: Sequence[Balise],
        reads: Sequence[Read],
        config: LdsConfig,
        limits: LdsLimits,
    ) -> None:
        self._journey, self._bank, self._config, self._limits = journey, bank, config, limits
        self._crossings = find_crossings(journey, virtual)
        self._reads = reads
        self._reads_done = 0
        self.virtual = LinkingChain(virtual, config)
        self.physical = LinkingChain(physical, config)
        self.links = LinkRecord(journey, limits)
        self.restarts: list[int] = []
        self.negations: list[Negation] = []
        # Per epoch; python lists, because the walk reads and writes single elements.
        size = journey.t_ns.size
        self.mode = [LdsMode.INITIALISING] * size
        self.tvb = [False] * size
        self.alarm = [False] * size
        self.negated = [False] * size
        self.evaluated = [False] * size
        self.exposure_s = [float("nan")] * size
        self.references: list[Reference | None] = [None] * size
        self._t_ns: list[int] = journey.t_ns.tolist()
        self._odometer_m: list[float] = journey.odometer_m.tolist()
        self._travelled_m: list[float] = journey.travelled_m.tolist()
        self._offset_m: list[float] = (journey.path_m - journey.odometer_m).tolist()
        self._sigma_m: list[float] = journey.sigma_m.tolist()
        self._heading: list[int] = journey.heading.tolist()
        self._leg: list[int] = journey.leg.tolist()
        self._positioned: list[bool] = journey.positioned.tolist()
        self._has_odometer = journey.has_odometer
        # State.
        self._negation: Negation | None = None
        self._chain_from: int | None = None  # epoch after which validated positions are TVBs
        self._consistent_since_ns: int | None = None
        self._consistent_at_ns = 0
        self._fast_failed_at_ns = 0
        self._evaluated_at_ns = 0
        self._position_at_ns: int | None = None
        self._validated_at_ns: int | None = None  # last TVB or accepted VB
        self._anchor: Anchor | None = None  # last TVB or accepted VB, or a balise read while negated
        self._anchor_is_read = False
        self._link_anchor: Anchor | None = None  # LRVB, or the TVB that began the chain
        self._disarmed: dict[str, tuple[Balise, float]] = {}

    def run(self) -> None:
        """Walk along all epochs."""
        for k in range(len(self._t_ns)):
            self._read_balises(k)
            if self._disarmed:
                self._rearm(k)
            bank_failed = self._bank.failed(k)
            disordered = k in self._crossings and self._pass_balises(k, bank_failed)
            self._advance(k)
            failing = self._distance_fails(k) or bank_failed or disordered
            self.alarm[k] = failing
            self.evaluated[k] = self._bank.along_evaluated(k)
            if self._negation is not None:
                self._seek_return(k, disordered)
            elif failing:
                self._negate(k)
            self._note(k)
        self._finish()

    # Balises

    def _pass_balises(self, k: int, bank_failed: bool) -> bool:
        """Offer what the position passed in this step; is the order of identities broken?"""
        offered: list[Crossing] = []
        for crossing in self._crossings[k]:
            balise, heading = crossing.balise, self._heading[k] if self._has_odometer else crossing.sense
            if balise.balise_id in self._disarmed:
                self.virtual.cross_again(balise, crossing.sense, heading)
            elif crossing.seen is Seen.CROSSED:
                offered.append(crossing)
            else:
                self._pass_unseen(crossing, heading)
        if not offered:
            return False
        overdue = sum(self.virtual.is_overdue(crossing.balise) for crossing in offered)
        for crossing in offered:
            self._offer(crossing, bank_failed)
        return self._order_fails(k, offered, overdue)

    def _offer(self, crossing: Crossing, bank_failed: bool) -> None:
        k = crossing.epoch
        offer = self._offer_of(crossing, self._refusal(k, bank_failed))
        passage = self.virtual.offer(offer)
        self._disarm(offer.balise, offer.odometer_m)
        if passage.status is PassageStatus.ACCEPTED:
            self._accept(offer, k)

    def _offer_of(self, crossing: Crossing, refusal: PassageStatus | None) -> Offer:
        k, odometer_m = crossing.epoch, crossing.odometer_m
        heading = self._heading[k] if self._has_odometer else crossing.sense
        since_m = 0.0 if odometer_m is None else (self._odometer_m[k] - odometer_m) * heading
        confidence_m = float(self._journey.confidence_m[k])
        return Offer(
            balise=crossing.balise,
            t_ns=crossing.t_ns,
            sense=crossing.sense,
            heading=heading,
            odometer_m=odometer_m,
            travelled_m=self._travelled_m[k] - since_m,
            confidence_m=None if isnan(confidence_m) else confidence_m,
            refusal=refusal,
        )

    def _refusal(self, k: int, bank_failed: bool) -> PassageStatus | None:
        if self._negation is not None or bank_failed:
            return PassageStatus.REJECTED_MONITOR
        refusal = self._journey.refusal[k]
        unproved = self._config.entry_from_unfitted_area and self._has_odometer and self._chain_from is None
        if refusal is None and unproved:
            # Insertion is what endangers an entry: the diagnosis must stand behind the first VB too.
            return PassageStatus.REJECTED_MONITOR
        return refusal

    def _accept(self, offer: Offer, k: int) -> None:
        self._validated_at_ns = offer.t_ns
        if offer.odometer_m is not None:
            offset_m = offer.balise.path_m - offer.odometer_m
            self._anchor = Anchor(offset_m, self._sigma_m[k], offer.t_ns, offer.travelled_m)
            self._link_anchor = self._anchor
        if self._chain_from is None:
            self._chain_from = k

    def _pass_unseen(self, crossing: Crossing, heading: int) -> None:
        unplaced = crossing.seen is Seen.UNPLACED
        status = PassageStatus.REJECTED_AMBIGUOUS if unplaced else PassageStatus.NOT_AVAILABLE
        offer = self._offer_of(crossing, status)
        self.virtual.pass_unoffered(offer, status)
        self._disarm(crossing.balise, crossing.odometer_m)

    def _disarm(self, balise: Balise, odometer_m: float | None) -> None:
        self._disarmed[balise.balise_id] = (balise, float("nan") if odometer_m is None else odometer_m)

    def _rearm(self, k: int) -> None:
        """A balise may be detected again once the odometer moved max(10 m, 3 sigma) away.

        Without an odometer the position's distance from the balise has to serve.
        """
        away_m = max(self._config.rearm_m, 3.0 * self._sigma_m[k])
        for name, (balise, at_m) in list(self._disarmed.items()):
            if self._has_odometer:
                moved_m = self._odometer_m[k] - at_m
                if isnan(at_m):
                    self._disarmed[name] = (balise, self._odometer_m[k])
            else:
                moved_m = float(self._journey.path_m[k]) - balise.path_m
            if abs(moved_m) >= away_m:
                del self._disarmed[name]

    def _read_balises(self, k: int) -> None:
        while self._reads_done < len(self._reads) and self._reads[self._reads_done].epoch <= k:
            self._read(self._reads[self._reads_done], k)
            self._reads_done += 1

    def _read(self, read: Read, k: int) -> None:
        """A telegram goes by the rules of linking; only windows can reject it, no monitor."""
        if read.balise.balise_id in self._disarmed:
            return
        heading = self._heading[k]
        since_m = 0.0 if read.odometer_m is None else (self._odometer_m[k] - read.odometer_m) * heading
        travelled_m = self._travelled_m[k] - (since_m if isfinite(since_m) else 0.0)
        offer = Offer(
            read.balise, read.t_ns, heading, heading, read.odometer_m, travelled_m, None, refusal=None
        )
        passage = self.physical.offer(offer)
        self._disarm(read.balise, read.odometer_m)
        if self._negation is not None and passage.status is PassageStatus.ACCEPTED:
            self._stand_on(read, travelled_m)

    def _stand_on(self, read: Read, travelled_m: float) -> None:
        """While negated a balise says where the train is, so what GNSS minus odometer should be."""
        if read.odometer_m is None or not isfinite(travelled_m):
            return
        offset_m = read.balise.path_m - read.odometer_m
        sigma_m = self._sigma_m[read.epoch] if isfinite(self._sigma_m[read.epoch]) else 0.0
        self._anchor = Anchor(offset_m, sigma_m, read.t_ns, travelled_m)
        self._anchor_is_read = True

    def _advance(self, k: int) -> None:
        """Windows that the train has left are closed."""
        if self._positioned[k]:
            self._position_at_ns = self._t_ns[k]
        odometer_m = self._odometer_m[k]
        if isnan(odometer_m):
            return
        place = (odometer_m, self._travelled_m[k], self._heading[k], self._leg[k], self._t_ns[k])
        self.virtual.advance(*place, blind=self._is_blind(k))
        if self._reads:
            self.physical.advance(*place, blind=False)

    def _is_blind(self, k: int) -> bool:
        since_ns = self._position_at_ns
        return since_ns is None or self._t_ns[k] - since_ns > self._journey.gap_ns

    # Linking monitors

    def _order_fails(self, k: int, offered: list[Crossing], overdue: int) -> bool:
        if self.links.order_reason[k] is not None:
            return False
        count = disorder(offered, overdue, self._journey, self._config, self._limits)
        self.links.order_value[k] = float(count)
        return count > 0

    def _distance_fails(self, k: int) -> bool:
        links, anchor = self.links, self._link_anchor
        if links.distance_reason[k] is not None:
            return False
        if anchor is None:
            links.distance_reason[k] = NO_REFERENCE
            return False
        value_m = self._offset_m[k] - anchor.offset_m
        threshold_m = distance_threshold_m(
            anchor, self._travelled_m[k], self._sigma_m[k], self._config, self._limits
        )
        links.distance_value[k], links.distance_threshold[k] = value_m, threshold_m
        return abs(value_m) > threshold_m

    # Validation, negation, return

    def _is_usable(self, k: int) -> bool:
        return self._journey.refusal[k] is None

    def _is_tvb(self, k: int) -> bool:
        """A usable position that the diagnosis stands behind, linked to a VB, a TVB or a start."""
        if not (self.evaluated[k] and self._is_usable(k)):
            return False
        if self._chain_from is None:
            return self._has_initialised(k)
        return k > self._chain_from

    def _has_initialised(self, k: int) -> bool:
        """Consistent for `init_s` without a break: a TVB may arise between two VBs (SR)."""
        t_ns = self._t_ns[k]
        broken = t_ns - self._consistent_at_ns > self._journey.gap_ns
        if self._consistent_since_ns is None or broken:
            self._consistent_since_ns = t_ns
        self._consistent_at_ns = t_ns
        if t_ns - self._consistent_since_ns < self._config.init_s * 1e9:
            return False
        self._chain_from = k
        self._link_anchor = self._anchor_at(k)
        return True

    def _anchor_at(self, k: int) -> Anchor:
        return Anchor(self._offset_m[k], self._sigma_m[k], self._t_ns[k], self._travelled_m[k])

    def _negate(self, k: int) -> None:
        self._negation = Negation(k)
        self.negations.append(self._negation)
        self._fast_failed_at_ns = self._evaluated_at_ns = self._t_ns[k]
        self._anchor_is_read = False
        self._bank.freeze(k)

    def _seek_return(self, k: int, disordered: bool) -> None:
        """Recovery: `recovery_s` seen without a fast failure, then the re-link test."""
        t_ns = self._t_ns[k]
        seen = self.evaluated[k] if self._has_odometer else self._is_usable(k)
        if seen:
            if t_ns - self._evaluated_at_ns > self._journey.gap_ns:
                self._fast_failed_at_ns = t_ns  # nobody looked: that is not "without a failure"
            self._evaluated_at_ns = t_ns
        if disordered or self._bank.fast_failed(k):
            self._fast_failed_at_ns = t_ns
        waited = t_ns - self._fast_failed_at_ns >= self._config.recovery_s * 1e9
        if not (waited and seen and self._is_usable(k)):
            return
        if self._anchor is None or not self._has_odometer:
            self._initialise_anew(k)
        elif self._relinks(k, self._anchor):
            self._return(k, "physical balise" if self._anchor_is_read else "re-link")
            self._link_anchor = self._anchor_at(k)

    def _relinks(self, k: int, anchor: Anchor) -> bool:
        bound_m = relink_bound_m(anchor, k, self._journey, self._config, self._limits)
        return bound_m is not None and abs(self._offset_m[k] - anchor.offset_m) <= bound_m

    def _initialise_anew(self, k: int) -> None:
        """Nothing was validated before the fault, so there is nothing to re-link to."""
        self.virtual.forget()
        self._chain_from = self._consistent_since_ns = None
        self._link_anchor = self._anchor = None
        self._return(k, "initialisation")

    def _return(self, k: int, by: Return) -> None:
        assert self._negation is not None
        self._negation.end_epoch, self._negation.ended_by = k, by
        self._negation = None
        self._bank.restart(k)
        self.restarts.append(k)
        self.evaluated[k] = self._bank.along_evaluated(k)

    # Columns

    def _note(self, k: int) -> None:
        """Write down the epoch. Exposure is the time since the TVB or VB *before* this one."""
        t_ns, negated = self._t_ns[k], self._negation is not None
        if self._validated_at_ns is not None:
            self.exposure_s[k] = (t_ns - self._validated_at_ns) * 1e-9
        if not negated and not self.alarm[k] and self._is_tvb(k):
            self.tvb[k] = True
            self._validated_at_ns, self._anchor = t_ns, self._anchor_at(k)
        self.negated[k] = negated
        self.references[k] = self.virtual.reference
        self.mode[k] = self._mode(k)

    def _mode(self, k: int) -> LdsMode:
        if self._negation is not None:
            return LdsMode.FAIL_SAFE
        if not self.virtual.linking and (self._chain_from is None or not self._has_odometer):
            return LdsMode.INITIALISING
        return LdsMode.LINKED if self._is_usable(k) else LdsMode.ODOMETRY

    def _finish(self) -> None:
        """Balises that the train has passed by its reckoning when the run ends without a position."""
        known = np.flatnonzero(np.isfinite(self._journey.odometer_m))
        if known.size and self._is_blind(len(self._t_ns) - 1):
            self.virtual.finish(self._odometer_m[int(known[-1])], self._t_ns[-1])

    @property
    def passages(self) -> list[Passage]:
        return self.virtual.passages + self.physical.passages
