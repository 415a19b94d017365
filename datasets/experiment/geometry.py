"""Satellite geometries of the experiment: rows, weights, and the 3-D errors that range errors become.

Place, time and skyplot of the paper are lost, so the geometry is our choice, said here: nominal
constellations above two European places, satellite 8 (slot B4 of GPS) faulty and above the mask.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Literal, NamedTuple

import numpy as np

from datasets.constellation import GALILEO, GPS, SIDEREAL_DAY_S, look_angles
from pipeline.stages.monitors.pseudorange import clock_columns, line_of_sight_rows, range_variances_m2
from schemas.arrays import Floats
from schemas.frozen import frozen

Constellation = Literal["gps", "gps_galileo"]

CONSTELLATIONS: tuple[Constellation, ...] = ("gps", "gps_galileo")
FAULTY_SATELLITE = "G08"
MASK_DEG = 5.0
SOURCES: tuple[str, ...] = ("ionosphere", "troposphere", "orbit_clock", "user")
# DIAG Table 1: correlation times [s].
TAUS_S = np.array([360.0, 1800.0, 3600.0, 100.0])


class NamedPlace(NamedTuple):
    name: str
    latitude_deg: float
    longitude_deg: float
    height_m: float


BRUSSELS = NamedPlace("brussels", 50.85, 4.35, 100.0)
MADRID = NamedPlace("madrid", 40.42, -3.70, 650.0)
PLACES: tuple[NamedPlace, ...] = (BRUSSELS, MADRID)
_DAY_NS = int(datetime(2024, 3, 20, tzinfo=UTC).timestamp()) * 1_000_000_000
# 06:27 UTC: satellite 8 at 9 degrees in the south-west, 8 GPS and 16 GPS + Galileo satellites. One of the skies in
# which all findings of the paper hold with odometer noise on position; `findings` gives the shares over the day.
_DEFAULT_SECOND_OF_DAY = 23_220


@frozen
class Geometry:
    """A fixed sky: satellites with azimuth and elevation [deg], range error variances R_ij [m^2] by source."""

    place: str
    t_ns: int
    constellation: Constellation
    svs: tuple[str, ...]
    azimuth_deg: Floats
    elevation_deg: Floats
    range_variance_m2: Floats
    faulty: int

    @property
    def gain(self) -> Floats:
        """Range errors to east, north, up errors of the weighted least squares position, shape (3, n)."""
        design = np.hstack([line_of_sight_rows(self.azimuth_deg, self.elevation_deg), clock_columns(self.svs)])
        weight = 1.0 / self.range_variance_m2.sum(axis=1)
        normal = design.T @ (weight[:, None] * design)
        return np.asarray(np.linalg.solve(normal, design.T * weight)[:3])

    @property
    def source_covariances_m2(self) -> Floats:
        """Covariance of the position error by source, shape (sources, 3, 3): S diag(R_j) S'."""
        gain = self.gain
        return np.asarray(np.einsum("ai,ij,bi->jab", gain, self.range_variance_m2, gain))

    @property
    def ramp_direction(self) -> Floats:
        """East, north, up error per metre of range error of the faulty satellite."""
        return self.gain[:, self.faulty]

    def axes(self, heading_deg: float) -> Floats:
        """Unit vectors along, cross (left) and up, rows; heading 0 is towards the faulty satellite."""
        course = np.radians(self.azimuth_deg[self.faulty] + heading_deg)
        east = np.sin(course)
        north = np.cos(course)
        return np.array([[east, north, 0.0], [-north, east, 0.0], [0.0, 0.0, 1.0]])


def geometry_at(place: NamedPlace, t_ns: int, constellation: Constellation, mask_deg: float = MASK_DEG) -> Geometry:
    """The sky of a place; the faulty satellite must stand in it."""
    slots = GPS if constellation == "gps" else GPS + GALILEO
    azimuth, elevation = look_angles(slots, np.array([t_ns]), place.latitude_deg, place.longitude_deg, place.height_m)
    shown = np.flatnonzero(elevation[0] >= mask_deg)
    svs = tuple(slots[index].sv for index in shown)
    if FAULTY_SATELLITE not in svs:
        raise ValueError(f"{FAULTY_SATELLITE} is below the mask at {place.name}, {t_ns}")
    return Geometry(
        place.name,
        t_ns,
        constellation,
        svs,
        azimuth[0, shown],
        elevation[0, shown],
        range_variances_m2(elevation[0, shown]),
        svs.index(FAULTY_SATELLITE),
    )


def epochs_of_day(place: NamedPlace, count: int, mask_deg: float = MASK_DEG) -> list[int]:
    """`count` epochs, evenly over that part of a sidereal day in which the faulty satellite is visible."""
    minutes = _DAY_NS + (np.arange(0.0, SIDEREAL_DAY_S, 60.0) * 1e9).astype(np.int64)
    faulty = [slot for slot in GPS if slot.sv == FAULTY_SATELLITE]
    _, elevation = look_angles(faulty, minutes, place.latitude_deg, place.longitude_deg, place.height_m)
    visible = minutes[elevation[:, 0] >= mask_deg]
    picked = ((np.arange(count) + 0.5) / count * visible.size).astype(np.int64)
    return [int(instant) for instant in visible[picked]]


def default_geometry(constellation: Constellation) -> Geometry:
    """The geometry of the experiment at its own size."""
    return geometry_at(BRUSSELS, _DAY_NS + _DEFAULT_SECOND_OF_DAY * 1_000_000_000, constellation)


def skies_of_day(per_place: int) -> list[tuple[Geometry, ...]]:
    """Both constellations at `per_place` epochs of each of the two places."""
    return [
        tuple(geometry_at(place, t_ns, constellation) for constellation in CONSTELLATIONS)
        for place in PLACES
        for t_ns in epochs_of_day(place, per_place)
    ]
