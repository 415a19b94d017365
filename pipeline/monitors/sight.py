"""Lines of sight as rows of the linearised range equations (DO-229 appendix J, G_i)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def line_of_sight_rows(azimuth_deg: Array, elevation_deg: Array) -> Array:
    """Change of range per metre of receiver movement east, north, up; shape (..., 3)."""
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.stack(
        [-np.cos(elevation) * np.sin(azimuth), -np.cos(elevation) * np.cos(azimuth), -np.sin(elevation)],
        axis=-1,
    )


def clock_columns(svs: Sequence[str]) -> Array:
    """One receiver clock per constellation (first letter of the satellite's name), shape (n, clocks)."""
    systems = sorted({sv[:1] for sv in svs})
    return np.array([[float(sv.startswith(system)) for system in systems] for sv in svs])
