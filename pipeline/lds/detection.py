"""Balises as the train meets them: what the position passes and the reader reads, offered to the linking chains."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

import numpy as np

from pipeline.lds.bank_protocol import LdsLimits
from pipeline.lds.crossings import Balise, Crossing, Seen, find_crossings
from pipeline.lds.journey import Journey, turning_epochs
from pipeline.lds.link_monitors import LinkOrder, disorder
from pipeline.lds.linking import LinkingChain
from pipeline.lds.passage import Offer
from pipeline.lds.reads import Read
from pipeline.lds.rearming import Latch
from schemas.config import LdsConfig
from schemas.enums import PassageStatus


class BaliseDetection:
    """Virtual and physical balises along a journey; asked epoch by epoch, in order.

    `events`: the epochs at which a balise is passed or read, or the train turns.
    """

    def __init__(
        self,
        journey: Journey,
        virtual: Sequence[Balise],
        physical: Sequence[Balise],
        reads: Sequence[Read],
        config: LdsConfig,
        limits: LdsLimits,
    ) -> None:
        self._journey, self._config, self._limits = journey, config, limits
        self._has_odometer = journey.has_odometer
        self._crossings = find_crossings(journey, virtual)
        self._reads: dict[int, list[Read]] = {}
        for read in reads:
            self._reads.setdefault(read.epoch, []).append(read)
        self._turns = turning_epochs(journey)
        self._latch = Latch(journey, config)
        self._along_m: list[float] = (journey.odometer_m * journey.heading).tolist()
        self.virtual = LinkingChain(virtual, config)
        self.physical = LinkingChain(physical if reads else [], config)
        self.order = LinkOrder(journey, limits)
        self.events = sorted({*self._turns, *self._reads, *self._crossings})

    @property
    def closing_m(self) -> float:
        """Odometer reading, times direction of travel, at which the next window closes."""
        return min(self.virtual.closing_m, self.physical.closing_m)

    @property
    def latched(self) -> bool:
        """A balise was detected so near that noise could detect it again."""
        return bool(self._latch)

    def turn(self, k: int) -> None:
        """Both chains learn that the train goes another way from this epoch on."""
        if k not in self._turns:
            return
        journey = self._journey
        for chain in (self.virtual, self.physical):
            chain.turn(
                float(journey.odometer_m[k]),
                float(journey.travelled_m[k]),
                int(journey.heading[k]),
                int(journey.leg[k]),
            )

    def read(self, k: int) -> list[Read]:
        """Telegrams accepted by the rules of linking; only windows can reject them, no monitor."""
        accepted: list[Read] = []
        heading = int(self._journey.heading[k])
        for read in self._reads.get(k, ()):
            if self._latch.holds(read.balise):
                continue
            offer = Offer(read.balise, read.t_ns, heading, heading, read.odometer_m, read.travelled_m, None, None)
            passage = self.physical.offer(offer)
            self._latch.disarm(read.balise, read.odometer_m)
            if passage.status is PassageStatus.ACCEPTED:
                accepted.append(read)
        return accepted

    def pass_virtual(self, k: int, distrusted: bool, entering: bool) -> tuple[list[Offer], bool]:
        """Offer what the position passed in this step: what was accepted, and is the order of identities broken?

        `distrusted`: negated, or a monitor fails; `entering`: no chain has begun.
        """
        offered: list[Crossing] = []
        for crossing in self._crossings.get(k, ()):
            if self._latch.holds(crossing.balise):
                self.virtual.cross_again(crossing.balise, crossing.sense, self._heading(crossing))
            elif crossing.seen is Seen.CROSSED:
                offered.append(crossing)
            else:
                self._pass_unseen(crossing)
        if not offered:
            return [], False
        overdue = sum(self.virtual.is_overdue(crossing.balise) for crossing in offered)
        offers = [self._offer_of(crossing, self._refusal_of(crossing, distrusted, entering)) for crossing in offered]
        accepted = [offer for offer in offers if self._offer(offer)]
        return accepted, self._order_fails(k, offered, overdue)

    def rearm(self, k: int) -> None:
        """Balises that the train has left behind can be detected again."""
        if self._latch:
            self._latch.advance(k)

    def close_windows(self, k: int, t_ns: int) -> None:
        """Windows that the train has left are closed."""
        along_m = self._along_m[k]
        if along_m > self.virtual.closing_m:
            self.virtual.advance(float(self._journey.odometer_m[k]), t_ns, self._absence(k))
        if along_m > self.physical.closing_m:
            self.physical.advance(float(self._journey.odometer_m[k]), t_ns, PassageStatus.MISSED)

    def finish(self, t_ns: int) -> None:
        """Balises that the train has passed by its reckoning when the run ends without a position."""
        known = np.flatnonzero(np.isfinite(self._journey.odometer_m))
        absence = self._absence(len(self._along_m) - 1) if known.size else PassageStatus.MISSED
        if absence is not PassageStatus.MISSED:
            self.virtual.finish(float(self._journey.odometer_m[known[-1]]), t_ns, absence)

    def _offer(self, offer: Offer) -> bool:
        passage = self.virtual.offer(offer)
        self._latch.disarm(offer.balise, offer.odometer_m)
        return passage.status is PassageStatus.ACCEPTED

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

    def _refusal_of(self, crossing: Crossing, distrusted: bool, entering: bool) -> PassageStatus | None:
        """Why a virtual balise is not detected at this crossing, whatever linking says.

        A step out of an ambiguous position passes what the train did not.
        """
        if distrusted:
            return PassageStatus.REJECTED_MONITOR
        if self._journey.refusal[crossing.before] is PassageStatus.REJECTED_AMBIGUOUS:
            return PassageStatus.REJECTED_AMBIGUOUS
        refusal = self._journey.refusal[crossing.epoch]
        if refusal is None and entering and self._config.entry_from_unfitted_area and self._has_odometer:
            # Insertion is what endangers an entry: the diagnosis must stand behind the first VB too.
            return PassageStatus.REJECTED_MONITOR
        return refusal

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
