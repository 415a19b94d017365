"""Satellite geometries of the experiment: rows, weights, and the 3-D errors that range errors become.

Place, time and skyplot of the paper are lost, so the geometry is our choice, said here: nominal
constellations above Brussels, satellite 8 (slot B4 of GPS) faulty and above the mask.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Literal

import numpy as np

from datasets.constellation import GALILEO, GPS, look_angles
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


PLACE = "brussels"
_LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT_M = 50.85, 4.35, 100.0
# Satellite 8 at 9 degrees in the south-west, 8 GPS and 16 GPS + Galileo satellites. One of the skies in which all
# findings of the paper hold with odometer noise on position.
DEFAULT_NS = int(datetime(2024, 3, 20, 6, 27, tzinfo=UTC).timestamp()) * 1_000_000_000


@frozen
class Geometry:
    """A fixed sky: satellites with azimuth and elevation [deg], range error variances R_ij [m^2] by source."""

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


def geometry_at(t_ns: int, constellation: Constellation) -> Geometry:
    """The sky above the experiment's place at this instant [ns since 1970, UTC].

    Raises `ValueError` where the faulty satellite is below the mask.
    """
    slots = GPS if constellation == "gps" else GPS + GALILEO
    azimuth, elevation = look_angles(slots, np.array([t_ns]), _LATITUDE_DEG, _LONGITUDE_DEG, _HEIGHT_M)
    shown = np.flatnonzero(elevation[0] >= MASK_DEG)
    svs = tuple(slots[index].sv for index in shown)
    if FAULTY_SATELLITE not in svs:
        raise ValueError(f"{FAULTY_SATELLITE} is below the mask at {t_ns}")
    return Geometry(
        t_ns,
        constellation,
        svs,
        azimuth[0, shown],
        elevation[0, shown],
        range_variances_m2(elevation[0, shown]),
        svs.index(FAULTY_SATELLITE),
    )


def default_geometry(constellation: Constellation) -> Geometry:
    """The geometry of the experiment at its own size."""
    return geometry_at(DEFAULT_NS, constellation)
