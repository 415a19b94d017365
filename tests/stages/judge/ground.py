"""Tracks of the tests' own making: plane curves on the ellipsoid, neighbours, chains, and the site made of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import polars as pl
from numpy.typing import NDArray

from schemas.inputs import Balises, Links, Track
from schemas.run import Site

Floats = NDArray[np.float64]

# WGS 84 (NIMA TR8350.2): semi-major axis and flattening.
SEMI_MAJOR_M = 6378137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY_2 = FLATTENING * (2 - FLATTENING)

ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG, ORIGIN_HEIGHT_M = 49.5, 15.5, 320.0
FINE_STEP_M = 1.0
SURVEY_EVERY = 10
SWITCH_LENGTH_M = 120.0


def _ecef(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> Floats:
    """Earth-centred coordinates [m], one row per point."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    n = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    across = (n + height_m) * np.cos(latitude)
    up = (n * (1 - ECCENTRICITY_2) + height_m) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), up], axis=-1)


def _axes() -> Floats:
    """Rows: east, north, up at the origin."""
    latitude, longitude = np.radians(ORIGIN_LATITUDE_DEG), np.radians(ORIGIN_LONGITUDE_DEG)
    sin_b, cos_b, sin_l, cos_l = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array(
        [[-sin_l, cos_l, 0.0], [-sin_b * cos_l, -sin_b * sin_l, cos_b], [cos_b * cos_l, cos_b * sin_l, sin_b]]
    )


def geodetic(enu_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Latitude [deg], longitude [deg] and ellipsoidal height [m] of points in the plane of the origin."""
    at = np.array([ORIGIN_LATITUDE_DEG]), np.array([ORIGIN_LONGITUDE_DEG]), np.array([ORIGIN_HEIGHT_M])
    x, y, z = (_ecef(*at) + enu_m @ _axes()).T
    across = np.hypot(x, y)
    latitude = np.arctan2(z, across * (1 - ECCENTRICITY_2))
    for _ in range(6):  # converges by a factor of 150 each time near the ground
        n = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(z + ECCENTRICITY_2 * n * np.sin(latitude), across)
    n = SEMI_MAJOR_M / np.sqrt(1 - ECCENTRICITY_2 * np.sin(latitude) ** 2)
    height = across / np.cos(latitude) - n
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), height


@dataclass(frozen=True, eq=False)
class Element:
    """A net element as fine points in the plane; `base_m` is the main line's coordinate abreast of each."""

    name: str
    east_m: Floats
    north_m: Floats
    base_m: Floats

    @cached_property
    def measure_m(self) -> Floats:
        steps = np.hypot(np.diff(self.east_m), np.diff(self.north_m))
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length_m(self) -> float:
        return float(self.measure_m[-1])

    def at(self, measure_m: Floats) -> tuple[Floats, Floats]:
        """Points (east, north) and unit tangents."""
        east = np.interp(measure_m, self.measure_m, self.east_m)
        north = np.interp(measure_m, self.measure_m, self.north_m)
        last = len(self.measure_m) - 2
        cell = np.clip(np.searchsorted(self.measure_m, measure_m, side="right") - 1, 0, last)
        tangent = np.stack([np.diff(self.east_m)[cell], np.diff(self.north_m)[cell]], axis=-1)
        return np.stack([east, north], axis=-1), tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)


@dataclass(frozen=True)
class Route:
    """The elements that the train runs over, in order, all from start to end; its coordinate is the way s [m]."""

    elements: tuple[Element, ...]

    @cached_property
    def starts_m(self) -> Floats:
        return np.concatenate([[0.0], np.cumsum([element.length_m for element in self.elements])])

    @property
    def length_m(self) -> float:
        return float(self.starts_m[-1])

    def locate(self, chainage_m: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Index of the element, and measure on it."""
        index = np.clip(np.searchsorted(self.starts_m, chainage_m, side="right") - 1, 0, len(self.elements) - 1)
        return index, chainage_m - self.starts_m[index]

    def chainage_m(self, netelement_id: str, measure_m: float) -> float | None:
        """The way of a place on the route, none for a place beside it."""
        names = [element.name for element in self.elements]
        return float(self.starts_m[names.index(netelement_id)] + measure_m) if netelement_id in names else None

    def points(self, chainage_m: Floats, left_m: Floats, up_m: Floats) -> tuple[Floats, Floats]:
        """Points [m, ENU of the origin] beside the route, and unit tangents (east, north)."""
        index, measure = self.locate(chainage_m)
        plane, tangent = np.zeros((len(chainage_m), 2)), np.zeros((len(chainage_m), 2))
        for number, element in enumerate(self.elements):
            here = index == number
            plane[here], tangent[here] = element.at(measure[here])
        left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        return np.column_stack([plane + left * left_m[:, None], up_m]), tangent


@dataclass(frozen=True)
class Ground:
    """All elements, how their ends join, and the route that the train takes; `aside_m`: how far to its left the other
    track lies where both run in parallel.
    """

    elements: tuple[Element, ...]
    joints: tuple[tuple[str, int, str, int], ...]
    route: Route
    aside_m: float = 0.0

    def other_left_m(self, chainage_m: Floats) -> Floats:
        """How far to the left of the route another track lies there; NaN where there is none."""
        left = np.full(len(chainage_m), np.nan)
        taken = {element.base_m[0]: number for number, element in enumerate(self.route.elements)}
        names = {element.name for element in self.route.elements}
        for other in (element for element in self.elements if element.name not in names):
            number = taken[other.base_m[0]]
            begin, end = self.route.starts_m[number : number + 2]
            here = (chainage_m >= begin) & (chainage_m <= end)
            left[here] = self.aside_m * _switch(chainage_m[here] - begin, end - begin)
        return left

    def element(self, name: str) -> Element:
        return next(element for element in self.elements if element.name == name)


def line(length_m: float, bend_deg: float, heading_deg: float) -> Element:
    """The main line: its heading swings by `bend_deg` to both sides over waves of 6 km."""
    base = np.arange(0.0, length_m + FINE_STEP_M / 2, FINE_STEP_M)
    middle = (base[1:] + base[:-1]) / 2
    heading = np.radians(heading_deg + bend_deg * np.sin(2 * np.pi * middle / 6000.0))
    steps = np.diff(base)
    east = np.concatenate([[0.0], np.cumsum(steps * np.sin(heading))])
    north = np.concatenate([[0.0], np.cumsum(steps * np.cos(heading))])
    return Element("line", east, north, base)


def part(of: Element, name: str, begin_m: float, end_m: float) -> Element:
    """The piece of an element between two whole metres."""
    cut = slice(round(begin_m / FINE_STEP_M), round(end_m / FINE_STEP_M) + 1)
    return Element(name, of.east_m[cut], of.north_m[cut], of.base_m[cut])


def beside(of: Element, name: str, left_m: float) -> Element:
    """A neighbour that leaves an element at its start, runs `left_m` aside and comes back at its end."""
    _, tangent = of.at(of.measure_m)
    aside = left_m * _switch(of.measure_m, of.length_m)
    return Element(name, of.east_m - tangent[:, 1] * aside, of.north_m + tangent[:, 0] * aside, of.base_m)


def _switch(measure_m: Floats, length_m: float) -> Floats:
    """Share of the full distance aside, from switch to switch."""
    ramp = np.clip(np.minimum(measure_m, length_m - measure_m) / SWITCH_LENGTH_M, 0.0, 1.0)
    return np.asarray(ramp**2 * (3 - 2 * ramp))


def make_ground(
    length_m: float,
    bend_deg: float = 0.0,
    heading_deg: float = 60.0,
    joints_m: tuple[float, ...] = (),
    neighbour: tuple[float, float, float] | None = None,
    over_neighbour: bool = False,
) -> Ground:
    """A line cut at `joints_m`; `neighbour` = (begin, end, metres to the left) adds a parallel track with switches."""
    main = line(length_m, bend_deg, heading_deg)
    borders = sorted({0.0, *joints_m, *(neighbour[:2] if neighbour else ()), length_m})
    pieces = [part(main, f"main{k}", a, b) for k, (a, b) in enumerate(pairwise(borders))]
    if neighbour is None:
        return Ground(tuple(pieces), _in_order(pieces), Route(tuple(pieces)))
    begin, end, left_m = neighbour
    if borders.index(end) != borders.index(begin) + 1:
        raise ValueError("a joint lies within the neighbour track")
    number = borders.index(begin)
    other = beside(pieces[number], "neighbour", left_m)
    joined = ((pieces[number - 1].name, 1, other.name, 0), (other.name, 1, pieces[number + 1].name, 0))
    taken = [*pieces[:number], other, *pieces[number + 1 :]] if over_neighbour else pieces
    aside_m = -left_m if over_neighbour else left_m
    return Ground((*pieces, other), (*_in_order(pieces), *joined), Route(tuple(taken)), aside_m)


def _in_order(pieces: list[Element]) -> tuple[tuple[str, int, str, int], ...]:
    return tuple((a.name, 1, b.name, 0) for a, b in pairwise(pieces))


@dataclass(frozen=True)
class Balise:
    """A balise of the site."""

    balise_id: str
    netelement_id: str
    measure_m: float
    kind: str


def balises_every(ground: Ground, spacing_m: float, kind: str, first_m: float, prefix: str) -> list[Balise]:
    """Balises along the main coordinate; on parallel elements abreast of each other."""
    found: list[Balise] = []
    for element in ground.elements:
        at = np.arange(first_m, ground.elements[-1].base_m[-1] + 1e5, spacing_m)
        inside = at[(at > element.base_m[0] + 1.0) & (at < element.base_m[-1] - 1.0)]
        measures = np.interp(inside, element.base_m, element.measure_m)
        mark = "n" if element.name == "neighbour" else ""
        found += [
            Balise(f"{prefix}{mark}{base:07.0f}", element.name, float(measure), kind)
            for base, measure in zip(inside, measures, strict=True)
        ]
    return found


def make_site(ground: Ground, balises: list[Balise], survey_sigma_m: float = 0.1) -> Site:
    """The site as frames of the contract."""
    return Site(
        track=pl.concat([_surveyed(element, survey_sigma_m) for element in ground.elements]),
        links=_links(ground),
        balises=_listed(balises),
    )


def _surveyed(element: Element, sigma_m: float) -> pl.DataFrame:
    last = len(element.measure_m) - 1
    rows = np.unique(np.append(np.arange(0, last, SURVEY_EVERY), last))
    plane = np.column_stack([element.east_m[rows], element.north_m[rows], np.zeros(len(rows))])
    latitude, longitude, height = geodetic(plane)
    return Track.validate(
        pl.DataFrame(
            {
                "netelement_id": [element.name] * len(rows),
                "measure_m": element.measure_m[rows],
                "latitude_deg": latitude,
                "longitude_deg": longitude,
                "height_m": height,
                "sigma_m": [sigma_m] * len(rows),
            }
        ),
        cast=True,
    )


def _links(ground: Ground) -> pl.DataFrame:
    names = ("netelement_a", "position_a", "netelement_b", "position_b")
    rows = [dict(zip(names, joint, strict=True)) | {"navigability": "both"} for joint in ground.joints]
    schema = {"netelement_a": pl.String, "position_a": pl.Int64, "netelement_b": pl.String, "position_b": pl.Int64}
    return Links.validate(pl.DataFrame(rows, schema={**schema, "navigability": pl.String}), cast=True)


def _listed(balises: list[Balise]) -> pl.DataFrame:
    rows = [
        {
            "balise_id": balise.balise_id,
            "netelement_id": balise.netelement_id,
            "measure_m": balise.measure_m,
            "kind": balise.kind,
            "location_accuracy_m": 5.0,
            "linked": True,
            "link_reaction": "service_brake",
            "direction": "both",
        }
        for balise in balises
    ]
    return Balises.validate(pl.DataFrame(rows), cast=True)
