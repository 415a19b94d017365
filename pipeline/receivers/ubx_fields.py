"""What the fields mean that several UBX messages share."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from schemas.arrays import NS_PER_S
from schemas.enums import Fix

_NO_FIX, _DEAD_RECKONING, _TIME_ONLY = 0, 1, 5
_RTK_FLOAT, _RTK_FIXED = 1, 2


def fix_of(fix_type: int, good: bool, differential: bool, carrier: int = 0) -> Fix:
    """Kind of fix from `fixType` (or `gpsFix`), the flag that it is within its limits, `diffSoln` and `carrSoln`."""
    if not good or fix_type in (_NO_FIX, _TIME_ONLY):
        return Fix.NONE
    if fix_type == _DEAD_RECKONING:
        return Fix.ESTIMATED
    if carrier in (_RTK_FLOAT, _RTK_FIXED):
        return Fix.RTK_FIXED if carrier == _RTK_FIXED else Fix.RTK_FLOAT
    return Fix.DIFFERENTIAL if differential else Fix.AUTONOMOUS


def calendar_ns(m: Any, second: int) -> int | None:
    """UTC of a message's calendar and `nano`, none where there is no such day [ns since 1970]."""
    try:
        minute = datetime(m.year, m.month, m.day, m.hour, m.min, tzinfo=UTC)
    except ValueError:
        return None
    return (int(minute.timestamp()) + second) * NS_PER_S + int(m.nano)


def place(m: Any) -> dict[str, float]:
    """Longitude and latitude [deg] and height over the ellipsoid [mm]."""
    return {"latitude_deg": m.lat, "longitude_deg": m.lon, "height_m": m.height / 1e3}


def velocity(east: float, north: float, down: float) -> dict[str, float]:
    """Velocity [m/s]."""
    return {"vel_e_mps": east, "vel_n_mps": north, "vel_u_mps": -down}


def accuracy(horizontal_m: float, vertical_m: float) -> dict[str, float]:
    """Covariance of `hAcc`, the standard deviation in the plane (half of its variance on each axis), and `vAcc`."""
    plane = 0.5 * horizontal_m**2
    return covariance(plane, 0.0, 0.0, plane, 0.0, vertical_m**2)


def covariance(ee: float, en: float, eu: float, nn: float, nu: float, uu: float) -> dict[str, float]:
    names = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")
    return dict(zip(names, (ee, en, eu, nn, nu, uu), strict=True))


def satellites_of(
    m: Any, count: int, name_of: Callable[..., str | None], names: tuple[str, ...], residual_m: float
) -> list[dict[str, Any]]:
    """The rows of NAV-SAT and NAV-SVINFO whose satellite is known and above or below a horizon.

    `names`: fields that make the name, `residual_m`: the unit of the residual.
    """
    rows: list[dict[str, Any]] = []
    for index in range(1, count + 1):
        value = {name: getattr(m, f"{name}_{index:02d}") for name in (*names, "azim", "elev", "prRes", "svUsed")}
        name, elevation_deg = name_of(*(value[name] for name in names)), float(value["elev"])
        if name is not None and abs(elevation_deg) <= 90.0:
            rows.append(
                {
                    "sv": name,
                    "azimuth_deg": float(value["azim"]),
                    "elevation_deg": elevation_deg,
                    "residual_m": value["prRes"] * residual_m if value["svUsed"] else None,
                    "used": bool(value["svUsed"]),
                }
            )
    return rows
