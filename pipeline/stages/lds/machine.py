"""The location determination system: one walk along the epochs of a solution, with one state of its position.

A position is *withheld* where the diagnosis cannot stand behind it (DOMAIN section 5.2): no VB, no TVB.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from enum import Enum, auto

from pipeline.stages.lds.crossings import Balise, Crossing
from pipeline.stages.lds.detection import BaliseDetection
from pipeline.stages.lds.journey import Journey, mission_epochs, odometer_epochs, unwatched_epochs
from pipeline.stages.lds.link_monitors import LinkDistance
from pipeline.stages.lds.linking import LrvbChange
from pipeline.stages.lds.relink import Anchor, Held, Recovery, Relink
from pipeline.stages.monitors.bank import MonitorBank
from schemas.arrays import NS_PER_S
from schemas.config import Configuration
from schemas.enums import BaliseKind, LostTo


class Use(Enum):
    """Whether the train uses the position (DOMAIN section 4).

    | from | when | to |
    |---|---|---|
    | in use | the odometer reports slip, and something was validated | slipped |
    | in use | nothing watched it (`unwatched_epochs`), or the noise hides what it does | unseen |
    | unseen | a usable position, watched again within `gap_reset_s`, or it re-links | in use |
    | unseen | it has moved (an alarm), or nothing can be said of that | negated |
    | slipped | it re-links | in use |
    | any but negated | a monitor fails | negated |
    | negated | `recovery_s` without a fast failure, and it re-links | in use |
    | any | a start of mission; in negated also recovery where nothing was validated before | in use |
    """

    IN_USE = auto()
    UNSEEN = auto()
    SLIPPED = auto()
    NEGATED = auto()


class LocationSystem:
    """Walks once along a journey; the results stand in its public attributes afterwards.

    Per epoch: `tvb`, `alarm`, `negated`, `evaluated` (`along_raw` has a verdict), `withheld_for`.
    """

    def __init__(
        self,
        journey: Journey,
        bank: MonitorBank,
        balises: dict[BaliseKind, list[Balise]],
        crossings: Sequence[Crossing],
        config: Configuration,
    ) -> None:
        self._journey = journey
        self._bank = bank
        self._config = config
        self.balises = BaliseDetection(journey, balises, crossings, config)
        self.distance = LinkDistance(journey, config)
        self.lrvb_changes = [LrvbChange(0, None, chain_begun=False)]
        self.accepted_at_ns: dict[int, int] = {}
        self.tvb, self.alarm, self.negated = ([False] * journey.t_ns.size for _ in range(3))
        self.evaluated = [False] * journey.t_ns.size
        self.withheld_for: list[LostTo | None] = [None] * journey.t_ns.size
        # The walk reads single elements: lists are several times faster at that than arrays.
        self._t_ns: list[int] = journey.t_ns.tolist()
        self._way_m = journey.odometer_m * journey.direction
        self._unwatched = unwatched_epochs(journey, bank.watched, config.align.gap_reset_s)
        self._bridged_ns = round(config.align.gap_reset_s * NS_PER_S)
        self._memory_ns = round(NS_PER_S / min(config.monitors.ewma_alphas))
        self._missions = mission_epochs(journey, config.lds)
        self._events = sorted({*self.balises.events, *self._unwatched, *self._missions, *odometer_epochs(journey)})
        self._relink = Relink(journey, self.tvb, config)
        self._use = Use.IN_USE
        self._slipped_at = 0  # the epoch at which slip began
        self._unseen_ns = 0  # since when the position is unseen
        self._recovery = Recovery(journey, bank, config)
        self._hold_to_ns: int | None = None  # since the first return after an alarm of the bank
        self._validated = False  # a VB or a TVB
        self._chain_from: int | None = None  # validated positions after this epoch are TVBs
        self._consistent_since_ns: int | None = None
        self._consistent_at_ns = 0

    @property
    def held(self) -> list[Held]:
        return self._relink.held

    def run(self) -> None:
        epoch = 0
        while epoch < len(self._t_ns):
            end = self._uneventful_until(epoch)
            if end > epoch:
                self._pass_uneventful(epoch, end)
            else:
                self._step(epoch)
            epoch = max(end, epoch + 1)
        if epoch:
            self.balises.finish(self._t_ns[-1])

    def _uneventful_until(self, epoch: int) -> int:
        """The first epoch from here on for `_step`; those before are TVBs where evaluated and usable.

        Uneventful is a position in use, in a begun chain, up to the next event, alarm or end of a window.
        """
        if self._use is not Use.IN_USE or self._withheld_for(epoch) is not None:
            return epoch
        if self.balises.disarmed or self._chain_from is None or epoch <= self._chain_from:
            return epoch
        if self._journey.has_odometer and not self.distance.can_measure(epoch):
            return epoch
        near = bisect_left(self._events, epoch)
        end = self._events[near] if near < len(self._events) else len(self._t_ns)
        for monitors in (self._bank, self.distance):
            end = monitors.quiet_until(epoch, end) if end > epoch else epoch
        closing = self._way_m[epoch:end] > self.balises.closing_m
        return epoch + int(closing.argmax()) if closing.any() else end

    def _pass_uneventful(self, epoch: int, end: int) -> None:
        evaluated = self._bank.along_evaluated_between(epoch, end)
        self.evaluated[epoch:end] = evaluated.tolist()
        self.tvb[epoch:end] = (evaluated & self._journey.usable[epoch:end]).tolist()
        self._validated = True

    def _step(self, epoch: int) -> None:
        if epoch in self._missions:
            self._relink.begin_mission(epoch)
            self._hold_to_ns = None
            self._initialise_anew(epoch)
        self.balises.turn(epoch)
        for read in self.balises.read(epoch):
            self._relink.note_read(read)
            self._hold(epoch)
        bank_failed = self._bank.failed(epoch)
        self._watch(epoch)
        self.withheld_for[epoch] = self._withheld_for(epoch)
        withheld = self.withheld_for[epoch] is not None
        distrusted = bank_failed or self.distance.fails(epoch) or self._use is Use.NEGATED or withheld
        accepted, disordered = self.balises.pass_virtual(epoch, distrusted, self._chain_from is None)
        for crossing in accepted:
            self._accept(crossing, epoch)
        self.balises.rearm(epoch)
        self.balises.close_windows(epoch, self._t_ns[epoch])
        self.evaluated[epoch] = self._bank.along_evaluated(epoch)
        self.alarm[epoch] = bank_failed or disordered or self.distance.fails(epoch)
        if self._use is Use.NEGATED:
            self._seek_return(epoch, disordered)
        elif self.alarm[epoch]:
            self._negate(epoch)
        elif self.evaluated[epoch] and self._journey.usable[epoch] and not withheld:
            self._validate(epoch)

    def _withheld_for(self, epoch: int) -> LostTo | None:
        if not self._bank.noise_known_at(epoch):
            return LostTo.NOISE
        if self._journey.slips[epoch]:
            return LostTo.SLIP
        return LostTo.RELINK if self._use is Use.SLIPPED or self._bank.begins_at(epoch) else None

    def _watch(self, epoch: int) -> None:
        """Leave or re-enter use: slip, noise that hides the position, outages, and the return from them."""
        if self._journey.slips[epoch]:
            self._consistent_since_ns = None
            if self._use in (Use.IN_USE, Use.UNSEEN) and self._validated:
                self._use = Use.SLIPPED
                self._slipped_at = epoch
        elif self._use is Use.SLIPPED:
            self._relink_after_slip(epoch)
        if self._use is Use.IN_USE and not self._bank.noise_known_at(epoch):
            self._use = Use.UNSEEN
            self._unseen_ns = self._t_ns[epoch]
        if self._use in (Use.IN_USE, Use.UNSEEN) and epoch in self._unwatched:
            self._use = Use.UNSEEN
            self._unseen_ns = self._t_ns[epoch] - self._bridged_ns - 1
        if self._use is Use.UNSEEN and self._bank.noise_known_at(epoch) and self._can_return(epoch):
            self._relink_unseen(epoch)

    def _can_return(self, epoch: int) -> bool:
        return self.distance.is_possible(epoch) and bool(self._journey.usable[epoch])

    def _relink_after_slip(self, epoch: int) -> None:
        # Several slips would each let a held position go on by as much as one may.
        anchor = (
            self._relink.anchor_at(epoch) if self._is_held(epoch) else self._relink.anchor_before_slip(self._slipped_at)
        )
        if self._can_return(epoch) and self._relink.compare(epoch, anchor).holds:
            self._use = Use.IN_USE
            self.distance.measure_from(Anchor.at_epoch(self._journey, epoch), epoch)

    def _relink_unseen(self, epoch: int) -> None:
        """It re-links, or is negated."""
        self._use = Use.IN_USE
        if self._validated and self._t_ns[epoch] - self._unseen_ns > self._bridged_ns:
            comparison = self._relink.compare(epoch, self._relink.anchor_at(epoch))
            self.distance.hold_against(comparison, epoch)
            if comparison.reason is not None:
                self._negate(epoch)

    def _accept(self, crossing: Crossing, epoch: int) -> None:
        """It is the LRVB and begins the chain of TVBs."""
        self.accepted_at_ns[epoch] = crossing.t_ns
        crossing.initialising = not self._validated
        self._validated = True
        self._chain_from = epoch if self._chain_from is None else self._chain_from
        anchor = Anchor.at_crossing(self._journey, crossing, float(self._journey.sigma_m[epoch]))
        if anchor is not None:
            self.distance.measure_from(anchor, epoch)
        self._note_lrvb(epoch)

    def _validate(self, epoch: int) -> None:
        """A usable position is a TVB, once the chain has begun; else it may begin it."""
        if self._has_initialised(epoch) if self._chain_from is None else epoch > self._chain_from:
            self.tvb[epoch] = self._validated = True
            if not self.distance.can_measure(epoch):
                self.distance.measure_from(Anchor.at_epoch(self._journey, epoch), epoch)

    def _has_initialised(self, epoch: int) -> bool:
        """Consistent for `init_s`: a TVB may arise between two VBs (SR)."""
        t_ns = self._t_ns[epoch]
        if self._consistent_since_ns is None or t_ns - self._consistent_at_ns > self._journey.gap_ns[epoch]:
            self._consistent_since_ns = t_ns
        self._consistent_at_ns = t_ns
        if t_ns - self._consistent_since_ns < self._config.lds.init_s * NS_PER_S:
            return False
        self._chain_from = epoch
        self._note_lrvb(epoch)
        return True

    def _negate(self, epoch: int) -> None:
        # Slow averages that fail alone show a drift as old as their memory; after a jump they fail too, but it is new.
        self._relink.note_alarm(epoch, 0.0 if self._bank.fast_failed(epoch) else self._bank.failing_memory_s(epoch))
        if self._bank.failed(epoch):
            self._hold_to_ns = None
        self._bank.freeze(epoch)
        self._use = Use.NEGATED
        self._recovery.begin(epoch)
        self.negated[epoch] = True
        self._consistent_since_ns = None

    def _seek_return(self, epoch: int, disordered: bool) -> None:
        """Return after recovery if the position re-links, or anew where nothing was validated before."""
        self.negated[epoch] = True
        if not self._recovery.is_over(epoch, self.evaluated[epoch], disordered):
            return
        if not self._validated:
            self._initialise_anew(epoch)
            return
        anchor = self._relink.anchor_at(epoch)
        if anchor is None or not self._relink.compare(epoch, anchor).holds:
            self.withheld_for[epoch] = LostTo.RELINK
            return
        self._return(epoch)
        # The restarted bank cannot see a slow drift go on until its slowest average is full: the anchor stays for it.
        if self._hold_to_ns is None:
            self._hold_to_ns = self._t_ns[epoch] + self._memory_ns
        self._hold(epoch)
        self.distance.measure_from(Anchor.at_epoch(self._journey, epoch), epoch)

    def _is_held(self, epoch: int) -> bool:
        return self._hold_to_ns is not None and self._t_ns[epoch] <= self._hold_to_ns

    def _hold(self, epoch: int) -> None:
        """From here on to the anchor of the re-link, or to the telegram that renewed it."""
        anchor = self._relink.anchor_at(epoch)
        if self._hold_to_ns is None or anchor is None:
            return
        end = max(bisect_right(self._t_ns, self._hold_to_ns), epoch)
        self.distance.hold_to(epoch, *self._relink.moved_m(anchor, epoch, end))

    def _initialise_anew(self, epoch: int) -> None:
        """A start of mission, or a fault before anything was validated."""
        self.balises.virtual.forget()
        self.distance.forget(epoch)
        self._chain_from = self._consistent_since_ns = None
        self._validated = False
        if self._use is Use.NEGATED:
            self._return(epoch)
        self._use = Use.IN_USE
        self._note_lrvb(epoch)

    def _return(self, epoch: int) -> None:
        """In use again, but withheld at this epoch, from which the bank restarts."""
        self._use = Use.IN_USE
        self.negated[epoch] = False
        self._bank.restart(epoch)
        self.withheld_for[epoch] = LostTo.RELINK
        # Verdicts before the restart were of the fault that is over.
        self.evaluated[epoch] = self._bank.along_evaluated(epoch)
        self.alarm[epoch] = self._bank.failed(epoch)

    def _note_lrvb(self, epoch: int) -> None:
        self.lrvb_changes.append(LrvbChange(epoch, self.balises.virtual.reference, self._chain_from is not None))
