"""What can tell whether a train moved while its odometer stood, and a movement of the positions that asks for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.motion.position_rate import PositionRate
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns, truths
from schemas.enums import Evidence


@dataclass(frozen=True)
class Witness:
    """What can tell, per epoch; NaN where not known. `stood`: from here to the next by the odometer.

    `slip_m`: by how much it counted too far between the reads around.
    """

    t_s: Floats
    positions: PositionRate
    path_m: Floats
    sigma_m: Floats
    odometer_m: Floats
    stretch: Ints
    stood: Bools
    reference_m: Floats
    reads_m: Floats
    slip_m: Floats
    velocity_mps: Floats

    @classmethod
    def of(cls, epochs: pl.DataFrame, truth: pl.DataFrame, positions: PositionRate, moving: Bools) -> Witness:
        t_ns = times_ns(epochs)
        evidence, place = truth["evidence"], floats(truth, "truth_path_m")
        odometer = floats(epochs, "odometer_m")
        counted = np.isfinite(odometer) & np.isfinite(np.append(odometer[1:], np.nan))
        known = flags(epochs, "fix_valid") & flags(epochs, "on_track")
        return cls(
            t_s=(t_ns - t_ns[0]) / NS_PER_S,
            positions=positions,
            path_m=np.where(known, floats(epochs, "path_m"), np.nan),
            sigma_m=floats(epochs, "sigma_along_m"),
            odometer_m=odometer,
            stretch=ints(epochs["odometer_segment"]),
            stood=counted & ~moving,
            reference_m=np.where(truths(evidence == Evidence.REFERENCE.value), place, np.nan),
            reads_m=np.where(truths(evidence == Evidence.BALISE.value), place, np.nan),
            slip_m=floats(truth, "truth_slip_m"),
            velocity_mps=floats(epochs, "velocity_along_mps"),
        )


@dataclass(frozen=True)
class Movement:
    """Positions that moved while the odometer stood over epochs `stand`: as a contradiction, and its cells of time.

    `seen`: share of it in which there were positions.
    """

    first: int
    last: int
    way_m: float
    seen: float
    cells: tuple[int, int]
    stand: tuple[int, int]
