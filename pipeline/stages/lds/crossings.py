"""What the LDS walks along: epochs as columns, crossings and telegrams of balises, expectation windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isnan
from typing import NamedTuple, TypeVar

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import Passing, crossing_gaps_ns, passings
from pipeline.stages.odometry.bound import is_lost
from pipeline.stages.odometry.driven import turns_of
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, spans_of
from schemas.config import Configuration, LdsConfig
from schemas.enums import BaliseKind, LinkingError, PassageStatus, Reaction
from schemas.stages import AlignedEpochs, Crossings

AnyArray = TypeVar("AnyArray", Floats, Ints)


class Journey:
    """Epochs in order of time; NaN is not known. Names are those of `schemas.stages.AlignedEpochs`, but:

    `refusal`: why a detection here would not count, None where it would. `direction` of travel (+1/-1 along growing
    path) as known at that epoch. `doubt_m`: in the odometer's distance, a sum; the epochs between which it stays the
    same compare; `rows_m`: noise of its rows. `gap_ns`: the longest step to the epoch that a crossing is interpolated
    over; `blind`: no position for longer.
    """

    def __init__(self, epochs: AlignedEpochs, scale_sigma: float | None, config: Configuration) -> None:
        """Read the columns of aligned epochs, which the LDS does nowhere else.

        Args:
            epochs: aligned epochs of one solution, in order of time.
            scale_sigma: standard deviation of the odometer's scale; None where it is not known.
            config: the configuration; used is `lds`.
        """
        self.t_ns = epochs.t_ns
        self.leg: Ints = _last_known(epochs.leg, epochs.leg >= 0, 0)
        self.path_m = epochs.path_m
        self.positioned: Bools = epochs.positioned
        self.placed_nowhere: Bools = epochs.fix_valid & ~self.positioned
        self.refusal = _refusals(epochs, config)
        self.sigma_m: Floats = _last_known(epochs.position_sigma_m, np.isfinite(epochs.position_sigma_m), np.nan)
        self.confidence_m = epochs.confidence_m
        self.odometer_m = epochs.odometer_m
        self.doubt_m = epochs.odometer_doubt_m
        self.slips = epochs.odometer_slips
        self.rows_m = np.nan_to_num(epochs.odometer_rows_m)
        self.scale_sigma = scale_sigma
        self.direction = _travel_direction(self.odometer_m, epochs.direction, config.lds.odometer_fixed_m)
        self.travelled_m = epochs.travelled_m
        self.gap_ns = crossing_gaps_ns(self.t_ns, config.lds)
        self.blind = _are_blind(self.t_ns, self.positioned, self.gap_ns)

    @cached_property
    def usable(self) -> Bools:
        """Epochs at which a detection would count."""
        return np.array([refusal is None for refusal in self.refusal], dtype=bool)

    @cached_property
    def comparable(self) -> Bools:
        """Usable, and with an odometer and a sigma to compare with."""
        known: Bools = np.isfinite(self.odometer_m) & np.isfinite(self.sigma_m)
        return self.usable & known

    @cached_property
    def ambiguous(self) -> Bools:
        """Epochs whose track is ambiguous."""
        return np.array([refusal is PassageStatus.REJECTED_AMBIGUOUS for refusal in self.refusal], dtype=bool)

    @cached_property
    def with_odometer(self) -> Ints:
        """Numbers of the epochs with a known odometer distance."""
        return np.flatnonzero(np.isfinite(self.odometer_m))

    @property
    def has_odometer(self) -> bool:
        """Whether any epoch has a known odometer distance."""
        return self.with_odometer.size > 0

    def absence(self, epochs: slice) -> PassageStatus:
        """The status of a balise passed without a position on the path: fixes off all track, or no fix."""
        unplaced = self.placed_nowhere[epochs].any()
        return PassageStatus.REJECTED_AMBIGUOUS if unplaced else PassageStatus.NOT_AVAILABLE


def _are_blind(t_ns: Ints, positioned: Bools, gap_ns: Ints) -> Bools:
    """Epochs longer than a crossing is interpolated over after the last position, and all before the first one."""
    last_ns = np.maximum.accumulate(np.where(positioned, t_ns, np.iinfo(np.int64).min))
    first = np.argmax(positioned) if positioned.any() else t_ns.size
    blind: Bools = t_ns - np.maximum(last_ns, t_ns[0] - gap_ns) > gap_ns
    blind[:first] = True
    return blind


def _last_known(values: AnyArray, known: Bools, first: float) -> AnyArray:
    """The values, those not known replaced by the last one that is; before any of them by `first`."""
    last = np.maximum.accumulate(np.where(known, np.arange(values.size), -1))
    return np.where(last >= 0, values[last], first).astype(values.dtype)


def _refusals(epochs: AlignedEpochs, config: Configuration) -> list[PassageStatus | None]:
    """Per epoch why a detection there would not count, None where it would; ambiguity before confidence."""
    refusals = np.full(epochs.height, None)
    refusals[~(epochs.confidence_m <= config.lds.ci_limit_m)] = PassageStatus.REJECTED_CONFIDENCE
    refusals[~epochs.unambiguous] = PassageStatus.REJECTED_AMBIGUOUS
    refusals[~epochs.positioned] = PassageStatus.NOT_AVAILABLE
    return list(refusals)


def _travel_direction(odometer_m: Floats, matched: Ints, turn_m: float) -> Ints:
    """Direction of travel along growing path, as known at each epoch.

    With an odometer the train has turned once it came back by `turn_m`: a wheel's jitter at a stand is no turn.
    """
    if not np.isfinite(odometer_m).any():
        return _last_known(matched, matched != 0, 1)
    known = np.flatnonzero(np.isfinite(odometer_m))
    direction = np.ones(odometer_m.size, dtype=np.int64)
    for _, turned_at, sense in turns_of(odometer_m[known], turn_m):
        direction[known[turned_at] :] = sense
    return direction


def turning_epochs(journey: Journey) -> frozenset[int]:
    """Epochs at which direction or leg change, odometer known."""
    known = journey.with_odometer
    changed = (np.diff(journey.direction[known]) != 0) | (np.diff(journey.leg[known]) != 0)
    return frozenset(known[1:][changed].tolist())


def odometer_doubt_epochs(journey: Journey) -> list[int]:
    """Epochs at which the odometer begins to slip, or its distance came into doubt."""
    changes = (np.diff(journey.doubt_m) != 0.0) | (journey.slips[1:] & ~journey.slips[:-1])
    epochs: list[int] = (np.flatnonzero(changes) + 1).tolist()
    return epochs


def mission_epochs(journey: Journey, config: LdsConfig) -> frozenset[int]:
    """The first epochs at or after the configured starts of mission."""
    starts_ns = np.array([round(start.timestamp() * NS_PER_S) for start in config.starts_of_mission], dtype=np.int64)
    inside = starts_ns[(starts_ns > journey.t_ns[:1].sum()) & (starts_ns <= journey.t_ns[-1:].sum())]
    return frozenset(np.searchsorted(journey.t_ns, inside).tolist())


def unwatched_epochs(journey: Journey, watched: Ints, gap_reset_s: float) -> frozenset[int]:
    """The first watched epochs after time over which no monitor can say what became of the position.

    Longer than the bank bridges; or however short, where the odometer lost its distance or guessed it over a pause: no
    increment leads over it. Slip has a test of its own.
    """
    waited_ns = np.diff(journey.t_ns[watched])
    slipped = np.diff(np.cumsum(journey.slips)[watched]) > 0
    doubt_m = np.diff(journey.doubt_m[watched])
    lost = ((doubt_m != 0.0) & ~slipped) | is_lost(doubt_m)
    return frozenset(watched[1:][lost | (waited_ns > gap_reset_s * NS_PER_S)].tolist())


DEFAULTS = LdsConfig()


class Window(NamedTuple):
    """Expectation window in odometer distance from the LRVB [m]."""

    open_m: float
    close_m: float

    def holds(self, distance_m: float) -> bool:
        """Whether a distance lies in the window, its ends included."""
        return self.open_m <= distance_m <= self.close_m


def expectation_window(
    distance_m: float, accuracy_m: float, reference_accuracy_m: float, config: LdsConfig = DEFAULTS
) -> Window:
    """Window of a balise announced `distance_m` beyond the reference (SUBSET-026 3.4.4.4.3, 3.6.4.1).

    The odometer's reading d is true to 5 m + 5 % of d (SUBSET-041 5.3.1.1), so the window is d + (5 + 0.05 d) >= D - Q
    - Q_r and d - (5 + 0.05 d) <= D + Q + Q_r: not symmetric about D.
    """
    margin_m = accuracy_m + reference_accuracy_m + config.odometer_fixed_m
    return Window(
        (distance_m - margin_m) / (1.0 + config.odometer_share),
        (distance_m + margin_m) / (1.0 - config.odometer_share),
    )


def window_after_turn(distance_m: float, travelled_m: float, margin_m: float, config: LdsConfig = DEFAULTS) -> Window:
    """Window where the train turned round since the reference; 5 % count on the whole distance run, not the net one.

    `margin_m` is Q + Q_r + 5 m. The clauses know no such case.
    """
    half_m = (margin_m + config.odometer_share * travelled_m) / (1.0 - config.odometer_share)
    return Window(distance_m - half_m, distance_m + half_m)


def minimal_spacing_m(
    distance_m: float, accuracy_m: float, next_accuracy_m: float, reference_accuracy_m: float, config: LdsConfig
) -> float:
    """Smallest distance to the next balise whose window does not overlap its own (LOC section III)."""
    margin_m = next_accuracy_m + reference_accuracy_m + config.odometer_fixed_m
    close_m = expectation_window(distance_m, accuracy_m, reference_accuracy_m, config).close_m
    return close_m * (1.0 + config.odometer_share) + margin_m - distance_m


PLACE = ("balise_id", "netelement_id", "measure_m", "path_m")
"""Columns of a balise and where it lies."""


@dataclass(frozen=True, slots=True)
class Balise:
    """One balise on one leg of the travelled path; `valid_direction`: along growing path +1, against it -1, both 0."""

    leg: int
    balise_id: str
    kind: BaliseKind
    netelement_id: str
    measure_m: float
    path_m: float
    accuracy_m: float
    linked: bool
    reaction: Reaction
    valid_direction: int

    def is_valid_for(self, direction: int) -> bool:
        """Whether it exists for a train in this direction of travel (DOMAIN section 4)."""
        return self.valid_direction in (0, direction)


@dataclass(slots=True, eq=False)
class Crossing:
    """The position passes a virtual balise, or the reader reads a physical one.

    `before`, `epoch`: rows of the epochs around it. `sense`: of the position's step, +1 along growing path;
    `direction`: of travel as known at `epoch`. Time, odometer and distance are interpolated; after a gap they are those
    of `epoch`, and `absence` says what a balise passed in it is.
    """

    balise: Balise
    before: int
    epoch: int
    t_ns: int
    sense: int
    direction: int
    odometer_m: float | None
    travelled_m: float
    confidence_m: float | None
    absence: PassageStatus | None = None
    offered: bool = False
    status: PassageStatus | None = None
    initialising: bool = False


_SEVERITY = (Reaction.NONE, Reaction.SERVICE_BRAKE, Reaction.TRIP)


@dataclass(slots=True)
class Passage:
    """A row of `passages` in the making.

    `crossing`: what offered it; `t_ns`: of the offer, else when it was settled; `announced_odometer_m`: where the train
    passes it by linking.
    """

    balise: Balise
    t_ns: int
    direction: int
    status: PassageStatus = PassageStatus.MISSED
    crossing: Crossing | None = None
    window: Window | None = None
    odometer_distance_m: float | None = None
    linking_error: LinkingError = LinkingError.NONE
    reaction: Reaction = Reaction.NONE
    announced_odometer_m: float | None = None

    def record(self, error: LinkingError, reaction: Reaction) -> None:
        """Note a linking error: the first one of a passage stays, the most severe reaction counts."""
        if self.linking_error is LinkingError.NONE:
            self.linking_error = error
        self.reaction = max(self.reaction, reaction, key=_SEVERITY.index)


class Disarmed:
    """Balises just detected, re-armed max(`rearm_m`, `rearm_sigmas`) away (DOMAIN section 4).

    By the odometer; without one by the position's distance from the balise.
    """

    def __init__(self, journey: Journey, config: LdsConfig) -> None:
        self._journey = journey
        self._config = config
        self._at: dict[str, tuple[Balise, float]] = {}

    def __bool__(self) -> bool:
        """Whether any balise is disarmed."""
        return bool(self._at)

    def holds(self, balise: Balise) -> bool:
        """Whether the balise cannot be detected again yet."""
        return balise.balise_id in self._at

    def add(self, crossing: Crossing) -> None:
        """Disarm the balise of a crossing from there on."""
        odometer_m = float("nan") if crossing.odometer_m is None else crossing.odometer_m
        self._at[crossing.balise.balise_id] = (crossing.balise, odometer_m)

    def rearm(self, begin: int, end: int) -> None:
        """Re-arm balises that are far enough away at one of the epochs from `begin` on, before `end`."""
        part = slice(begin, end)
        away_m = np.fmax(self._config.rearm_m, self._config.rearm_sigmas * self._journey.sigma_m[part])
        for name, (balise, at_m) in list(self._at.items()):
            if (np.abs(self._distance_since_m(part, balise, at_m)) >= away_m).any():
                del self._at[name]

    def _distance_since_m(self, part: slice, balise: Balise, at_m: float) -> Floats:
        """Distance of some epochs from the crossing of a balise [m]."""
        if not self._journey.has_odometer:
            return self._journey.path_m[part] - balise.path_m
        odometer_m = self._journey.odometer_m[part]
        if isnan(at_m):
            known = odometer_m[np.isfinite(odometer_m)]
            at_m = float(known[0]) if known.size else at_m
            self._at[balise.balise_id] = (balise, at_m)
        return odometer_m - at_m


def find_crossings(journey: Journey, balises: Sequence[Balise]) -> list[Crossing]:
    """Crossings of virtual balises by the position, leg by leg; those of one step in the order of being passed."""
    known = np.flatnonzero(journey.positioned)
    crossings: list[Crossing] = []
    for leg in sorted({balise.leg for balise in balises}):
        on_leg = [balise for balise in balises if balise.leg == leg]
        # Every stretch of steps on this leg; of a step the leg is that of its later end.
        for first, last in spans_of(journey.leg[known[1:]] == leg):
            rows = known[first : last + 2]
            for passing in passings(journey.path_m[rows], [balise.path_m for balise in on_leg]):
                before, after = rows[passing.after - 1 : passing.after + 1]
                crossings.append(_interpolated_crossing(journey, on_leg[passing.place], passing, before, after))
    # Valid in the direction as known then: in the first metres after a turn that is still the old one.
    return [crossing for crossing in crossings if crossing.balise.is_valid_for(crossing.direction)]


def _interpolated_crossing(journey: Journey, balise: Balise, passing: Passing, before: int, epoch: int) -> Crossing:
    """The crossing of a balise between two epochs, interpolated unless a gap lies between them."""
    near = bool(journey.t_ns[epoch] - journey.t_ns[before] <= journey.gap_ns[epoch])
    passing = passing if near else passing._replace(share=1.0)
    odometer_m = journey.odometer_m
    direction = int(journey.direction[epoch])
    back_m = 0.0 if passing.share == 1.0 else (1.0 - passing.share) * float(odometer_m[epoch] - odometer_m[before])
    return Crossing(
        balise=balise,
        before=int(before),
        epoch=int(epoch),
        t_ns=passing.instant_ns(int(journey.t_ns[before]), int(journey.t_ns[epoch])),
        sense=passing.sense,
        direction=direction,
        odometer_m=_none_for_nan(float(odometer_m[epoch]) - back_m),
        travelled_m=float(journey.travelled_m[epoch]) - back_m * direction,
        confidence_m=_none_for_nan(float(journey.confidence_m[epoch])),
        absence=None if near else journey.absence(slice(before + 1, epoch)),
    )


def _none_for_nan(value: float) -> float | None:
    """The value, None for NaN."""
    return None if isnan(value) else value


def in_order_of_time(crossings: Sequence[Crossing]) -> list[Crossing]:
    """Crossings in order of time; the place in this list is the `crossing_id`."""
    return sorted(crossings, key=lambda crossing: (crossing.t_ns, crossing.epoch, crossing.balise.kind.value))


def arrays_of_crossings(crossings: Sequence[Crossing]) -> Crossings:
    """The crossings as arrays, for later stages."""
    balises = [crossing.balise for crossing in crossings]
    return Crossings(
        balise_id=[balise.balise_id for balise in balises],
        netelement_id=[balise.netelement_id for balise in balises],
        measure_m=np.array([balise.measure_m for balise in balises], dtype=np.float64),
        leg=np.array([balise.leg for balise in balises], dtype=np.int64),
        path_m=np.array([balise.path_m for balise in balises], dtype=np.float64),
        virtual=np.array([balise.kind is BaliseKind.VIRTUAL for balise in balises], dtype=np.bool_),
        before=np.array([crossing.before for crossing in crossings], dtype=np.int64),
        epoch=np.array([crossing.epoch for crossing in crossings], dtype=np.int64),
        t_ns=np.array([crossing.t_ns for crossing in crossings], dtype=np.int64),
        sense=np.array([crossing.sense for crossing in crossings], dtype=np.int64),
        direction=np.array([crossing.direction for crossing in crossings], dtype=np.int64),
        odometer_m=np.array([crossing.odometer_m for crossing in crossings], dtype=np.float64),
        offered=np.array([crossing.offered for crossing in crossings], dtype=np.bool_),
        status=np.array([_STATUS.get(crossing.status, -1) for crossing in crossings], dtype=np.int64),
    )


_STATUS: dict[PassageStatus | None, int] = {status: number for number, status in enumerate(PassageStatus)}


def telegrams_on_path(
    frame: pl.DataFrame | None, balises: list[Balise], journey: Journey
) -> tuple[list[Crossing], pl.DataFrame]:
    """Telegrams (`t, balise_id`, `odometer_m`) as crossings in order of time, and those of balises not on the path."""
    if frame is None:
        return [], pl.DataFrame(schema={"t": pl.Datetime("ns", "UTC"), "balise_id": pl.String})
    places: dict[str, list[Balise]] = {}
    for balise in balises:
        places.setdefault(balise.balise_id, []).append(balise)
    known = frame["balise_id"].is_in(list(places))
    rows = frame.filter(known).sort("t", "balise_id").with_columns(t_ns=pl.col("t").dt.epoch("ns"))
    odometer = rows["odometer_m"] if "odometer_m" in rows.columns else [None] * rows.height
    reads: list[Crossing] = []
    last: Crossing | None = None
    for t_ns, balise_id, odometer_m in zip(rows["t_ns"], rows["balise_id"], odometer, strict=True):
        reads.append(_telegram_crossing(t_ns, places[balise_id], odometer_m, journey, last))
        last = last if odometer_m is None else reads[-1]
    return reads, frame.filter(~known).select("t", "balise_id")


def _telegram_crossing(
    t_ns: int, places: list[Balise], odometer_m: float | None, journey: Journey, last: Crossing | None
) -> Crossing:
    """A telegram as a crossing at the visit of the path it belongs to; `last`: the one before with an odometer."""
    epoch = min(int(np.searchsorted(journey.t_ns, t_ns)), journey.t_ns.size - 1)
    before = max(int(np.searchsorted(journey.t_ns, t_ns, side="right")) - 1, 0)
    here_m = float(np.nan_to_num(journey.path_m[epoch]))
    # The place of the last telegram plus the odometer since then; the matched position only where there is none.
    before_m = None if last is None or journey.doubt_m[last.before] != journey.doubt_m[before] else last.odometer_m
    if last is not None and before_m is not None and odometer_m is not None:
        here_m = last.balise.path_m + odometer_m - before_m
    leg = int(journey.leg[epoch])
    direction = int(journey.direction[epoch])
    since_m = float(journey.odometer_m[epoch]) - (np.nan if odometer_m is None else odometer_m)
    return Crossing(
        balise=min(places, key=lambda balise: (balise.leg != leg, abs(balise.path_m - here_m))),
        before=before,
        epoch=epoch,
        t_ns=t_ns,
        sense=direction,
        direction=direction,
        odometer_m=odometer_m,
        travelled_m=float(journey.travelled_m[epoch]) - abs(since_m),
        confidence_m=None,
    )
