"""Balises as the train meets them: what the position crosses and the reader reads, offered to the linking chains."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

import numpy as np

from pipeline.stages.lds.crossings import Balise, Crossing
from pipeline.stages.lds.journey import Journey, turning_epochs
from pipeline.stages.lds.link_monitors import LinkOrder, disorder
from pipeline.stages.lds.linking import LinkingChain
from schemas.arrays import Floats
from schemas.config import Configuration, LdsConfig
from schemas.enums import BaliseKind, PassageStatus


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
        for chain in (self.virtual, self.physical) if epoch in self._turns else ():
            chain.turn(self._journey, epoch)

    def read(self, epoch: int) -> list[Crossing]:
        """Telegrams accepted by linking: windows can reject them, no monitor."""
        reads = self._at[BaliseKind.PHYSICAL].get(epoch, ())
        return [read for read in reads if not self._disarmed.holds(read.balise) and self._offer(read, None)]

    def pass_virtual(self, epoch: int, distrusted: bool, entering: bool) -> tuple[list[Crossing], bool]:
        """What was accepted of this step's crossings, and is the order of identities broken?

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
        """By these epochs, at none of which a balise is crossed after the first."""
        if self._disarmed:
            self._disarmed.rearm(begin, end)

    def close_windows(self, epoch: int, t_ns: int) -> None:
        along_m = self._along_m[epoch]
        if along_m > self.virtual.closing_m:
            self.virtual.advance(float(self._journey.odometer_m[epoch]), t_ns, self._absence(epoch))
        if along_m > self.physical.closing_m:
            self.physical.advance(float(self._journey.odometer_m[epoch]), t_ns, PassageStatus.MISSED)

    def finish(self, t_ns: int) -> None:
        """Balises that the train has passed by its odometer when the run ends without a position."""
        known = self._journey.on_odometer
        absence = self._absence(len(self._along_m) - 1) if known.size else PassageStatus.MISSED
        if absence is not PassageStatus.MISSED:
            self.virtual.finish(float(self._journey.odometer_m[known[-1]]), t_ns, absence)

    def _offer(self, crossing: Crossing, refusal: PassageStatus | None) -> bool:
        chain = self.virtual if crossing.balise.kind is BaliseKind.VIRTUAL else self.physical
        self._disarmed.add(crossing)
        return chain.offer(crossing, refusal)

    def _refusal_of(self, crossing: Crossing, distrusted: bool, entering: bool) -> PassageStatus | None:
        """Why this crossing is no detection. A step out of an ambiguous position crosses what the train did not."""
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

    def _absence(self, epoch: int) -> PassageStatus:
        """The status of a balise passed by the train, but not by the position."""
        return self._journey.absence(slice(epoch, epoch + 1)) if self._journey.blind[epoch] else PassageStatus.MISSED

    def _order_fails(self, epoch: int, offered: list[Crossing], overdue: int) -> bool:
        if not self.order.is_evaluated(epoch):
            return False
        out_of_order = disorder(offered, overdue, self._journey, self._config)
        self.order.note(epoch, out_of_order)
        return out_of_order > 0


class Disarmed:
    """Balises just detected, re-armed max(`rearm_m`, `rearm_sigmas`) away (DOMAIN section 4).

    By the odometer; without one by the position's distance from the balise.
    """

    def __init__(self, journey: Journey, config: LdsConfig) -> None:
        self._journey = journey
        self._config = config
        self._at: dict[str, tuple[Balise, float]] = {}

    def __bool__(self) -> bool:
        return bool(self._at)

    def holds(self, balise: Balise) -> bool:
        return balise.balise_id in self._at

    def add(self, crossing: Crossing) -> None:
        odometer_m = float("nan") if crossing.odometer_m is None else crossing.odometer_m
        self._at[crossing.balise.balise_id] = (crossing.balise, odometer_m)

    def rearm(self, begin: int, end: int) -> None:
        """Those that are far enough away at one of the epochs from `begin` on, before `end`."""
        part = slice(begin, end)
        away_m = np.fmax(self._config.rearm_m, self._config.rearm_sigmas * self._journey.sigma_m[part])
        for name, (balise, at_m) in list(self._at.items()):
            if (np.abs(self._moved_m(part, balise, at_m)) >= away_m).any():
                del self._at[name]

    def _moved_m(self, part: slice, balise: Balise, at_m: float) -> Floats:
        if not self._journey.has_odometer:
            return self._journey.path_m[part] - balise.path_m
        odometer_m = self._journey.odometer_m[part]
        if isnan(at_m):
            known = odometer_m[np.isfinite(odometer_m)]
            at_m = float(known[0]) if known.size else at_m
            self._at[balise.balise_id] = (balise, at_m)
        return odometer_m - at_m
