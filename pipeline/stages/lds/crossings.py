"""Where the raw matched position passes a virtual balise, and telegrams of physical ones (DOMAIN section 4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isnan

import numpy as np
import polars as pl

from pipeline.stages.epochs.passing import Passing, passings
from pipeline.stages.lds.journey import Journey
from pipeline.stages.lds.windows import Window
from schemas.arrays import spans_of
from schemas.conform import dtypes, table_of_rows
from schemas.enums import BaliseKind, LinkingError, PassageStatus, Reaction
from schemas.stages import Crossings

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

    def is_valid(self, direction: int) -> bool:
        """To a train in another direction it does not exist (DOMAIN section 4)."""
        return self.valid_direction in (0, direction)


@dataclass(slots=True, eq=False)
class Crossing:
    """The position passes a virtual balise, or the reader reads a physical one.

    `before`, `epoch`: rows of the epochs around it. `sense`: of the position's step, +1 along growing path;
    `direction`: of travel as known at `epoch`. Time, odometer and way are interpolated; after a gap they are those of
    `epoch`, and `absence` says what a balise passed in it is.
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
        """The first linking error of a passage stays, the most severe reaction counts."""
        if self.linking_error is LinkingError.NONE:
            self.linking_error = error
        self.reaction = max(self.reaction, reaction, key=_SEVERITY.index)


def balises_of(frame: pl.DataFrame, kind: BaliseKind) -> list[Balise]:
    of_kind = frame.filter(pl.col("kind").cast(pl.String) == kind.value).sort("leg", "path_m", "balise_id")
    rows = of_kind.select(
        *("leg", "linked", "valid_direction", *PLACE), accuracy_m="location_accuracy_m", reaction="link_reaction"
    )
    return [Balise(kind=kind, **row | {"reaction": Reaction(row["reaction"])}) for row in rows.iter_rows(named=True)]


def find_crossings(journey: Journey, balises: Sequence[Balise]) -> list[Crossing]:
    """Crossings of virtual balises, those of one step in the order of being passed (`passings`)."""
    known = np.flatnonzero(journey.positioned)
    crossings: list[Crossing] = []
    for leg in sorted({balise.leg for balise in balises}):
        on_leg = [balise for balise in balises if balise.leg == leg]
        # Every stretch of steps on this leg; of a step the leg is that of its later end.
        for first, last in spans_of(journey.leg[known[1:]] == leg):
            rows = known[first : last + 2]
            passed = passings(journey.path_m[rows], [balise.path_m for balise in on_leg])
            crossings += [
                _crossing(journey, on_leg[one.place], one, *rows[one.after - 1 : one.after + 1]) for one in passed
            ]
    # Valid in the direction as known then: in the first metres after a turn that is still the old one.
    return [crossing for crossing in crossings if crossing.balise.is_valid(crossing.direction)]


def _crossing(journey: Journey, balise: Balise, passing: Passing, before: int, epoch: int) -> Crossing:
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
        odometer_m=_known(float(odometer_m[epoch]) - back_m),
        travelled_m=float(journey.travelled_m[epoch]) - back_m * direction,
        confidence_m=_known(float(journey.confidence_m[epoch])),
        absence=None if near else journey.absence(slice(before + 1, epoch)),
    )


def _known(value: float) -> float | None:
    return None if isnan(value) else value


def in_order_of_time(crossings: Sequence[Crossing]) -> list[Crossing]:
    """The place in this list is the `crossing_id`."""
    return sorted(crossings, key=lambda crossing: (crossing.t_ns, crossing.epoch, crossing.balise.kind.value))


def crossing_rows(crossings: Sequence[Crossing]) -> pl.DataFrame:
    rows = [_row(number, crossing) for number, crossing in enumerate(crossings)]
    return table_of_rows(rows, dtypes(Crossings))


def _row(number: int, crossing: Crossing) -> dict[str, object]:
    offer = ("before", "epoch", "sense", "direction", "odometer_m", "offered")
    return {
        "crossing_id": number,
        **{name: getattr(crossing, name) for name in offer},
        **{name: getattr(crossing.balise, name) for name in ("leg", *PLACE)},
        "kind": crossing.balise.kind.value,
        "t": crossing.t_ns,
        "status": crossing.status and crossing.status.value,
    }


def reads_of(
    frame: pl.DataFrame | None, balises: list[Balise], journey: Journey
) -> tuple[list[Crossing], pl.DataFrame]:
    """Telegrams (`t, balise_id`, `odometer_m`) in order of time, and those of balises not on the path."""
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
        reads.append(_read(t_ns, places[balise_id], odometer_m, journey, last))
        last = last if odometer_m is None else reads[-1]
    return reads, frame.filter(~known).select("t", "balise_id")


def _read(
    t_ns: int, places: list[Balise], odometer_m: float | None, journey: Journey, last: Crossing | None
) -> Crossing:
    """One telegram at the visit of the path that it belongs to; `last`: the one before with a known odometer."""
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
