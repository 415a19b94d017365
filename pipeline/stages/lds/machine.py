"""The location determination system: one walk along the epochs of a solution, with one state of its position.

In any state a position is *withheld* where the diagnosis itself says that it cannot stand behind it (DOMAIN section
5.2): no VB is accepted, no TVB is valid.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from enum import Enum, auto

from pipeline.stages.lds.crossings import Balise, Crossing
from pipeline.stages.lds.detection import BaliseDetection
from pipeline.stages.lds.journey import Journey, mission_epochs, odometer_epochs
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
    | in use | an outage, or the noise hides what the position does | unseen |
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

    Per epoch: `tvb`, `alarm`, `negated`, `evaluated` (`along_raw` has a verdict), `withheld_for` (why the position is
    not used though no monitor fails, None where it is).
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
        self._after_outages = frozenset(bank.after_outages.tolist())
        self._bridged_ns = round(config.align.gap_reset_s * NS_PER_S)
        self._memory_ns = round(NS_PER_S / min(config.monitors.ewma_alphas))
        self._missions = mission_epochs(journey, config.lds)
        self._events = sorted({*self.balises.events, *self._after_outages, *self._missions, *odometer_epochs(journey)})
        self._relink = Relink(journey, self.tvb, config)
        self._use = Use.IN_USE
        self._since = 0  # the epoch from which the position is slipped or unseen
        self._recovery = Recovery(journey, bank, config)
        self._hold_to_ns: int | None = None  # since the first return after an alarm of the bank
        self._validated = False  # a VB or a TVB
        self._chain_from: int | None = None  # validated positions after this epoch are TVBs
        self._consistent_since_ns: int | None = None
        self._consistent_at_ns = 0

    @property
    def held(self) -> list[Held]:
        """The re-links that held, in order."""
        return self._relink.held

    def run(self) -> None:
        """Walk along all epochs."""
        k = 0
        while k < len(self._t_ns):
            end = self._uneventful_until(k)
            if end > k:
                self._pass_uneventful(k, end)
            else:
                self._step(k)
            k = max(end, k + 1)
        if k:
            self.balises.finish(self._t_ns[-1])

    def _uneventful_until(self, k: int) -> int:
        """The first epoch from `k` on that has to be stepped through; those before it can only be TVBs.

        So it is on linked way where no balise, read, turn, outage, loss of distance, alarm or end of a window is near.
        """
        if self._use is not Use.IN_USE or self._withheld_for(k) is not None:
            return k
        if self.balises.disarmed or self._chain_from is None or k <= self._chain_from:
            return k
        if self._journey.has_odometer and not self.distance.can_measure(k):
            return k
        near = bisect_left(self._events, k)
        end = self._events[near] if near < len(self._events) else len(self._t_ns)
        for monitors in (self._bank, self.distance):
            end = monitors.quiet_until(k, end) if end > k else k
        closing = self._way_m[k:end] > self.balises.closing_m
        return k + int(closing.argmax()) if closing.any() else end

    def _pass_uneventful(self, k: int, end: int) -> None:
        evaluated = self._bank.along_evaluated_between(k, end)
        self.evaluated[k:end] = evaluated.tolist()
        self.tvb[k:end] = (evaluated & self._journey.usable[k:end]).tolist()
        self._validated = True

    def _step(self, k: int) -> None:
        if k in self._missions:
            self._relink.begin_mission(k)
            self._hold_to_ns = None
            self._initialise_anew(k)
        self.balises.turn(k)
        for read in self.balises.read(k):
            self._relink.note_read(read)
            self._hold(k)
        bank_failed = self._bank.failed(k)
        self._watch(k)
        self.withheld_for[k] = self._withheld_for(k)
        withheld = self.withheld_for[k] is not None
        distrusted = bank_failed or self.distance.fails(k) or self._use is Use.NEGATED or withheld
        accepted, disordered = self.balises.pass_virtual(k, distrusted, self._chain_from is None)
        for crossing in accepted:
            self._accept(crossing, k)
        self.balises.rearm(k)
        self.balises.close_windows(k, self._t_ns[k])
        self.evaluated[k] = self._bank.along_evaluated(k)
        self.alarm[k] = bank_failed or disordered or self.distance.fails(k)
        if self._use is Use.NEGATED:
            self._seek_return(k, disordered)
        elif self.alarm[k]:
            self._negate(k)
        elif self.evaluated[k] and self._journey.usable[k] and not withheld:
            self._validate(k)

    def _withheld_for(self, k: int) -> LostTo | None:
        """Why the diagnosis cannot stand behind a position here, as it says itself (DOMAIN section 5.2)."""
        if not self._bank.noise_known_at(k):
            return LostTo.NOISE
        if self._journey.slips[k]:
            return LostTo.SLIP
        return LostTo.RELINK if self._use is Use.SLIPPED or self._bank.begins_at(k) else None

    def _watch(self, k: int) -> None:
        """Whether anybody looks on at the position, or has looked on until now."""
        if self._journey.slips[k]:
            self._consistent_since_ns = None
            if self._use in (Use.IN_USE, Use.UNSEEN) and self._validated:
                self._use = Use.SLIPPED
                self._since = k
        elif self._use is Use.SLIPPED:
            self._relink_after_slip(k)
        if self._use is Use.IN_USE and not self._bank.noise_known_at(k):
            self._use = Use.UNSEEN
            self._since = k
        if self._use in (Use.IN_USE, Use.UNSEEN) and k in self._after_outages:
            # The last epoch that lies farther back than the bank bridges: there is one before an outage.
            self._use = Use.UNSEEN
            self._since = bisect_left(self._t_ns, self._t_ns[k] - self._bridged_ns) - 1
        if self._use is Use.UNSEEN and self._bank.noise_known_at(k) and self._can_return(k):
            self._relink_unseen(k)

    def _can_return(self, k: int) -> bool:
        return self.distance.is_possible(k) and bool(self._journey.usable[k])

    def _relink_after_slip(self, k: int) -> None:
        # Several slips would each let a held position go on by as much as one may.
        anchor = self._relink.anchor_at(k) if self._is_held(k) else self._relink.anchor_before_slip(self._since)
        if self._can_return(k) and self._relink.compare(k, anchor).holds:
            self._use = Use.IN_USE
            self.distance.measure_from(Anchor.at_epoch(self._journey, k), k)

    def _relink_unseen(self, k: int) -> None:
        """The first usable position after an outage or the noise: where it moved meanwhile, that is an alarm."""
        self._use = Use.IN_USE
        if self._validated and self._t_ns[k] - self._t_ns[self._since] > self._bridged_ns:
            comparison = self._relink.compare(k, self._relink.anchor_at(k))
            self.distance.hold_against(comparison, k)
            if comparison.reason is not None:
                self._negate(k)

    def _accept(self, crossing: Crossing, k: int) -> None:
        self.accepted_at_ns[k] = crossing.t_ns
        crossing.initialising = not self._validated
        self._validated = True
        self._chain_from = k if self._chain_from is None else self._chain_from
        anchor = Anchor.at_crossing(self._journey, crossing, float(self._journey.sigma_m[k]))
        if anchor is not None:
            self.distance.measure_from(anchor, k)
        self._note_lrvb(k)

    def _validate(self, k: int) -> None:
        """A usable position that the diagnosis stands behind is a TVB once the chain has begun."""
        if self._has_initialised(k) if self._chain_from is None else k > self._chain_from:
            self.tvb[k] = self._validated = True
            if not self.distance.can_measure(k):
                self.distance.measure_from(Anchor.at_epoch(self._journey, k), k)

    def _has_initialised(self, k: int) -> bool:
        """Consistent for `init_s` without a break: a TVB may arise between two VBs (SR)."""
        t_ns = self._t_ns[k]
        if self._consistent_since_ns is None or t_ns - self._consistent_at_ns > self._journey.gap_ns:
            self._consistent_since_ns = t_ns
        self._consistent_at_ns = t_ns
        if t_ns - self._consistent_since_ns < self._config.lds.init_s * NS_PER_S:
            return False
        self._chain_from = k
        self._note_lrvb(k)
        return True

    def _negate(self, k: int) -> None:
        # A jump fails the slow averages too: how old a drift may be is said by them where they fail alone.
        self._relink.note_alarm(k, 0.0 if self._bank.fast_failed(k) else self._bank.failing_memory_s(k))
        if self._bank.failed(k):
            self._hold_to_ns = None
        self._bank.freeze(k)
        self._use = Use.NEGATED
        self._recovery.begin(k)
        self.negated[k] = True
        self._consistent_since_ns = None

    def _seek_return(self, k: int, disordered: bool) -> None:
        self.negated[k] = True
        if not self._recovery.is_over(k, self.evaluated[k], disordered):
            return
        if not self._validated:
            self._initialise_anew(k)
            return
        anchor = self._relink.anchor_at(k)
        if anchor is None or not self._relink.compare(k, anchor).holds:
            self.withheld_for[k] = LostTo.RELINK
            return
        self._return(k)
        # The bank begins anew: for the memory of its slowest average nothing else would see a slow drift go on.
        if self._hold_to_ns is None:
            self._hold_to_ns = self._t_ns[k] + self._memory_ns
        self._hold(k)
        self.distance.measure_from(Anchor.at_epoch(self._journey, k), k)

    def _is_held(self, k: int) -> bool:
        return self._hold_to_ns is not None and self._t_ns[k] <= self._hold_to_ns

    def _hold(self, k: int) -> None:
        """From here on to the anchor of the re-link, or to the telegram that renewed it."""
        anchor = self._relink.anchor_at(k)
        if self._hold_to_ns is None or anchor is None:
            return
        end = max(bisect_right(self._t_ns, self._hold_to_ns), k)
        self.distance.hold_to(k, *self._relink.moved_m(anchor, k, end))

    def _initialise_anew(self, k: int) -> None:
        """No reference and no linking: a start of mission, or a fault before anything was validated."""
        self.balises.virtual.forget()
        self.distance.forget(k)
        self._chain_from = self._consistent_since_ns = None
        self._validated = False
        if self._use is Use.NEGATED:
            self._return(k)
        self._use = Use.IN_USE
        self._note_lrvb(k)

    def _return(self, k: int) -> None:
        self._use = Use.IN_USE
        self.negated[k] = False
        self._bank.restart(k)
        self.withheld_for[k] = LostTo.RELINK
        # What still rang at this epoch belonged to the fault that is over.
        self.evaluated[k] = self._bank.along_evaluated(k)
        self.alarm[k] = self._bank.failed(k)

    def _note_lrvb(self, k: int) -> None:
        self.lrvb_changes.append(LrvbChange(k, self.balises.virtual.reference, self._chain_from is not None))
