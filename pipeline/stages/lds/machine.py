"""The walk of the LDS along the epochs.

`LocationSystem` takes it epoch by epoch and holds whether the position is in use; `BaliseDetection` offers the balises
crossed to the linking chains.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from enum import Enum, auto

from pipeline.stages.lds.crossings import (
    Balise,
    Crossing,
    Disarmed,
    Journey,
    mission_epochs,
    odometer_doubt_epochs,
    turning_epochs,
    unwatched_epochs,
)
from pipeline.stages.lds.link_monitors import (
    Anchor,
    Held,
    LinkDistance,
    LinkOrder,
    Recovery,
    Relink,
    count_out_of_order,
)
from pipeline.stages.lds.linking import LinkingChain, LrvbChange
from pipeline.stages.monitors.bank import MonitorBank
from schemas.arrays import NS_PER_S
from schemas.config import Configuration
from schemas.enums import BaliseKind, LostTo, PassageStatus


class BaliseDetection:
    """Virtual and physical balises, asked epoch by epoch, in order. `events`: epochs at which something happens."""

    def __init__(
        self,
        journey: Journey,
        balises: dict[BaliseKind, list[Balise]],
        crossings: Sequence[Crossing],
        config: Configuration,
    ) -> None:
        self._journey = journey
        self._config = config
        self._at: dict[BaliseKind, dict[int, list[Crossing]]] = {kind: {} for kind in BaliseKind}
        for crossing in crossings:
            self._at[crossing.balise.kind].setdefault(crossing.epoch, []).append(crossing)
        self._turns = turning_epochs(journey)
        self._disarmed = Disarmed(journey, config.lds)
        self._along_m: list[float] = (journey.odometer_m * journey.direction).tolist()
        self.virtual = LinkingChain(balises[BaliseKind.VIRTUAL], config.lds)
        # A run without telegrams has no reader, so its physical balises have no passages.
        self.physical = LinkingChain(balises[BaliseKind.PHYSICAL] if self._at[BaliseKind.PHYSICAL] else [], config.lds)
        self.order = LinkOrder(journey, config)
        self.events = sorted({*self._turns, *(crossing.epoch for crossing in crossings)})

    @property
    def closing_m(self) -> float:
        """Odometer reading, times direction of travel, at which the next window closes."""
        return min(self.virtual.closing_m, self.physical.closing_m)

    def turn(self, epoch: int) -> None:
        """Tell the chains of a turn, where there is one at this epoch."""
        for chain in (self.virtual, self.physical) if epoch in self._turns else ():
            chain.turn(self._journey, epoch)

    def read(self, epoch: int) -> list[Crossing]:
        """Telegrams accepted by linking: windows can reject them, no monitor."""
        reads = self._at[BaliseKind.PHYSICAL].get(epoch, ())
        return [read for read in reads if not self._disarmed.holds(read.balise) and self._offer(read, None)]

    def pass_virtual(self, epoch: int, distrusted: bool, entering: bool) -> tuple[list[Crossing], bool]:
        """The crossings of this step that are accepted, and whether the order of identities is broken.

        `distrusted`: negated, withheld, or a monitor fails; `entering`: no chain has begun.
        """
        offered: list[Crossing] = []
        for crossing in self._at[BaliseKind.VIRTUAL].get(epoch, ()):
            if self._disarmed.holds(crossing.balise):
                continue
            if crossing.absence is None:
                offered.append(crossing)
            else:
                self.virtual.pass_unoffered(crossing, crossing.absence)
                self._disarmed.add(crossing)
        if not offered:
            return [], False
        overdue = sum(self.virtual.is_overdue(crossing.balise) for crossing in offered)
        refusals = [(crossing, self._refusal_of(crossing, distrusted, entering)) for crossing in offered]
        accepted = [crossing for crossing, refusal in refusals if self._offer(crossing, refusal)]
        return accepted, self._order_fails(epoch, offered, overdue)

    def rearm(self, begin: int, end: int) -> None:
        """Re-arm balises by these epochs, at none of which a balise is crossed after the first."""
        if self._disarmed:
            self._disarmed.rearm(begin, end)

    def close_windows(self, epoch: int, t_ns: int) -> None:
        """Close the windows that end before the odometer of this epoch."""
        along_m = self._along_m[epoch]
        if along_m > self.virtual.closing_m:
            self.virtual.advance(float(self._journey.odometer_m[epoch]), t_ns, self._absence_status(epoch))
        if along_m > self.physical.closing_m:
            self.physical.advance(float(self._journey.odometer_m[epoch]), t_ns, PassageStatus.MISSED)

    def finish(self, t_ns: int) -> None:
        """Add the balises that the train has passed by its odometer when the run ends without a position."""
        known = self._journey.with_odometer
        absence = self._absence_status(len(self._along_m) - 1) if known.size else PassageStatus.MISSED
        if absence is not PassageStatus.MISSED:
            self.virtual.finish(float(self._journey.odometer_m[known[-1]]), t_ns, absence)

    def _offer(self, crossing: Crossing, refusal: PassageStatus | None) -> bool:
        """Offer a crossing to its chain; whether it is accepted."""
        chain = self.virtual if crossing.balise.kind is BaliseKind.VIRTUAL else self.physical
        self._disarmed.add(crossing)
        return chain.offer(crossing, refusal)

    def _refusal_of(self, crossing: Crossing, distrusted: bool, entering: bool) -> PassageStatus | None:
        """Why this crossing is no detection; None where it is one.

        A step out of an ambiguous position crosses what the train did not.
        """
        if distrusted:
            # "The noise is known and no monitor has failed" is one condition of a detection (DOMAIN section 4).
            return PassageStatus.REJECTED_MONITOR
        if self._journey.refusal[crossing.before] is PassageStatus.REJECTED_AMBIGUOUS:
            return PassageStatus.REJECTED_AMBIGUOUS
        refusal = self._journey.refusal[crossing.epoch]
        if refusal is None and entering and self._config.lds.entry_from_unfitted_area and self._journey.has_odometer:
            # Insertion is what endangers an entry: the diagnosis must stand behind the first VB too.
            return PassageStatus.REJECTED_MONITOR
        return refusal

    def _absence_status(self, epoch: int) -> PassageStatus:
        """The status of a balise passed by the train, but not by the position."""
        return self._journey.absence(slice(epoch, epoch + 1)) if self._journey.blind[epoch] else PassageStatus.MISSED

    def _order_fails(self, epoch: int, offered: list[Crossing], overdue: int) -> bool:
        """Note and return whether balises of this step were offered out of order."""
        if not self.order.is_evaluated(epoch):
            return False
        out_of_order = count_out_of_order(offered, overdue, self._journey, self._config)
        self.order.note(epoch, out_of_order)
        return out_of_order > 0


class Use(Enum):
    """Whether the train uses the position (DOMAIN section 4).

    | from | when | to |
    |---|---|---|
    | in use | after a validation: the odometer reports slip, or nothing watched (an outage, noise) | withheld |
    | withheld | a usable position re-links | in use |
    | any but negated | a monitor fails; without slip the re-link too, where the position has moved | negated |
    | negated | `recovery_s` without a fast failure, and it re-links | in use |
    | any | a start of mission; in negated also recovery where nothing was validated before | in use |
    """

    IN_USE = auto()
    WITHHELD = auto()
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
        self._odometer_along_m = journey.odometer_m * journey.direction
        self._unwatched = unwatched_epochs(journey, bank.watched, config.align.gap_reset_s)
        self._bridged_ns = round(config.align.gap_reset_s * NS_PER_S)
        self._missions = mission_epochs(journey, config.lds)
        self._events = sorted(
            {*self.balises.events, *self._unwatched, *self._missions, *odometer_doubt_epochs(journey)}
        )
        self._relink = Relink(journey, self.tvb, config)
        self._use = Use.IN_USE
        self._slipped = False  # withheld for slip
        self._hidden_ns: int | None = None  # since when noise hides the position
        self._recovery = Recovery(journey, bank, config)
        self._validated = False  # a VB or a TVB
        self._chain_from: int | None = None  # validated positions after this epoch are TVBs
        self._consistent_since_ns: int | None = None
        self._consistent_at_ns = 0

    @property
    def held(self) -> list[Held]:
        """The re-links that held."""
        return self._relink.held

    def run(self) -> None:
        """Walk from the first epoch to the last."""
        epoch = 0
        while epoch < len(self._t_ns):
            if (end := self._uneventful_until(epoch)) > epoch:
                self._pass_uneventful(epoch, end)
            elif (end := self._hidden_until(epoch)) > epoch:
                self._pass_hidden(epoch, end)
            else:
                self._step(epoch)
            epoch = max(end, epoch + 1)
        if epoch:
            self.balises.finish(self._t_ns[-1])

    def _uneventful_until(self, epoch: int) -> int:
        """The first epoch from here on for `_step`; those before are TVBs where evaluated and usable.

        Uneventful is a position in use, in a begun chain, up to the next event, alarm or end of a window.
        """
        if self._use is not Use.IN_USE or self._withheld_cause(epoch) is not None or self._hidden_ns is not None:
            return epoch
        if self._chain_from is None or epoch <= self._chain_from:
            return epoch
        if self._journey.has_odometer and not self.distance.can_measure(epoch):
            return epoch
        end = self._next_event(epoch)
        for monitors in (self._bank, self.distance):
            end = monitors.first_alarm_from(epoch, end) if end > epoch else epoch
        return self._first_window_end(epoch, end)

    def _next_event(self, epoch: int) -> int:
        """The first event at this epoch or later; the number of epochs where none is left."""
        near = bisect_left(self._events, epoch)
        return self._events[near] if near < len(self._events) else len(self._t_ns)

    def _first_window_end(self, epoch: int, end: int) -> int:
        """The first epoch before `end` at which the window of a balise closes, else `end`."""
        closing = self._odometer_along_m[epoch:end] > self.balises.closing_m
        return epoch + int(closing.argmax()) if closing.any() else end

    def _pass_uneventful(self, epoch: int, end: int) -> None:
        """Write the epochs before `end` as uneventful."""
        evaluated = self._bank.along_evaluated_between(epoch, end)
        self.evaluated[epoch:end] = evaluated.tolist()
        self.tvb[epoch:end] = (evaluated & self._journey.usable[epoch:end]).tolist()
        self._validated = True
        self.balises.rearm(epoch, end)

    def _hidden_until(self, epoch: int) -> int:
        """The first epoch from here on for `_step`; before it the noise is unknown, and nothing was validated yet."""
        if self._use is not Use.IN_USE or self._validated or self.distance.has_anchor:
            return epoch
        end = self._next_event(epoch)
        return self._first_window_end(epoch, self._bank.hidden_until(epoch, end)) if end > epoch else epoch

    def _pass_hidden(self, epoch: int, end: int) -> None:
        """Write the epochs before `end` as withheld for noise."""
        self.withheld_for[epoch:end] = [LostTo.NOISE] * (end - epoch)
        self._hidden_ns = self._t_ns[epoch] if self._hidden_ns is None else self._hidden_ns
        if self._journey.slips[epoch:end].any():
            self._consistent_since_ns = None
        self.balises.rearm(epoch, end)

    def _step(self, epoch: int) -> None:
        """One epoch: telegrams, use, crossings, windows, alarm, then negation, return or validation."""
        if epoch in self._missions:
            self._relink.begin_mission(epoch)
            self._initialise_anew(epoch)
        self.balises.turn(epoch)
        for read in self.balises.read(epoch):
            if read.t_ns > self._t_ns[epoch]:
                continue  # behind the last epoch: the position was no longer there to learn of it
            self._relink.note_read(read)
            if self._relink.is_held(epoch):
                self.distance.hold_to_relink_anchor(epoch, *self._relink.movement_in_hold_m(epoch))
        bank_failed = self._bank.failed(epoch)
        self._watch(epoch)
        self.withheld_for[epoch] = self._withheld_cause(epoch)
        withheld = self.withheld_for[epoch] is not None
        distrusted = bank_failed or self.distance.fails(epoch) or self._use is Use.NEGATED or withheld
        accepted, disordered = self.balises.pass_virtual(epoch, distrusted, self._chain_from is None)
        for crossing in accepted:
            self._accept_crossing(crossing, epoch)
        self.balises.rearm(epoch, epoch + 1)
        self.balises.close_windows(epoch, self._t_ns[epoch])
        self.evaluated[epoch] = self._bank.along_evaluated(epoch)
        self.alarm[epoch] = bank_failed or disordered or self.distance.fails(epoch)
        if self._use is Use.NEGATED:
            self._seek_return(epoch, disordered)
        elif self.alarm[epoch]:
            self._negate(epoch)
        elif self.evaluated[epoch] and self._journey.usable[epoch] and not withheld:
            self._validate(epoch)

    def _withheld_cause(self, epoch: int) -> LostTo | None:
        """Why the position is withheld at this epoch; None where it is not."""
        if not self._bank.noise_known_at(epoch):
            return LostTo.NOISE
        if self._journey.slips[epoch]:
            return LostTo.SLIP
        return LostTo.RELINK if self._use is Use.WITHHELD or self._bank.begins_at(epoch) else None

    def _watch(self, epoch: int) -> None:
        """Leave use for slip, noise that hides the position, or an outage; come back where the position re-links."""
        slips = bool(self._journey.slips[epoch])
        if slips:
            self._consistent_since_ns = None
        unwatched = self._was_hidden(epoch) or epoch in self._unwatched
        if self._validated and self._use is not Use.NEGATED:
            if slips and not (self._use is Use.WITHHELD and self._slipped):
                self._withhold(epoch, slipped=True)
            elif unwatched and self._use is Use.IN_USE:
                self._withhold(epoch, slipped=False)
        if self._use is Use.WITHHELD and not slips and self._can_return(epoch):
            self._return_unsuspected(epoch)

    def _was_hidden(self, epoch: int) -> bool:
        """Whether noise hid what the position did, for longer than the bank bridges, until this epoch."""
        if not self._bank.noise_known_at(epoch):
            self._hidden_ns = self._t_ns[epoch] if self._hidden_ns is None else self._hidden_ns
            return False
        since_ns, self._hidden_ns = self._hidden_ns, None
        return since_ns is not None and self._t_ns[epoch] - since_ns > self._bridged_ns

    def _withhold(self, epoch: int, slipped: bool) -> None:
        """Leave use without an alarm; `slipped`: for slip of the odometer."""
        self._relink.withhold(epoch, suspected=slipped)
        self._slipped = slipped
        self._use = Use.WITHHELD

    def _can_return(self, epoch: int) -> bool:
        """Whether the odometer can be compared with a usable position whose noise is known."""
        return bool(self._journey.comparable[epoch]) and self._bank.noise_known_at(epoch)

    def _return_unsuspected(self, epoch: int) -> None:
        """Re-link a withheld position: back in use where it holds, an alarm where it has moved."""
        comparison = self._relink.compare(epoch)
        if comparison.holds:
            self._use = Use.IN_USE
            self._hold_to_anchor(epoch)
            if self._slipped:
                self.distance.measure_from(Anchor.at_epoch(self._journey, epoch), epoch)
        if not self._slipped:
            # That it has moved is an alarm, unless the odometer itself is in doubt.
            self.distance.note_comparison(comparison, epoch)

    def _accept_crossing(self, crossing: Crossing, epoch: int) -> None:
        """An accepted balise is the LRVB and begins the chain of TVBs."""
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
        """Whether the position was consistent for `init_s`; a TVB may arise between two VBs (SR)."""
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
        """Negate the position after an alarm."""
        self._relink.withhold(epoch, suspected=True)
        self._bank.freeze(epoch)
        self._use = Use.NEGATED
        self._recovery.begin(epoch)
        self.negated[epoch] = True
        self._consistent_since_ns = None

    def _seek_return(self, epoch: int, disordered: bool) -> None:
        """Return to use after recovery if the position re-links, or anew where nothing was validated before."""
        self.negated[epoch] = True
        if not self._recovery.is_over(epoch, self.evaluated[epoch], disordered):
            return
        if not self._validated:
            self._initialise_anew(epoch)
            return
        if not self._relink.compare(epoch).holds:
            self.withheld_for[epoch] = LostTo.RELINK
            return
        self._return_to_use(epoch)
        self._hold_to_anchor(epoch)
        self.distance.measure_from(Anchor.at_epoch(self._journey, epoch), epoch)

    def _hold_to_anchor(self, epoch: int) -> None:
        """From a return on the distance since the anchor counts, while the slow averages cannot see a drift go on."""
        self._relink.hold(epoch)
        self.distance.hold_to_relink_anchor(epoch, *self._relink.movement_in_hold_m(epoch))

    def _initialise_anew(self, epoch: int) -> None:
        """Begin without LRVB and chain: a start of mission, or a fault before anything was validated."""
        self.balises.virtual.forget()
        self.distance.forget(epoch)
        self._chain_from = self._consistent_since_ns = None
        self._validated = False
        if self._use is Use.NEGATED:
            self._return_to_use(epoch)
        self._use = Use.IN_USE
        self._note_lrvb(epoch)

    def _return_to_use(self, epoch: int) -> None:
        """In use again, but withheld at this epoch, from which the bank restarts."""
        self._use = Use.IN_USE
        self.negated[epoch] = False
        self._bank.restart(epoch)
        self.withheld_for[epoch] = LostTo.RELINK
        # Verdicts before the restart were of the fault that is over.
        self.evaluated[epoch] = self._bank.along_evaluated(epoch)
        self.alarm[epoch] = self._bank.failed(epoch)

    def _note_lrvb(self, epoch: int) -> None:
        """Note which LRVB is in force from this epoch on."""
        self.lrvb_changes.append(LrvbChange(epoch, self.balises.virtual.reference, self._chain_from is not None))
