"""Where the raw matched position passes a balise (DOMAIN section 4: a VB is *offered*)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from math import isfinite
from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.lds.journey import Journey
from schemas.arrays import Floats, Ints
from schemas.enums import BaliseKind, Reaction


@dataclass(frozen=True, slots=True)
class Balise:
    """One balise on one leg of the travelled path."""

    leg: int
    balise_id: str
    kind: BaliseKind
    netelement_id: str
    measure_m: float
    path_m: float
    accuracy_m: float
    linked: bool
    reaction: Reaction


class Seen(Enum):
    """How a balise was passed by the position."""

    CROSSED = "crossed"
    IN_GAP = "in_gap"
    UNPLACED = "unplaced"


@dataclass(frozen=True, slots=True)
class Crossing:
    """The position passes a balise between the valid epochs `before` and `epoch`.

    `sense` is +1 where the position passes it along growing path. Time and odometer distance are
    interpolated where the two epochs are near enough in time, else unknown.
    """

    balise: Balise
    before: int
    epoch: int
    sense: int
    seen: Seen
    t_ns: int
    odometer_m: float | None


def balises_of(frame: pl.DataFrame, kind: BaliseKind) -> list[Balise]:
    """Balises of one kind in order of leg, path position and identity."""
    rows = frame.filter(pl.col("kind").cast(pl.String) == kind.value).sort("leg", "path_m", "balise_id")
    return [
        Balise(
            leg=row["leg"],
            balise_id=row["balise_id"],
            kind=kind,
            netelement_id=row["netelement_id"],
            measure_m=row["measure_m"],
            path_m=row["path_m"],
            accuracy_m=row["location_accuracy_m"],
            linked=row["linked"],
            reaction=Reaction(row["link_reaction"]),
        )
        for row in rows.iter_rows(named=True)
    ]


class _Step(NamedTuple):
    """Two successive valid epochs, by index, time, path and odometer."""

    before: int
    epoch: int
    t_before_ns: int
    t_ns: int
    path_before_m: float
    path_m: float
    odometer_before_m: float
    odometer_m: float


def find_crossings(journey: Journey, balises: Sequence[Balise]) -> dict[int, list[Crossing]]:
    """Crossings by the epoch that completes them, those of one step in the order of being passed.

    A balise is passed growing when the position comes from before it to it or beyond, and falling
    when it comes from there to before it, so that touching it and turning back are two passings.
    """
    known = np.flatnonzero(journey.positioned)
    found: dict[int, list[Crossing]] = {}
    for leg in sorted({balise.leg for balise in balises}):
        on_leg = [balise for balise in balises if balise.leg == leg]
        at_m = np.array([balise.path_m for balise in on_leg])
        steps = np.flatnonzero(journey.leg[known[1:]] == leg)
        before, after = known[steps], known[steps + 1]
        passed_before = np.searchsorted(at_m, journey.path_m[before], side="right")
        passed_after = np.searchsorted(at_m, journey.path_m[after], side="right")
        passing = np.flatnonzero(passed_before != passed_after)
        counts = zip(passed_before[passing].tolist(), passed_after[passing].tolist(), strict=True)
        for step, (first, last) in zip(_steps(journey, before[passing], after[passing]), counts, strict=True):
            passed = _in_order(on_leg, first, last)
            found[step.epoch] = [_crossing(journey, balise, step, sense) for balise, sense in passed]
    return dict(sorted(found.items()))


def _steps(journey: Journey, before: Ints, after: Ints) -> Iterator[_Step]:
    columns: list[Ints | Floats] = [before, after]
    for values in (journey.t_ns, journey.path_m, journey.odometer_m):
        columns += [values[before], values[after]]
    return (_Step(*row) for row in zip(*(column.tolist() for column in columns), strict=True))


def _in_order(balises: Sequence[Balise], before: int, after: int) -> Iterator[tuple[Balise, int]]:
    if after > before:
        yield from ((balise, 1) for balise in balises[before:after])
    else:
        yield from ((balise, -1) for balise in reversed(balises[after:before]))


def _crossing(journey: Journey, balise: Balise, step: _Step, sense: int) -> Crossing:
    waited_ns = step.t_ns - step.t_before_ns
    if waited_ns > journey.gap_ns:
        unplaced = journey.placed_nowhere[step.before + 1 : step.epoch].any()
        seen = Seen.UNPLACED if unplaced else Seen.IN_GAP
        odometer_m = step.odometer_m if isfinite(step.odometer_m) else None
        return Crossing(balise, step.before, step.epoch, sense, seen, step.t_ns, odometer_m)
    share = (balise.path_m - step.path_before_m) / (step.path_m - step.path_before_m)
    at_m = step.odometer_before_m + share * (step.odometer_m - step.odometer_before_m)
    t_ns = step.t_before_ns + round(share * waited_ns)
    odometer_m = at_m if isfinite(at_m) else None
    return Crossing(balise, step.before, step.epoch, sense, Seen.CROSSED, t_ns, odometer_m)
