"""Satellites as a receiver sees them: lines of sight (DO-229 appendix J, G_i) and how good ranges are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from schemas.arrays import Floats

# DIAG Table 1, variances that do not depend on elevation [m^2].
_ORBIT_CLOCK_M2 = 0.3
_USER_M2 = 1.5
# DO-229 A.4.4.10.4 (obliquity) and A.4.2.4 (troposphere); 0.3 m at zenith stands for the paper's lost value.
_EARTH_RADIUS_KM = 6378.1363
_IONOSPHERE_HEIGHT_KM = 350.0
_ZENITH_IONOSPHERE_M = 0.3
_ZENITH_TROPOSPHERE_M = 0.12


def line_of_sight_rows(azimuth_deg: Floats, elevation_deg: Floats) -> Floats:
    """Change of range per metre east, north, up; shape (..., 3)."""
    azimuth = np.radians(azimuth_deg)
    elevation = np.radians(elevation_deg)
    return np.stack(
        [-np.cos(elevation) * np.sin(azimuth), -np.cos(elevation) * np.cos(azimuth), -np.sin(elevation)],
        axis=-1,
    )


def clock_columns(svs: Sequence[str]) -> Floats:
    """One receiver clock per constellation, shape (n, clocks)."""
    systems = sorted({sv[:1] for sv in svs})
    return np.array([[float(sv.startswith(system)) for system in systems] for sv in svs])


def ionosphere_m2(elevation_deg: Floats, zenith_m: float) -> Floats:
    """Variance of a vertical error at an elevation (DO-229 A.4.4.10.4, obliquity) [m^2]."""
    elevation = np.radians(np.maximum(elevation_deg, 0.0))
    ratio = _EARTH_RADIUS_KM * np.cos(elevation) / (_EARTH_RADIUS_KM + _IONOSPHERE_HEIGHT_KM)
    variance: Floats = zenith_m**2 / (1.0 - ratio**2)
    return variance


def troposphere_m2(elevation_deg: Floats, zenith_m: float) -> Floats:
    """The same of the troposphere (DO-229 A.4.2.4) [m^2]."""
    elevation = np.radians(np.maximum(elevation_deg, 0.0))
    variance: Floats = (zenith_m * 1.001) ** 2 / (0.002001 + np.sin(elevation) ** 2)
    return variance


def range_variances_m2(elevation_deg: Floats) -> Floats:
    """Ionosphere, troposphere, orbit and clock, user [m^2]; shape (..., 4).

    DIAG Table 1 for a range corrected by SBAS.
    """
    ionosphere = ionosphere_m2(elevation_deg, _ZENITH_IONOSPHERE_M)
    troposphere = troposphere_m2(elevation_deg, _ZENITH_TROPOSPHERE_M)
    level = np.ones_like(troposphere)
    return np.stack([ionosphere, troposphere, _ORBIT_CLOCK_M2 * level, _USER_M2 * level], axis=-1)
