"""The location determination system as a state machine over the epochs of one solution.

*Initialising*: no reference, no linking. *Linked*: reference known, position in use. *Odometry*:
reference known, no usable position just now. *Fail-safe*: position negated.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from math import isnan

import numpy as np

from pipeline.lds.bank_protocol import Bank, LdsLimits
from pipeline.lds.crossings import Balise, Crossing, Seen, find_crossings
from pipeline.lds.footing import Footing
from pipeline.lds.journey import Journey, turning_epochs
from pipeline.lds.link_monitors import LinkDistance, LinkOrder, disorder
from pipeline.lds.linking import LinkingChain
from pipeline.lds.passage import Offer
from pipeline.lds.reads import Read
from pipeline.lds.rearming import Latch
from pipeline.lds.recovery import Anchor, Recovery
from pipeline.lds.standing import Negation, Return, Standing
from schemas.config import LdsConfig
from schemas.enums import PassageStatus


class LocationSystem:
    """Walks once along a journey; what it found stands in its public attributes afterwards.

    Per epoch: `tvb`, `alarm`, `negated`, `evaluated` (the along monitors have a verdict).
    """

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
        self._reads: dict[int, list[Read]] = {}
        for read in reads:
            self._reads.setdefault(read.epoch, []).append(read)
        self._turns = turning_epochs(journey)
        self._has_odometer = journey.has_odometer
        self._latch = Latch(journey, config)
        self.virtual = LinkingChain(virtual, config)
        self.physical = LinkingChain(physical if reads else [], config)
        self.order = LinkOrder(journey, limits)
        self.distance = LinkDistance(journey, config, limits)
        self.restarts: list[int] = []
        self.negations: list[Negation] = []
        self.standings = [Standing(0, None, chain_begun=False)]
        self.accepted_at_ns: dict[int, int] = {}
        size = journey.t_ns.size
        self.tvb, self.alarm, self.negated, self.evaluated = ([False] * size for _ in range(4))
        # The walk reads single elements: lists are several times faster at that than arrays.
        self._t_ns: list[int] = journey.t_ns.tolist()
        self._way_m = journey.odometer_m * journey.heading
        self._along_m: list[float] = self._way_m.tolist()
        self._events = sorted({*self._turns, *self._reads, *self._crossings})
        self._refusal = journey.refusal
        self._recovery: Recovery | None = None  # while negated
        self._chain_from: int | None = None  # validated positions after this epoch are TVBs
        self._consistent_since_ns: int | None = None
        self._consistent_at_ns = 0
        self._footing = Footing(journey, limits)

    def run(self) -> None:
        """Walk along all epochs."""
        k, size = 0, len(self._t_ns)
        while k < size:
            end = self._uneventful_until(k)
            if end > k:
                self._pass_uneventful(k, end)
            else:
                self._step(k)
                end = k + 1
            k = end
        self._finish()

    def _uneventful_until(self, k: int) -> int:
        """The first epoch from `k` on that has to be stepped through; those before it can only be TVBs.

        So it is on linked way where no balise, read, turn, alarm or end of a window is near.
        """
        if self._recovery is not None or self._latch or self._chain_from is None or k <= self._chain_from:
            return k
        near = bisect_left(self._events, k)
        end = self._events[near] if near < len(self._events) else len(self._t_ns)
        for monitors in (self._bank, self.distance):
            end = monitors.quiet_until(k, end) if end > k else k
        closing = self._way_m[k:end] > min(self.virtual.closing_m, self.physical.closing_m)
        return k + int(closing.argmax()) if closing.any() else end

    def _pass_uneventful(self, k: int, end: int) -> None:
        evaluated = self._bank.along_evaluated_between(k, end)
        validated = evaluated & self._journey.usable[k:end]
        self.evaluated[k:end] = evaluated.tolist()
        self.tvb[k:end] = validated.tolist()
        if validated.any():
            self._footing.validate(k + int(np.flatnonzero(validated)[-1]))

    def _step(self, k: int) -> None:
        if k in self._turns:
            self._turn(k)
        if k in self._reads:
            self._read_balises(k)
        bank_failed = self._bank.failed(k)
        disordered = k in self._crossings and self._pass_balises(k, bank_failed)
        if self._latch:
            self._latch.advance(k)
        self._close_windows(k)
        self.evaluated[k] = self._bank.along_evaluated(k)
        failing = bank_failed or disordered or self.distance.fails(k)
        if failing:
            self.alarm[k] = True
        if self._recovery is not None:
            self._seek_return(self._recovery, k, disordered)
        elif failing:
            self._negate(k)
        elif self.evaluated[k] and self._refusal[k] is None:
            self._validate(k)

    # Balises

    def _pass_balises(self, k: int, bank_failed: bool) -> bool:
        """Offer what the position passed in this step; is the order of identities broken?"""
        offered: list[Crossing] = []
        for crossing in self._crossings[k]:
            if self._latch.holds(crossing.balise):
                self.virtual.cross_again(crossing.balise, crossing.sense, self._heading(crossing))
            elif crossing.seen is Seen.CROSSED:
                offered.append(crossing)
            else:
                self._pass_unseen(crossing)
        if not offered:
            return False
        overdue = sum(self.virtual.is_overdue(crossing.balise) for crossing in offered)
        for crossing in offered:
            self._offer(crossing, bank_failed)
        return self._order_fails(k, offered, overdue)

    def _offer(self, crossing: Crossing, bank_failed: bool) -> None:
        offer = self._offer_of(crossing, self._refusal_of(crossing, bank_failed))
        passage = self.virtual.offer(offer)
        self._latch.disarm(offer.balise, offer.odometer_m)
        if passage.status is PassageStatus.ACCEPTED:
            self._accept(offer, crossing.epoch)

    def _pass_unseen(self, crossing: Crossing) -> None:
        unplaced = crossing.seen is Seen.UNPLACED
        status = PassageStatus.REJECTED_AMBIGUOUS if unplaced else PassageStatus.NOT_AVAILABLE
        self.virtual.pass_unoffered(self._offer_of(crossing, status), status)
        self._latch.disarm(crossing.balise, crossing.odometer_m)

    def _heading(self, crossing: Crossing) -> int:
        """Direction of travel; without an odometer there is only that of the position itself."""
        return int(self._journey.heading[crossing.epoch]) if self._has_odometer else crossing.sense

    def _offer_of(self, crossing: Crossing, refusal: PassageStatus | None) -> Offer:
        k, odometer_m, heading = crossing.epoch, crossing.odometer_m, self._heading(crossing)
        since_m = 0.0 if odometer_m is None else (float(self._journey.odometer_m[k]) - odometer_m) * heading
        confidence_m = float(self._journey.confidence_m[k])
        return Offer(
            balise=crossing.balise,
            t_ns=crossing.t_ns,
            sense=crossing.sense,
            heading=heading,
            odometer_m=odometer_m,
            travelled_m=float(self._journey.travelled_m[k]) - since_m,
            confidence_m=None if isnan(confidence_m) else confidence_m,
            refusal=refusal,
        )

    def _refusal_of(self, crossing: Crossing, bank_failed: bool) -> PassageStatus | None:
        """Why a virtual balise is not detected at this crossing, whatever linking says.

        A step out of an ambiguous position passes what the train did not.
        """
        if self._recovery is not None or bank_failed:
            return PassageStatus.REJECTED_MONITOR
        if self._refusal[crossing.before] is PassageStatus.REJECTED_AMBIGUOUS:
            return PassageStatus.REJECTED_AMBIGUOUS
        refusal = self._refusal[crossing.epoch]
        entry = self._config.entry_from_unfitted_area and self._has_odometer
        if refusal is None and entry and self._chain_from is None:
            # Insertion is what endangers an entry: the diagnosis must stand behind the first VB too.
            return PassageStatus.REJECTED_MONITOR
        return refusal

    def _accept(self, offer: Offer, k: int) -> None:
        self.accepted_at_ns[k] = offer.t_ns
        if self._chain_from is None:
            self._chain_from = k
        if offer.odometer_m is not None:
            offset_m = offer.balise.path_m - offer.odometer_m
            anchor = Anchor(offset_m, float(self._journey.sigma_m[k]), offer.t_ns, offer.travelled_m)
            self._footing.accept(anchor)
            self.distance.measure_from(anchor, k)
        self._stand(k)

    def _read_balises(self, k: int) -> None:
        """Telegrams go by the rules of linking; only windows can reject them, no monitor."""
        heading = int(self._journey.heading[k])
        for read in self._reads[k]:
            if self._latch.holds(read.balise):
                continue
            offer = Offer(read.balise, read.t_ns, heading, heading, read.odometer_m, read.travelled_m, None, None)
            passage = self.physical.offer(offer)
            self._latch.disarm(read.balise, read.odometer_m)
            if passage.status is not PassageStatus.ACCEPTED:
                continue
            if self._recovery is not None:
                self._recovery.stand_on(read)
            else:
                self._footing.read(read)

    def _turn(self, k: int) -> None:
        journey = self._journey
        for chain in (self.virtual, self.physical):
            chain.turn(
                float(journey.odometer_m[k]),
                float(journey.travelled_m[k]),
                int(journey.heading[k]),
                int(journey.leg[k]),
            )

    def _close_windows(self, k: int) -> None:
        """Windows that the train has left are closed."""
        along_m = self._along_m[k]
        if along_m > self.virtual.closing_m:
            self.virtual.advance(float(self._journey.odometer_m[k]), self._t_ns[k], self._absence(k))
        if along_m > self.physical.closing_m:
            self.physical.advance(float(self._journey.odometer_m[k]), self._t_ns[k], PassageStatus.MISSED)

    def _absence(self, k: int) -> PassageStatus:
        """What to say of a balise that the train has passed and the position has not."""
        if not self._journey.blind[k]:
            return PassageStatus.MISSED
        unplaced = bool(self._journey.placed_nowhere[k])
        return PassageStatus.REJECTED_AMBIGUOUS if unplaced else PassageStatus.NOT_AVAILABLE

    def _order_fails(self, k: int, offered: list[Crossing], overdue: int) -> bool:
        if not self.order.is_evaluated(k):
            return False
        out_of_order = disorder(offered, overdue, self._journey, self._config, self._limits)
        self.order.note(k, out_of_order)
        return out_of_order > 0

    # Validation, negation, return

    def _validate(self, k: int) -> None:
        """A usable position that the diagnosis stands behind is a TVB once the chain has begun."""
        begun = self._has_initialised(k) if self._chain_from is None else k > self._chain_from
        if begun:
            self.tvb[k] = True
            self._footing.validate(k)

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
        self.distance.measure_from(Anchor.at_epoch(self._journey, k), k)
        self._stand(k)
        return True

    def _negate(self, k: int) -> None:
        self._footing.negate(k)
        self._recovery = Recovery(k, self._journey, self._bank, self._config, self._limits)
        self.negations.append(Negation(k))
        self.negated[k] = True
        self._consistent_since_ns = None

    def _seek_return(self, recovery: Recovery, k: int, disordered: bool) -> None:
        self.negated[k] = True
        usable = self._refusal[k] is None
        # Without an odometer there is no along bank to look on; the position itself has to do.
        seen = self.evaluated[k] if self._has_odometer else usable
        if not recovery.is_over(k, self._t_ns[k], seen, usable, disordered):
            return
        anchor = recovery.read or self._footing.last_validated()
        if anchor is None:
            self._initialise_anew(k)
        elif self._footing.relinks(recovery, k, anchor):
            self._return(k, "re-link" if recovery.read is None else "physical balise")
            self.distance.measure_from(Anchor.at_epoch(self._journey, k), k)

    def _initialise_anew(self, k: int) -> None:
        """Nothing was validated before the fault, so there is nothing to re-link to."""
        self.virtual.forget()
        self.distance.forget(k)
        self._footing.forget()
        self._chain_from = None
        self._return(k, "initialisation")
        self._stand(k)

    def _return(self, k: int, by: Return) -> None:
        negation = self.negations[-1]
        negation.end_epoch, negation.ended_by = k, by
        self._recovery = None
        self.negated[k] = False
        self._bank.restart(k)
        self.restarts.append(k)
        # What still rang at this epoch belonged to the fault that is over.
        self.evaluated[k] = self._bank.along_evaluated(k)
        self.alarm[k] = self._bank.failed(k)

    def _stand(self, k: int) -> None:
        self.standings.append(Standing(k, self.virtual.reference, self._chain_from is not None))

    def _finish(self) -> None:
        """Balises that the train has passed by its reckoning when the run ends without a position."""
        known = np.flatnonzero(np.isfinite(self._journey.odometer_m))
        absence = self._absence(len(self._t_ns) - 1) if known.size else PassageStatus.MISSED
        if absence is not PassageStatus.MISSED:
            self.virtual.finish(float(self._journey.odometer_m[known[-1]]), self._t_ns[-1], absence)
