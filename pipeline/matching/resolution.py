"""How coarsely a recorder wrote positions down, and what that adds to their noise.

A log of five decimals of a degree, NMEA of four decimals of a minute, or single precision moves each position by up to
half a step, the next one by something else. At 10 Hz half a metre of that looks like metres per second. Only the
digits are looked at, so no fault of the position can pass for it.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.ingest.written_steps import step_of
from schemas.arrays import Floats, floats

_EARTH_RADIUS_M = 6_371_000.0
# Finer steps drown in the noise of any receiver; less than the other is rounding.
_LEAST_STEP_M, _ROUNDED_M = 0.02, 1e-4


def digit_noise(fixes: pl.DataFrame, heading_deg: Floats) -> list[pl.Series]:
    """Columns `digits_along_m`, `digits_cross_m`, `digits_up_m`: deviation by the steps of the recorded coordinates.

    `fixes`: those of one solution, row for row with `heading_deg`, the direction of growing path.
    """
    latitude = floats(fixes, "latitude_deg")
    known = latitude[np.isfinite(latitude)]
    north_per_deg = np.radians(1.0) * _EARTH_RADIUS_M
    east_per_deg = north_per_deg * np.cos(np.radians(known.mean())) if known.size else north_per_deg
    north, east, up = (
        step_m(values[np.isfinite(values)], scale) / np.sqrt(12.0)
        for values, scale in (
            (latitude, north_per_deg),
            (floats(fixes, "longitude_deg"), east_per_deg),
            (floats(fixes, "height_m"), 1.0),
        )
    )
    turned = np.radians(np.nan_to_num(heading_deg))
    along = np.hypot(north * np.cos(turned), east * np.sin(turned))
    cross = np.hypot(north * np.sin(turned), east * np.cos(turned))
    return [
        pl.Series("digits_along_m", along),
        pl.Series("digits_cross_m", cross),
        pl.Series("digits_up_m", np.full(turned.size, up)),
    ]


def step_m(values: Floats, metres: float) -> float:
    """The step of a recorded coordinate [m], 0 where there is none to speak of; `metres`: of one unit of it."""
    changes = np.diff(values)
    # At speed the changes themselves are many steps each, but the change of the change is one at times.
    return metres * step_of(changes, np.diff(changes), _LEAST_STEP_M / metres, _ROUNDED_M / metres)
