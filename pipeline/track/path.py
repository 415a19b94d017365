"""The path that a run travelled: legs of net elements sharing one path position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.track.geodesy import Points
from pipeline.track.leg import Leg, nearest_on_leg, path_at, segments_at
from pipeline.track.segments import Feet, no_feet
from pipeline.track.survey import MEASURE_TOLERANCE_M, Track
from schemas.arrays import Bools, Floats, Ints

Objects = npt.NDArray[np.object_]
BALISE_COLUMNS: dict[str, type[pl.DataType]] = {
    "leg": pl.Int32,
    "balise_id": pl.String,
    "kind": pl.String,
    "netelement_id": pl.String,
    "measure_m": pl.Float64,
    "path_m": pl.Float64,
    "location_accuracy_m": pl.Float64,
    "linked": pl.Boolean,
    "link_reaction": pl.String,
}


@dataclass(frozen=True)
class TravelledPath:
    """The legs of a run in order of time; `path_m` is 0 at the start of the first net element."""

    track: Track
    legs: tuple[Leg, ...]

    def elements(self) -> list[str]:
        """Net elements in order of growing path, leg by leg; one on both sides of a leg change stands once."""
        names: list[str] = []
        for leg in self.legs:
            for visit in leg.visits:
                name = self.track.ids[visit.element]
                if not names or names[-1] != name:
                    names.append(name)
        return names

    def locate(self, leg: npt.ArrayLike, path_m: npt.ArrayLike) -> tuple[Objects, Floats]:
        """Net element and measure [m] of path positions; beyond the path's ends the measure goes on.

        None and NaN where the position is not known.
        """
        position = np.atleast_1d(np.asarray(path_m, dtype=np.float64))
        number = np.broadcast_to(np.asarray(leg, dtype=np.int64), position.shape)
        element, measure = self.locate_index(number, position)
        return np.array([*self.track.ids, None], dtype=object)[element], measure

    def locate_index(self, leg: Ints, path_m: Floats) -> tuple[Ints, Floats]:
        """As `locate`, the net element as its number in the track (-1: not known)."""
        element = np.full(len(path_m), -1, dtype=np.int64)
        measure = np.full(len(path_m), np.nan)
        for index, one in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & np.isfinite(path_m))
            segment, fraction = segments_at(one, path_m[rows])
            span = one.measure_end_m[segment] - one.measure_start_m[segment]
            element[rows] = np.array([visit.element for visit in one.visits])[one.visit[segment]]
            measure[rows] = one.measure_start_m[segment] + fraction * span
        return element, measure

    def feet(self, points: Points, leg: Ints, known: Bools, near_path_m: Floats | None = None) -> Feet:
        """The nearest place of each known point on its leg.

        `near_path_m` tells passages of the same place apart; it never moves a point that has only one, so jumps stay.
        """
        feet = no_feet(len(points))
        for index, one in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & known)
            near = None if near_path_m is None else near_path_m[rows]
            feet.put(rows, nearest_on_leg(points.take(rows), one, near))
        return feet

    def places(self, leg: Ints, feet: Feet, height_m: Floats) -> tuple[Floats, Floats]:
        """Feet on the legs as path positions, and heights over the track [m]; NaN where not known."""
        path_m, vertical_m = np.full((2, len(leg)), np.nan)
        for index, one in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & np.isfinite(feet.fraction))
            part = feet.take(rows)
            rise = one.height_end_m[part.segment] - one.height_start_m[part.segment]
            path_m[rows] = path_at(one, part)
            vertical_m[rows] = height_m[rows] - one.height_start_m[part.segment] - part.fraction * rise
        return path_m, vertical_m

    def balises(self, balises: pl.DataFrame | None) -> pl.DataFrame:
        """Balises on the path with their path position, in order of leg and path position.

        A place that two legs share is given on each of them, for a train may pass it on each; an element passed
        twice on one leg gives its balises twice. A balise off its element is on no path (the site's findings
        name it).
        """
        rows: dict[tuple[int, str, float], tuple[object, ...]] = {}
        groups: dict[str, list[dict[str, Any]]] = {}
        for balise in () if balises is None else balises.iter_rows(named=True):
            groups.setdefault(balise["netelement_id"], []).append(balise)
        for number, leg in enumerate(self.legs):
            for row in _balises_on(self.track, number, leg, groups):
                rows.setdefault((number, str(row[1]), round(float(str(row[5])), 3)), row)
        frame = pl.DataFrame(list(rows.values()), schema=BALISE_COLUMNS, orient="row")
        return frame.sort("leg", "path_m", "balise_id")


def _balises_on(
    track: Track, number: int, leg: Leg, groups: dict[str, list[dict[str, Any]]]
) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    for index, visit in enumerate(leg.visits):
        name = track.ids[visit.element]
        if name not in groups:
            continue
        measures = track.measure_m[track.vertices(visit.element)]
        origin = float(measures[0] if visit.forward else measures[-1])
        start = leg.entry_m(index)
        for row in groups[name]:
            if not measures[0] - MEASURE_TOLERANCE_M <= row["measure_m"] <= measures[-1] + MEASURE_TOLERANCE_M:
                continue
            path_m = start + abs(row["measure_m"] - origin)
            values = (row["balise_id"], row["kind"], name, row["measure_m"], path_m)
            rows.append((number, *values, row["location_accuracy_m"], row["linked"], row["link_reaction"]))
    return rows
