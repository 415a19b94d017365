"""Where GPS and Galileo satellites stand in the sky of a place, from their published nominal constellations.

GPS: the 24 slots of the SPS Performance Standard (4th edition, Table A.2-1). Galileo: the Walker 24/3/1
reference constellation of the Open Service Service Definition Document. Nominal slots, no almanac: the sky
is typical for the systems, not the one of that day.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
import polars as pl

from pipeline.stages.track.geodesy import SEMI_MAJOR_AXIS_M, earth_centred_m
from schemas.arrays import Floats, Ints
from schemas.frozen import frozen

_DEG = np.pi / 180.0
_DAY_S = 86400.0
_EARTH_RATE_RAD_PER_S = 7.2921151467e-5
_GRAVITY_M3_PER_S2 = 3.986005e14
_J2 = 1.08262982e-3


@frozen
class Orbit:
    """A circular orbit: `raan_deg` and `argument_deg` (of latitude) hold at `epoch_ns`, rates are secular."""

    sv: str
    epoch_ns: int
    semi_major_axis_m: float
    inclination_deg: float
    raan_deg: float
    argument_deg: float
    raan_rate_deg_per_day: float
    argument_rate_deg_per_day: float


def _instant_ns(year: int, month: int, day: int) -> int:
    """Midnight of a day in UTC [ns since 1970]."""
    return int(datetime(year, month, day, tzinfo=UTC).timestamp()) * 1_000_000_000


def _gps_slots() -> tuple[Orbit, ...]:
    """SPS PS Table A.2-1, epoch 1993-07-01T00:00 UTC; slots A1..F4 are named G01..G24 in that order.

    Two revolutions per turn of the Earth against the node: the ground track repeats.
    """
    raans = (272.847, 332.847, 32.847, 92.847, 152.847, 212.847)
    arguments = (
        (268.126, 161.786, 11.676, 41.806),
        (80.956, 173.336, 309.976, 204.376),
        (111.876, 11.796, 339.666, 241.556),
        (135.226, 265.446, 35.156, 167.356),
        (197.046, 302.596, 66.066, 333.686),
        (238.886, 345.226, 105.206, 135.346),
    )
    axis_m, inclination_deg = 26_559_700.0, 55.0
    motion = np.sqrt(_GRAVITY_M3_PER_S2 / axis_m**3)
    node = -1.5 * _J2 * (SEMI_MAJOR_AXIS_M / axis_m) ** 2 * motion * np.cos(inclination_deg * _DEG)
    turn = 2.0 * (_EARTH_RATE_RAD_PER_S - node)
    to_deg_per_day = _DAY_S / _DEG
    return tuple(
        Orbit(
            f"G{4 * plane + place + 1:02d}",
            _instant_ns(1993, 7, 1),
            axis_m,
            inclination_deg,
            raans[plane],
            arguments[plane][place],
            float(node * to_deg_per_day),
            float(turn * to_deg_per_day),
        )
        for plane in range(6)
        for place in range(4)
    )


def _galileo_slots() -> tuple[Orbit, ...]:
    """OS SDD reference constellation, epoch 2016-11-21T00:00 UTC; slots A1..C8 are E01..E24 in that order."""
    return tuple(
        Orbit(
            f"E{8 * plane + place + 1:02d}",
            _instant_ns(2016, 11, 21),
            29_599_800.0,
            56.0,
            (317.632 + 120.0 * plane) % 360.0,
            (225.153 + 15.0 * plane + 45.0 * place) % 360.0,
            -0.02764398,
            613.72253566,
        )
        for plane in range(3)
        for place in range(8)
    )


GPS: tuple[Orbit, ...] = _gps_slots()
GALILEO: tuple[Orbit, ...] = _galileo_slots()
SIDEREAL_DAY_S = 2.0 * np.pi / _EARTH_RATE_RAD_PER_S


def satellite_positions(slots: Sequence[Orbit], t_ns: Ints) -> Floats:
    """Earth-fixed positions [m] at UTC instants, shape (times, slots, 3)."""
    epoch_ns = np.array([slot.epoch_ns for slot in slots])
    days = (t_ns[:, None] - epoch_ns[None, :]) * 1e-9 / _DAY_S
    raan, argument, raan_rate, argument_rate, inclination, axis_m = (
        np.array([getattr(slot, name) for slot in slots])
        for name in (
            "raan_deg",
            "argument_deg",
            "raan_rate_deg_per_day",
            "argument_rate_deg_per_day",
            "inclination_deg",
            "semi_major_axis_m",
        )
    )
    u = (argument + argument_rate * days) * _DEG
    node = (raan + raan_rate * days) * _DEG - _sidereal_angle(t_ns)[:, None]
    i = inclination * _DEG
    x = np.cos(node) * np.cos(u) - np.sin(node) * np.sin(u) * np.cos(i)
    y = np.sin(node) * np.cos(u) + np.cos(node) * np.sin(u) * np.cos(i)
    z = np.sin(u) * np.sin(i)
    positions: Floats = np.stack([x, y, z], axis=-1) * axis_m[None, :, None]
    return positions


def look_angles(
    slots: Sequence[Orbit], t_ns: Ints, latitude_deg: float, longitude_deg: float, height_m: float = 0.0
) -> tuple[Floats, Floats]:
    """Azimuth (clockwise from north, [0, 360)) and elevation [deg], each of shape (times, slots)."""
    frame = _east_north_up_axes(latitude_deg, longitude_deg)
    place_m = earth_centred_m(*(np.array([value]) for value in (latitude_deg, longitude_deg, height_m)))[0]
    line = satellite_positions(slots, t_ns) - place_m
    east, north, up = np.moveaxis(line @ frame.T, -1, 0)
    azimuth = np.degrees(np.arctan2(east, north)) % 360.0
    return np.where(azimuth == 360.0, 0.0, azimuth), np.degrees(np.arctan2(up, np.hypot(east, north)))


def visible_satellites(
    slots: Sequence[Orbit],
    t_ns: Ints,
    latitude_deg: float,
    longitude_deg: float,
    height_m: float = 0.0,
    mask_deg: float = 5.0,
) -> pl.DataFrame:
    """`t, sv, azimuth_deg, elevation_deg` of the satellites at or above the mask, in order of time and slot."""
    azimuth, elevation = look_angles(slots, t_ns, latitude_deg, longitude_deg, height_m)
    names = np.array([slot.sv for slot in slots])
    return (
        pl.DataFrame(
            {
                "t": np.repeat(t_ns, len(slots)),
                "sv": np.tile(names, t_ns.size),
                "azimuth_deg": azimuth.ravel(),
                "elevation_deg": elevation.ravel(),
            }
        )
        .filter(pl.col("elevation_deg") >= mask_deg)
        .with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))
    )


def _sidereal_angle(t_ns: Ints) -> Floats:
    """Greenwich mean sidereal time [rad] (IAU 1982, linear term; UT1 taken as UTC)."""
    days = (t_ns - _instant_ns(2000, 1, 1)) * 1e-9 / _DAY_S - 0.5
    angle: Floats = np.radians((280.46061837 + 360.98564736629 * days) % 360.0)
    return angle


def _east_north_up_axes(latitude_deg: float, longitude_deg: float) -> Floats:
    """Rotation from earth-fixed axes to east, north, up; shape (3, 3)."""
    sin_b = np.sin(latitude_deg * _DEG)
    cos_b = np.cos(latitude_deg * _DEG)
    sin_l = np.sin(longitude_deg * _DEG)
    cos_l = np.cos(longitude_deg * _DEG)
    return np.array(
        [
            [-sin_l, cos_l, 0.0],
            [-sin_b * cos_l, -sin_b * sin_l, cos_b],
            [cos_b * cos_l, cos_b * sin_l, sin_b],
        ]
    )
