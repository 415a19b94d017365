"""Line kilometres along an element: where they jump, and where one of them is."""

from __future__ import annotations

import numpy as np

from schemas.arrays import Floats, Ints
from schemas.config import SurveyConfig


def spans(line_km: Floats, way_m: Floats, config: SurveyConfig) -> tuple[Ints, Floats, np.ndarray]:
    """Points with a kilometre; how far [m] the kilometres stray from the way to the next of them; where they jump."""
    known = np.flatnonzero(np.isfinite(line_km))
    by_km, by_way = np.diff(line_km[known]) * 1000.0, np.diff(way_m[known])
    sign = 1.0 if by_km.sum() >= 0 else -1.0
    off_m = np.abs(sign * by_km - by_way)
    return known, off_m, off_m > np.maximum(config.kilometre_m, config.kilometre_share * by_way)


def measures_at(line_km: Floats, measure_m: Floats, km: float, config: SurveyConfig) -> list[float]:
    """All measures at which an element has a line kilometre; a kilometre within a jump is nowhere."""
    known, _, jumps = spans(line_km, measure_m, config)
    found = []
    for low, high in zip(known[:-1][~jumps].tolist(), known[1:][~jumps].tolist(), strict=True):
        a, b = line_km[low], line_km[high]
        if min(a, b) <= km <= max(a, b) and a != b:
            found.append(float(measure_m[low] + (km - a) / (b - a) * (measure_m[high] - measure_m[low])))
    # A kilometre at a point ends one span and begins the next.
    return [one for row, one in enumerate(found) if row == 0 or one - found[row - 1] > 1e-6]
