"""Earth-centred, earth-fixed coordinates (WGS 84) as receivers give them, turned into geodetic and local ones."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from pyproj import Transformer

from schemas.arrays import Floats


def geodetic(x_m: Any, y_m: Any, z_m: Any) -> dict[str, Any]:
    """The `gnss` columns of a place, or of an array of places."""
    longitude, latitude, height = _transformer().transform(x_m, y_m, z_m)
    return {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}


def local_velocity(
    latitude_deg: float, longitude_deg: float, velocity_mps: tuple[float, float, float]
) -> dict[str, Any]:
    """The `gnss` columns of an earth-fixed velocity at a place."""
    east, north, up = east_north_up(latitude_deg, longitude_deg) @ np.array(velocity_mps)
    return {"vel_e_mps": float(east), "vel_n_mps": float(north), "vel_u_mps": float(up)}


def east_north_up(latitude_deg: Any, longitude_deg: Any) -> Floats:
    """Rotation from earth-fixed axes to east, north, up; shape (3, 3), of n places (3, 3, n)."""
    lat = np.radians(latitude_deg)
    lon = np.radians(longitude_deg)
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), np.zeros_like(lon)],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )


@cache
def _transformer() -> Transformer:
    """The transformation from earth-fixed coordinates to geodetic ones."""
    return Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
