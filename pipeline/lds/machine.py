"""The location determination system as a state machine over the epochs of one solution.

*Initialising*: no reference, no linking. *Linked*: reference known, position in use. *Odometry*:
reference known, no usable position just now. *Fail-safe*: position negated.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.lds.bank_protocol import Bank, LdsLimits
from pipeline.lds.breaks import Verdict, break_epochs, compare
from pipeline.lds.crossings import Balise
from pipeline.lds.detection import BaliseDetection
from pipeline.lds.footing import Footing
from pipeline.lds.journey import Journey
from pipeline.lds.link_monitors import LinkDistance
from pipeline.lds.passage import Offer
from pipeline.lds.reads import Read
from pipeline.lds.recovery import Anchor, Recovery
from pipeline.lds.standing import Negation, Return, Standing
from schemas.config import LdsConfig


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
        self._has_odometer = journey.has_odometer
        self.balises = BaliseDetection(journey, virtual, physical, reads, config, limits)
        self.distance = LinkDistance(journey, config, limits)
        self.restarts: list[int] = []
        self.negations: list[Negation] = []
        self.standings = [Standing(0, None, chain_begun=False)]
        self.accepted_at_ns: dict[int, int] = {}
        self.undecided: list[int] = []  # epochs after a break at which the odometer could not tell
        size = journey.t_ns.size
        self.tvb, self.alarm, self.negated, self.evaluated = ([False] * size for _ in range(4))
        # The walk reads single elements: lists are several times faster at that than arrays.
        self._t_ns: list[int] = journey.t_ns.tolist()
        self._way_m = journey.odometer_m * journey.heading
        self._breaks = break_epochs(journey)
        self._events = sorted({*self.balises.events, *self._breaks})
        self._refusal = journey.refusal
        self._recovery: Recovery | None = None  # while negated
        self._chain_from: int | None = None  # validated positions after this epoch are TVBs
        self._consistent_since_ns: int | None = None
        self._consistent_at_ns = 0
        self._doubted = False  # after a break: nothing says yet that the position is what it was
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
        if size:
            self.balises.finish(self._t_ns[-1])

    def _uneventful_until(self, k: int) -> int:
        """The first epoch from `k` on that has to be stepped through; those before it can only be TVBs.

        So it is on linked way where no balise, read, turn, break, alarm or end of a window is near.
        """
        if self._recovery is not None or self.balises.latched or self._chain_from is None or k <= self._chain_from:
            return k
        near = bisect_left(self._events, k)
        end = self._events[near] if near < len(self._events) else len(self._t_ns)
        for monitors in (self._bank, self.distance):
            end = monitors.quiet_until(k, end) if end > k else k
        closing = self._way_m[k:end] > self.balises.closing_m
        return k + int(closing.argmax()) if closing.any() else end

    def _pass_uneventful(self, k: int, end: int) -> None:
        evaluated = self._bank.along_evaluated_between(k, end)
        validated = evaluated & self._journey.usable[k:end]
        self.evaluated[k:end] = evaluated.tolist()
        self.tvb[k:end] = validated.tolist()
        if validated.any():
            self._footing.validate(k + int(np.flatnonzero(validated)[-1]))

    def _step(self, k: int) -> None:
        self.balises.turn(k)
        for read in self.balises.read(k):
            self._stand_on(read)
        bank_failed = self._bank.failed(k)
        self._test_after_break(k)
        distrusted = bank_failed or self.distance.fails(k) or self._recovery is not None
        accepted, disordered = self.balises.pass_virtual(k, distrusted, self._chain_from is None)
        for offer in accepted:
            self._accept(offer, k)
        self.balises.rearm(k)
        self.balises.close_windows(k, self._t_ns[k])
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

    def _test_after_break(self, k: int) -> None:
        """Until something says that the position is what it was before a break, there are no TVBs.

        What the odometer cannot tell, ten consistent seconds may begin anew, or a VB inside its window, as at the
        start of a mission; linking holds on meanwhile.
        """
        if k in self._breaks and self._recovery is None and self._chain_from is not None:
            self._doubted = True
        if not (self._doubted and self.distance.is_possible(k)):
            return
        found = compare(self._footing.before_break(), k, self._journey, self._limits)
        self.distance.hold_against(found, k)
        if found.verdict is Verdict.UNKNOWN:
            self._interrupt_chain(k)
        else:
            self._resume_chain(k)

    def _interrupt_chain(self, k: int) -> None:
        if self._chain_from is not None:
            self._chain_from = self._consistent_since_ns = None
            self.undecided.append(k)
            self._stand(k)

    def _resume_chain(self, k: int) -> None:
        self._doubted = False
        if self._chain_from is None:
            self._chain_from = k

    def _stand_on(self, read: Read) -> None:
        """A physical balise says what GNSS minus odometer should be."""
        if self._recovery is not None:
            self._recovery.stand_on(read)
        else:
            self._footing.read(read)

    def _accept(self, offer: Offer, k: int) -> None:
        self.accepted_at_ns[k] = offer.t_ns
        self._resume_chain(k)
        if offer.odometer_m is not None:
            offset_m = offer.balise.path_m - offer.odometer_m
            at = Anchor.at_epoch(self._journey, k)
            anchor = replace(at, offset_m=offset_m, t_ns=offer.t_ns, travelled_m=offer.travelled_m)
            self._footing.accept(anchor)
            self.distance.measure_from(anchor, k)
        self._stand(k)

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
        self._resume_chain(k)
        if not self.distance.can_measure(k):
            self.distance.measure_from(Anchor.at_epoch(self._journey, k), k)
        self._stand(k)
        return True

    def _negate(self, k: int) -> None:
        slow = self._bank.failed(k) and not self._bank.fast_failed(k)
        self._footing.negate(k, np.flatnonzero(self.tvb[:k]) if slow else None)
        self._recovery = Recovery(k, self._journey, self._bank, self._config, self._limits)
        self.negations.append(Negation(k))
        self.negated[k] = True
        self._consistent_since_ns = None
        self._doubted = False

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
        self.balises.virtual.forget()
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
        self.standings.append(Standing(k, self.balises.virtual.reference, self._chain_from is not None))
