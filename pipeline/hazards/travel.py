"""Distance travelled by the odometer at the epochs' times of validity, as evidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from schemas.arrays import Floats, Ints, floats, ints


@dataclass(frozen=True)
class Travel:
    """Per epoch: instant, distance along growing path (NaN = not known), stretch of unbroken counting,
    sigma of the scale, variance that the distance gains per second, and that of a single reading [m2]. `odometer_m`:
    the odometer's own distance, which `distance_m` is but for repairs.
    """

    at_ns: Ints
    distance_m: Floats
    odometer_m: Floats
    stretch: Ints
    scale_sigma: Floats
    white_m2_per_s: Floats
    reading_m2: Floats

    def joined_with(self, reference_m: Floats) -> tuple[Floats, Ints]:
        """Distance and stretch whose steps come from the reference where both ends of a step have it.

        A step is unknown, and a new stretch begins, where neither reaches over it.
        """
        by_odometer = np.diff(self.distance_m)
        by_odometer[np.diff(self.stretch) != 0] = np.nan
        by_reference = np.diff(reference_m)
        steps = np.where(np.isfinite(by_reference), by_reference, by_odometer)
        known = np.isfinite(steps)
        size = self.distance_m.size
        distance, stretch = np.zeros(size), np.zeros(size, dtype=np.int64)
        distance[1:] = np.cumsum(np.where(known, steps, 0.0))
        stretch[1:] = np.cumsum(~known)
        return distance, stretch


def odometer_travel(epochs: pl.DataFrame, at_ns: Ints) -> Travel:
    """The aligned odometer of the epochs, unknown throughout where the run has none."""
    white = floats(epochs, "odometer_white_m2_per_s")
    return Travel(
        at_ns=at_ns,
        distance_m=floats(epochs, "odometer_m"),
        odometer_m=floats(epochs, "odometer_m"),
        stretch=ints(epochs["odometer_segment"]),
        scale_sigma=np.nan_to_num(floats(epochs, "scale_sigma")),
        white_m2_per_s=np.nan_to_num(white),
        reading_m2=np.nan_to_num(floats(epochs, "odometer_rows_m")) ** 2,
    )
