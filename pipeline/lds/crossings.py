"""Where the raw matched position passes a balise (DOMAIN section 4: a VB is *offered*)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import polars as pl

from pipeline.lds.journey import Floats, Journey
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
        for step in np.flatnonzero(passed_before != passed_after).tolist():
            i, j = int(before[step]), int(after[step])
            passed = _in_order(on_leg, int(passed_before[step]), int(passed_after[step]))
            found[j] = [_crossing(journey, balise, i, j, sense) for balise, sense in passed]
    return dict(sorted(found.items()))


def _in_order(balises: Sequence[Balise], before: int, after: int) -> Iterator[tuple[Balise, int]]:
    if after > before:
        yield from ((balise, 1) for balise in balises[before:after])
    else:
        yield from ((balise, -1) for balise in reversed(balises[after:before]))


def _crossing(journey: Journey, balise: Balise, i: int, j: int, sense: int) -> Crossing:
    t_i, t_j = int(journey.t_ns[i]), int(journey.t_ns[j])
    if t_j - t_i > journey.gap_ns:
        seen = Seen.UNPLACED if journey.placed_nowhere[i + 1 : j].any() else Seen.IN_GAP
        return Crossing(balise, i, j, sense, seen, t_j, _known(journey.odometer_m, j))
    share = float((balise.path_m - journey.path_m[i]) / (journey.path_m[j] - journey.path_m[i]))
    odometer_m = journey.odometer_m[i] + share * (journey.odometer_m[j] - journey.odometer_m[i])
    return Crossing(
        balise,
        i,
        j,
        sense,
        Seen.CROSSED,
        t_i + round(share * (t_j - t_i)),
        float(odometer_m) if np.isfinite(odometer_m) else None,
    )


def _known(values: Floats, k: int) -> float | None:
    return float(values[k]) if np.isfinite(values[k]) else None
