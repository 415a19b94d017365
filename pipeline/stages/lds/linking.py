"""ETCS linking: one chain of announced balises, virtual or physical, and what the train makes of each.

Distances are odometer distances from the last relevant balise, positive in the direction of travel. One balise is
expected at a time, in the order announced.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.stages.lds.crossings import (
    Balise,
    Crossing,
    Journey,
    Passage,
    Window,
    expectation_window,
    window_after_turn,
)
from schemas.config import LdsConfig
from schemas.enums import LinkingError, PassageStatus, Reaction

# SUBSET-026 3.16.2.7 (TVB eq. 4): two consecutive expected balise groups that are not found apply the service brake.
MISSED_IN_A_ROW = 2


@dataclass(frozen=True, slots=True)
class LinkingReference:
    """The last relevant balise: where odometer and distance run were when it was detected."""

    balise: Balise
    odometer_m: float | None
    travelled_m: float


@dataclass(frozen=True, slots=True)
class LrvbChange:
    """The LRVB from `epoch` on, and whether the chain of TVBs has begun."""

    epoch: int
    lrvb: LinkingReference | None
    chain_begun: bool


@dataclass(frozen=True, slots=True)
class _Turn:
    """Odometer distance from the reference at which the train turned, and the distance run up to there [m]."""

    distance_m: float
    travelled_m: float


class _Announced:
    """Announced balises in order of travel."""

    def __init__(self, balises: Sequence[Balise], direction: int) -> None:
        self.balises = balises
        self._direction = direction
        self._along_m = [balise.path_m * direction for balise in balises]
        self._places: dict[str, list[int]] = {}
        for place, balise in enumerate(balises):
            self._places.setdefault(balise.balise_id, []).append(place)

    def place_of(self, balise_id: str, begin: int) -> int | None:
        """Place of a balise among those announced, at `begin` or later; None where there is none."""
        places = self._places.get(balise_id, [])
        first = bisect_left(places, begin)
        return places[first] if first < len(places) else None

    def first_beyond(self, path_m: float) -> int:
        """Place of the first balise beyond a path position [m], in the direction of travel."""
        return bisect_right(self._along_m, path_m * self._direction)


class LinkingChain:
    """Announced balises of one kind, the reference, and the passages so far.

    `closing_m`: odometer reading, times direction of travel, at which the open window closes.
    """

    def __init__(self, balises: Sequence[Balise], config: LdsConfig) -> None:
        self.passages: list[Passage] = []
        self.reference: LinkingReference | None = None
        self._linked = [balise for balise in balises if balise.linked]
        self._announced_ahead: dict[tuple[int | None, int], _Announced] = {}
        self._config = config
        self._direction = 1
        self._leg: int | None = None
        self._turn: _Turn | None = None
        self._ahead = _Announced([], 1)
        self._next = 0
        self._optional: set[str] = set()
        self._missed_in_a_row = 0
        self.closing_m = float("inf")
        # Passages of balises ahead, by an offer before their window closed, and of those whose closed without any.
        self._own: dict[str, Passage] = {}
        self._unoffered: dict[str, Passage] = {}

    @property
    def linking(self) -> bool:
        """Whether linking is in force: windows can be drawn from the reference."""
        return self.reference is not None and self.reference.odometer_m is not None

    def forget(self) -> None:
        """Forget reference and expected balises: a new mission begins."""
        self.reference = None
        self._expect(_Announced([], 1), 0)
        self._own.clear()
        self._unoffered.clear()

    def is_overdue(self, balise: Balise) -> bool:
        """Whether the window of a balise has closed without any offer."""
        return balise.balise_id in self._unoffered

    def advance(self, odometer_m: float, t_ns: int, absence: PassageStatus) -> None:
        """Close the windows that end before this odometer reading; `absence`: status of balises not found in them."""
        if self.linking:
            self._close_windows(self._distance_run_m(odometer_m), t_ns, absence)

    def turn(self, journey: Journey, epoch: int) -> None:
        """The train goes in the other direction, or on another leg: expect the balises ahead of it now.

        Those whose window covers the place of the turn may have been passed or not: they are optional. (Without this 9
        of 10 healthy trains that turn 2 to 24 m before or 15 m behind a balise miss it, and brake.)
        """
        if self.reference is None or not self.linking:
            return
        self._direction = int(journey.direction[epoch])
        self._leg = int(journey.leg[epoch])
        travelled_m = float(journey.travelled_m[epoch]) - self.reference.travelled_m
        self._turn = _Turn(self._distance_run_m(float(journey.odometer_m[epoch])), travelled_m)
        self._own.clear()
        self._unoffered.clear()
        windows = [(balise, self._window_of(balise)) for balise in self._announced_balises().balises]
        here_m = self._turn.distance_m
        self._optional = {balise.balise_id for balise, window in windows if window.holds(here_m)}
        ahead = [balise for balise, window in windows if window.close_m > here_m]
        self._expect(_Announced(ahead, self._direction), 0)

    def offer(self, crossing: Crossing, refusal: PassageStatus | None) -> bool:
        """Judge an offered balise; true where accepted. `refusal`: why it does not count as a detection."""
        distance_m = None
        if self.linking and crossing.odometer_m is not None:
            distance_m = self._distance_run_m(crossing.odometer_m)
            self._close_windows(distance_m, crossing.t_ns, PassageStatus.MISSED)
        overdue = crossing.sense == crossing.direction and self.is_overdue(crossing.balise)
        passage = self._offered_passage(crossing)
        passage.odometer_distance_m = distance_m
        if distance_m is None and not overdue:
            passage.window = None
        if refusal is not None:
            passage.status = refusal
        elif overdue:
            passage.status = PassageStatus.REJECTED_WINDOW
        elif distance_m is None:
            passage.status = PassageStatus.ACCEPTED
        else:
            self._judge_detection(passage, distance_m)
        crossing.offered = True
        crossing.status = passage.status
        accepted = passage.status is PassageStatus.ACCEPTED
        if accepted:
            self._begin_at(crossing)
        return accepted

    def pass_unoffered(self, crossing: Crossing, status: PassageStatus) -> None:
        """The position passed the balise in a gap; `status`: why it was not offered."""
        crossing.status = status
        name = crossing.balise.balise_id
        if crossing.sense != crossing.direction:
            self._own.pop(name, None)
        elif name in self._unoffered:
            self._unoffered[name].status = status
        else:
            passage = self._add_passage(crossing.balise, crossing.t_ns, crossing.direction)
            passage.status = status
            self._own[name] = passage

    def finish(self, odometer_m: float, t_ns: int, absence: PassageStatus) -> None:
        """End of a run without a position: add passages, of status `absence`, of balises passed by the odometer."""
        if not self.linking:
            return
        distance_m = self._distance_run_m(odometer_m)
        for balise in self._ahead.balises[self._next :]:
            not_offered = balise.balise_id not in self._own and balise.balise_id not in self._optional
            if not_offered and self._announced_distance_m(balise) < distance_m:
                passage = self._add_passage(balise, t_ns, self._direction)
                passage.status = absence

    def _distance_run_m(self, odometer_m: float) -> float:
        """Odometer distance from the reference, in the direction of travel [m]."""
        assert self.reference is not None
        assert self.reference.odometer_m is not None
        return (odometer_m - self.reference.odometer_m) * self._direction

    def _announced_distance_m(self, balise: Balise) -> float:
        """Distance of a balise from the reference along the path, in the direction of travel [m]."""
        assert self.reference is not None
        return (balise.path_m - self.reference.balise.path_m) * self._direction

    def _window_of(self, balise: Balise) -> Window:
        """The expectation window of a balise."""
        assert self.reference is not None
        distance_m = self._announced_distance_m(balise)
        reference_accuracy_m = self.reference.balise.accuracy_m
        if self._turn is None:
            return expectation_window(distance_m, balise.accuracy_m, reference_accuracy_m, self._config)
        travelled_m = self._turn.travelled_m + abs(distance_m - self._turn.distance_m)
        margin_m = balise.accuracy_m + reference_accuracy_m + self._config.odometer_fixed_m
        return window_after_turn(distance_m, travelled_m, margin_m, self._config)

    def _judge_detection(self, passage: Passage, distance_m: float) -> None:
        """Set the status of a detection while linking is in force (SUBSET-026 3.16.2.3.1)."""
        balise = passage.balise
        if not balise.linked:
            passage.status = PassageStatus.REJECTED_UNLINKED
            return
        passage.status = PassageStatus.REJECTED_WINDOW
        expected = self._expected_before(balise)
        if expected is None:
            return
        if expected.balise_id == balise.balise_id and self._window_of(balise).holds(distance_m):
            passage.status = PassageStatus.ACCEPTED
        elif expected.balise_id != balise.balise_id and self._window_of(expected).holds(distance_m):
            passage.record(LinkingError.ORDER, expected.reaction)
        else:
            passage.record(LinkingError.EARLY, balise.reaction)

    def _expected_before(self, balise: Balise) -> Balise | None:
        """The first balise ahead that is not optional, up to the offered one; None where this is not ahead."""
        place = self._ahead.place_of(balise.balise_id, self._next)
        if place is None:
            return None
        before = self._ahead.balises[self._next : place]
        required = (expected for expected in before if expected.balise_id not in self._optional)
        return next(required, self._ahead.balises[place])

    def _close_windows(self, distance_m: float, t_ns: int, absence: PassageStatus) -> None:
        """Close the windows that end before this odometer distance, in order."""
        balises = self._ahead.balises
        while self._next < len(balises) and distance_m > self._window_of(balises[self._next]).close_m:
            self._close_window(balises[self._next], t_ns, absence)
            self._expect(self._ahead, self._next + 1)

    def _close_window(self, balise: Balise, t_ns: int, absence: PassageStatus) -> None:
        """Note a balise that was not found in its window; the second in a row brakes (3.16.2.7; TVB eq. 4)."""
        if balise.balise_id in self._optional:
            return
        passage = self._own.pop(balise.balise_id, None)
        if passage is None:
            passage = self._add_passage(balise, t_ns, self._direction)
            passage.status = absence
            self._unoffered[balise.balise_id] = passage
        self._missed_in_a_row += 1
        passage.record(LinkingError.MISSED, balise.reaction)
        if self._missed_in_a_row >= MISSED_IN_A_ROW:
            passage.record(LinkingError.MISSED, Reaction.SERVICE_BRAKE)

    def _begin_at(self, crossing: Crossing) -> None:
        """The accepted balise becomes the reference, and the next ones are expected."""
        balise = crossing.balise
        self.reference = LinkingReference(balise, crossing.odometer_m, crossing.travelled_m)
        self._direction = crossing.direction
        self._leg = balise.leg
        self._turn = None
        self._missed_in_a_row = 0
        self._optional = set()
        self._own.pop(balise.balise_id, None)
        announced = self._announced_balises() if self.linking else _Announced([], 1)
        self._expect(announced, announced.first_beyond(balise.path_m))

    def _announced_balises(self) -> _Announced:
        """The announced balises of the leg, valid in the direction of travel, in order of travel."""
        leg = self._leg
        direction = self._direction
        if (leg, direction) not in self._announced_ahead:
            valid = [balise for balise in self._linked if balise.leg == leg and balise.is_valid_for(direction)]
            self._announced_ahead[leg, direction] = _Announced(valid[::direction], direction)
        return self._announced_ahead[leg, direction]

    def _expect(self, announced: _Announced, first: int) -> None:
        """Expect these balises, from the one at place `first` on."""
        self._ahead = announced
        self._next = first
        self.closing_m = float("inf")
        if first < len(announced.balises) and self.reference is not None and self.reference.odometer_m is not None:
            start_m = self.reference.odometer_m * self._direction
            self.closing_m = start_m + self._window_of(announced.balises[first]).close_m

    def _offered_passage(self, crossing: Crossing) -> Passage:
        """The passage of an offer: a new one, or that whose window closed before."""
        name = crossing.balise.balise_id
        forward = crossing.sense == crossing.direction
        passage = self._unoffered.pop(name, None) if forward else None
        if passage is None:
            passage = self._add_passage(crossing.balise, crossing.t_ns, crossing.direction)
            self._own.pop(name, None)
            if forward:
                self._own[name] = passage
        passage.crossing = crossing
        passage.t_ns = crossing.t_ns
        return passage

    def _add_passage(self, balise: Balise, t_ns: int, direction: int) -> Passage:
        """Add a passage, with its window if the balise is still ahead."""
        passage = Passage(balise, t_ns, direction)
        if self._ahead.place_of(balise.balise_id, self._next) is not None:
            passage.window = self._window_of(balise)
        if self.reference is not None and self.reference.odometer_m is not None:
            along_m = balise.path_m - self.reference.balise.path_m
            passage.announced_odometer_m = self.reference.odometer_m + along_m
        self.passages.append(passage)
        return passage
