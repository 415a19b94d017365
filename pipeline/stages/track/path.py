"""Routes: net elements in order with one coordinate; and the path that a run travelled, legs sharing one of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.stages.track.geodesy import Points
from pipeline.stages.track.leg import Leg, nearest_on_leg, path_at, segments_at
from pipeline.stages.track.segments import Feet, no_feet
from pipeline.stages.track.survey import MEASURE_TOLERANCE_M, SurveyedTrack
from schemas.arrays import Bools, Floats, Ints, floats
from schemas.enums import BaliseDirection, BaliseKind
from schemas.frozen import frozen

Objects = npt.NDArray[np.object_]
BALISE_COLUMNS: dict[str, type[pl.DataType]] = {
    "leg": pl.Int32,
    "balise_id": pl.String,
    "kind": pl.String,
    "netelement_id": pl.String,
    "measure_m": pl.Float64,
    "path_m": pl.Float64,
    "sense": pl.Int64,
    "location_accuracy_m": pl.Float64,
    "linked": pl.Boolean,
    "link_reaction": pl.String,
    "valid_direction": pl.Int64,
}


def valid_along_measure(balises: pl.DataFrame) -> pl.Series:
    """The direction along its net element in which each balise is valid (DOMAIN section 4): +1 growing, -1 falling.

    0 both: a physical one, which every train reads, and one of a table that does not say (CONTRACT section 2).
    """
    both = pl.Series([BaliseDirection.BOTH.value]).new_from_index(0, balises.height)
    direction = balises.get_column("direction", default=both).cast(pl.String)
    along = direction.replace_strict(_ALONG_MEASURE, return_dtype=pl.Int64)
    virtual = balises["kind"].cast(pl.String) == BaliseKind.VIRTUAL.value
    return along * virtual.cast(pl.Int64)


_ALONG_MEASURE = {BaliseDirection.AB.value: 1, BaliseDirection.BA.value: -1, BaliseDirection.BOTH.value: 0}

# Of two visits of one element the one that holds the measure comes first, however near the other is:
# an order of two costs, not a limit.
_OUTSIDE_COUNTS = 1e3


@frozen
class Place:
    """A place on the network: net element by its number in the survey, and measure [m]."""

    element: int
    measure_m: float


@frozen
class RoutePath:
    """Net elements in order with one coordinate [m]; arrays per visit.

    `forward`: the measure grows with the coordinate; `entry_m`: coordinate at which the element is entered;
    `low_m`, `high_m`: the measures that it covers.
    """

    element: Ints
    forward: Bools
    entry_m: Floats
    low_m: Floats
    high_m: Floats

    @cached_property
    def exit_m(self) -> Floats:
        return self.entry_m + self.high_m - self.low_m

    def coordinate(self, element: Ints, measure_m: Floats, near_m: Floats) -> tuple[Floats, Ints]:
        """Coordinate [m] of places, NaN where not on the route; +1 where it grows with the measure, else -1.

        Of several visits the one nearest to `near_m` is meant: a lap more is no error of place.
        """
        coordinate_m = np.full(element.size, np.nan)
        sense = np.zeros(element.size, dtype=np.int64)
        cost = np.full(element.size, np.inf)
        order = np.argsort(element, kind="stable")
        ends = np.searchsorted(element[order], self.element, side="right")
        begins = np.searchsorted(element[order], self.element, side="left")
        for visit in np.flatnonzero(ends > begins).tolist():
            rows = order[begins[visit] : ends[visit]]
            low = self.low_m[visit]
            high = self.high_m[visit]
            measure = measure_m[rows]
            at_m = self.entry_m[visit] + (measure - low if self.forward[visit] else high - measure)
            outside = np.maximum(np.maximum(low - measure, measure - high), 0.0)
            visit_cost = outside * _OUTSIDE_COUNTS + np.abs(at_m - near_m[rows])
            better = visit_cost < cost[rows]
            chosen = rows[better]
            cost[chosen] = visit_cost[better]
            coordinate_m[chosen] = at_m[better]
            sense[chosen] = 1 if self.forward[visit] else -1
        return coordinate_m, sense

    def locate(self, at_m: Floats) -> tuple[Ints, Floats, Ints]:
        """Element, measure [m] and its sense (+1: grows with the coordinate); beyond the ends the measure goes on."""
        visit = np.clip(np.searchsorted(self.entry_m, at_m, side="right") - 1, 0, self.entry_m.size - 1)
        since = at_m - self.entry_m[visit]
        forward = self.forward[visit]
        measure = np.where(forward, self.low_m[visit] + since, self.high_m[visit] - since)
        return self.element[visit], measure, np.where(forward, 1, -1)

    def places(self, element: Ints, measure_m: Floats) -> tuple[Ints, Floats, Ints]:
        """All visits of some places, but for what lists round: which place, coordinate [m], sense of the measure."""
        holds = self.element[:, None] == element
        holds &= (self.low_m[:, None] - MEASURE_TOLERANCE_M <= measure_m) & (
            measure_m <= self.high_m[:, None] + MEASURE_TOLERANCE_M
        )
        visit, place = np.nonzero(holds)
        measure = measure_m[place]
        since = np.where(self.forward[visit], measure - self.low_m[visit], self.high_m[visit] - measure)
        return place, self.entry_m[visit] + since, np.where(self.forward[visit], 1, -1)

    def covers(self, at_m: Floats) -> Bools:
        """The coordinate lies on the route, not beyond its ends."""
        inside: Bools = (at_m >= self.entry_m[0]) & (at_m <= self.exit_m[-1])
        return inside


def routes_of(track: SurveyedTrack, legs: Sequence[Leg]) -> list[RoutePath]:
    """Legs as routes whose coordinate is `path_m`; net elements by their numbers in the track."""
    routes = []
    for leg in legs:
        element = np.array([visit.element for visit in leg.visits])
        routes.append(
            RoutePath(
                element=element,
                forward=np.array([visit.forward for visit in leg.visits]),
                entry_m=np.array([leg.entry_m(number) for number in range(len(element))]),
                low_m=track.begin_m[element],
                high_m=track.end_m[element],
            )
        )
    return routes


@frozen
class TravelledPath:
    """The legs of a run in order of time; `path_m` is 0 at the start of the first net element."""

    track: SurveyedTrack
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
        for index, route_leg in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & np.isfinite(path_m))
            segment, fraction = segments_at(route_leg, path_m[rows])
            span = route_leg.measure_end_m[segment] - route_leg.measure_start_m[segment]
            element[rows] = np.array([visit.element for visit in route_leg.visits])[route_leg.visit[segment]]
            measure[rows] = route_leg.measure_start_m[segment] + fraction * span
        return element, measure

    def feet(self, points: Points, leg: Ints, known: Bools, near_path_m: Floats | None = None) -> Feet:
        """The nearest place of each known point on its leg.

        `near_path_m` tells passages of the same place apart; it never moves a point that has only one, so jumps stay.
        """
        feet = no_feet(len(points))
        for index, route_leg in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & known)
            near = None if near_path_m is None else near_path_m[rows]
            feet.put(rows, nearest_on_leg(points.take(rows), route_leg, near))
        return feet

    def places(self, leg: Ints, feet: Feet, height_m: Floats) -> tuple[Floats, Floats]:
        """Feet on the legs as path positions, and heights over the track [m]; NaN where not known."""
        path_m, vertical_m = np.full((2, len(leg)), np.nan)
        for index, route_leg in enumerate(self.legs):
            rows = np.flatnonzero((leg == index) & np.isfinite(feet.fraction))
            part = feet.take(rows)
            rise = route_leg.height_end_m[part.segment] - route_leg.height_start_m[part.segment]
            path_m[rows] = path_at(route_leg, part)
            vertical_m[rows] = height_m[rows] - route_leg.height_start_m[part.segment] - part.fraction * rise
        return path_m, vertical_m

    def routes(self, numbers: dict[str, int]) -> list[RoutePath]:
        """The legs as routes whose coordinate is `path_m`; `numbers`: net elements as the caller counts them."""
        number = np.array([numbers[name] for name in self.track.ids], dtype=np.int64)
        return [replace(route, element=number[route.element]) for route in routes_of(self.track, self.legs)]

    def balises(self, balises: pl.DataFrame | None) -> pl.DataFrame:
        """Balises on the path with path position and `sense` (of the measure along it), in order of leg and position.

        `valid_direction`: the direction of travel along growing path in which a virtual one is valid, +1 or -1; 0 both.
        A place that two legs share is given on each of them, for a train may pass it on each; an element passed
        twice on one leg gives its balises twice. A balise off its element is on no path (the site's findings
        name it).
        """
        if balises is None:
            return pl.DataFrame(schema=BALISE_COLUMNS)
        element = balises["netelement_id"].replace_strict(self.track.index, default=-1, return_dtype=pl.Int64)
        parts = []
        for leg, route in enumerate(self.routes(self.track.index)):
            place, path_m, sense = route.places(element.to_numpy(), floats(balises, "measure_m"))
            along_path = valid_along_measure(balises)[place] * pl.Series(sense)
            on_leg = balises[place].with_columns(leg=pl.lit(leg), path_m=path_m, sense=sense)
            parts.append(on_leg.with_columns(valid_direction=along_path))
        whole = pl.concat(parts).select(pl.col(name).cast(kind) for name, kind in BALISE_COLUMNS.items())
        # Where two pieces of an element meet they share a place.
        once = whole.unique(["leg", "balise_id", pl.col("path_m").round(3)], keep="first", maintain_order=True)
        return once.sort("leg", "path_m", "balise_id")
