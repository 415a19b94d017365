"""WGS 84 positions as metres, right over any distance a site may span.

No plane serves a line of 100 km: lengths are chords of the ellipsoid, and everything across the track is
measured in the tangent plane of the point itself.
"""

from __future__ import annotations

import numpy as np

from schemas.arrays import Floats, Ints
from schemas.frozen import frozen

# NIMA TR8350.2, table 3.1 and 3.3: semi-major axis [m] and first eccentricity squared of WGS 84.
SEMI_MAJOR_AXIS_M = 6_378_137.0
ECCENTRICITY_SQUARED = 6.694_379_990_14e-3
# (2 a + b) / 3, the mean radius of the ellipsoid: within 0.6 % of how it curves anywhere.
MEAN_RADIUS_M = SEMI_MAJOR_AXIS_M * (2.0 + float(np.sqrt(1.0 - ECCENTRICITY_SQUARED))) / 3.0


@frozen
class Points:
    """Points on the ellipsoid: earth-centred positions at height zero [m], unit vectors east and north."""

    surface: Floats
    east: Floats
    north: Floats

    def __len__(self) -> int:
        return len(self.surface)

    def take(self, rows: Ints) -> Points:
        """Some of the points."""
        return Points(*(vectors.take(rows, axis=0) for vectors in (self.surface, self.east, self.north)))


def points_of(latitude_deg: Floats, longitude_deg: Floats) -> Points:
    """The places of positions, heights left out: horizontal work needs none, and many recordings have none."""
    sin_lat, cos_lat, sin_lon, cos_lon = sines_and_cosines(latitude_deg, longitude_deg)
    zeros = np.zeros_like(sin_lat)
    return Points(
        surface=_ellipsoid_to_earth_centred_m(sin_lat, cos_lat, sin_lon, cos_lon, zeros),
        east=np.column_stack([-sin_lon, cos_lon, zeros]),
        north=np.column_stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat]),
    )


def earth_centred_m(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> Floats:
    """Earth-centred, earth-fixed coordinates [m], shape (n, 3)."""
    return _ellipsoid_to_earth_centred_m(
        *sines_and_cosines(latitude_deg, longitude_deg), np.asarray(height_m, dtype=np.float64)
    )


def point_distances_m(latitude_deg: Floats, longitude_deg: Floats, height_m: Floats) -> Floats:
    """Straight 3-D distances between consecutive points [m], one fewer than points."""
    return place_distances_m(earth_centred_m(latitude_deg, longitude_deg, height_m))


def place_distances_m(places: Floats) -> Floats:
    """Straight distances between consecutive places [m], one fewer than places."""
    steps = np.diff(places, axis=0)
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", steps, steps)))


def distance_along_m(places: Floats) -> Floats:
    """Running distance along a polyline.

    Args:
        places: earth-centred vertices in order [m], shape (n, 3).

    Returns:
        Distance of each vertex from the first one along the line [m], shape (n,).
    """
    return np.concatenate([np.zeros(min(1, len(places))), np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])


def distance_between_m(
    latitude_a_deg: float, longitude_a_deg: float, latitude_b_deg: float, longitude_b_deg: float
) -> float:
    """Straight distance between two places on the ellipsoid [m], at height zero."""
    pair = np.array([latitude_a_deg, latitude_b_deg]), np.array([longitude_a_deg, longitude_b_deg])
    return float(point_distances_m(*pair, np.zeros(2))[0])


def curvature_radii_m(latitude: Floats) -> tuple[Floats, Floats]:
    """Radii of curvature of the ellipsoid in the meridian and across it [m], latitude in radians."""
    root = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    normal = SEMI_MAJOR_AXIS_M / np.sqrt(root)
    return normal * (1.0 - ECCENTRICITY_SQUARED) / root, normal


def moved_deg(
    latitude_deg: Floats, longitude_deg: Floats, height_m: Floats, east_m: Floats, north_m: Floats
) -> tuple[Floats, Floats]:
    """Latitude and longitude [deg] moved by a vector of the local horizon, small against the radius of the Earth."""
    latitude = np.radians(latitude_deg)
    meridian_m, normal_m = curvature_radii_m(latitude)
    return (
        latitude_deg + np.degrees(north_m / (meridian_m + height_m)),
        longitude_deg + np.degrees(east_m / ((normal_m + height_m) * np.cos(latitude))),
    )


def sines_and_cosines(latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Sine and cosine of latitude, sine and cosine of longitude."""
    latitude = np.radians(latitude_deg)
    longitude = np.radians(longitude_deg)
    return np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)


def _ellipsoid_to_earth_centred_m(
    sin_lat: Floats, cos_lat: Floats, sin_lon: Floats, cos_lon: Floats, height_m: Floats
) -> Floats:
    """Earth-fixed coordinates of geodetic ones, on the ellipsoid of WGS 84 [m]."""
    normal_m = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sin_lat * sin_lat)
    ring_m = (normal_m + height_m) * cos_lat
    up_m = (normal_m * (1.0 - ECCENTRICITY_SQUARED) + height_m) * sin_lat
    return np.column_stack([ring_m * cos_lon, ring_m * sin_lon, up_m])
