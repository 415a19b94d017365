"""The reference stream as evidence: between its samples, and where these are far apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.timeline import linking_gap_s, nominal_period_s
from pipeline.hazards.anchors import Anchors, carry
from pipeline.hazards.arrays import interpolate_known
from pipeline.hazards.travel import Travel
from schemas.arrays import NS_PER_S, Floats, Ints, floats, times_ns
from schemas.config import LdsConfig
from schemas.enums import Evidence

# Between samples no farther apart a straight line is the truth; a train that brakes is 0.75 m off it at most ...
_STRAIGHT_S = 2.0
# ... with this [m/s2], the emergency brake of a train.
_HARDEST_MPS2 = 1.5


@dataclass(frozen=True)
class Rung:
    """One kind of evidence per epoch; NaN where it does not reach. `bound_m` must be exceeded by a hazard.

    `slip_m`: as of `Carried`.
    """

    evidence: Evidence
    path_m: Floats
    sigma_m: Floats
    bound_m: Floats
    slip_m: Floats
    cross_m: Floats
    up_m: Floats
    smoothed: bool = False


@dataclass(frozen=True)
class Samples:
    """A reference stream at the instants of the positions: straight lines between its samples.

    `apart_s`: how far apart the samples around are.
    """

    path_m: Floats
    sigma_m: Floats
    cross_m: Floats
    up_m: Floats
    apart_s: Floats

    @classmethod
    def at(cls, at_ns: Ints, reference: pl.DataFrame) -> Samples:
        stamps = times_ns(reference)
        origin = stamps[0]
        x, at = (stamps - origin) / NS_PER_S, (at_ns - origin) / NS_PER_S
        gap = linking_gap_s(nominal_period_s(stamps))

        def column(name: str) -> Floats:
            return interpolate_known(at, x, floats(reference, name), gap)

        known = x[np.isfinite(floats(reference, "path_m"))]
        right = np.searchsorted(known, at, side="left")
        inside = (right > 0) & (right < known.size)
        apart = np.zeros(at.size)
        apart[inside] = known[right[inside]] - known[right[inside] - 1]
        sigma = np.nan_to_num(column("sigma_m"))
        return cls(column("path_m"), sigma, column("cross_track_m"), column("vertical_m"), apart)


def dense_rung(samples: Samples) -> Rung:
    """Where the samples are near enough to each other for a straight line."""
    near = np.where(samples.apart_s <= _STRAIGHT_S, samples.path_m, np.nan)
    nothing = np.zeros(near.size)
    return Rung(Evidence.REFERENCE, near, samples.sigma_m, nothing, nothing, samples.cross_m, samples.up_m)


def sparse_rungs(
    samples: Samples, reference: pl.DataFrame, travel: Travel, since_m: Floats, lds: LdsConfig
) -> list[Rung]:
    """Where they are not: carried on by the odometer, else a straight line and how far off it a train may be.

    A straight line alone is 14 m wrong half-way through 15 s in which a train brakes by 0.5 m/s2.
    """
    between = np.isfinite(samples.path_m) & (samples.apart_s > _STRAIGHT_S)
    if not between.any():
        return []
    anchors = Anchors.of(times_ns(reference), floats(reference, "path_m"))
    known = np.nan_to_num(floats(reference, "sigma_m"))
    carried = carry(anchors, travel, travel.at_ns, lds, both_ways=True, anchor_sigma_m=float(np.median(known)))
    path = np.where(between, carried.path_m + since_m, np.nan)
    sigma = np.hypot(samples.sigma_m, carried.sigma_m)
    smallest = np.where(carried.backward, carried.confidence_m, np.minimum(3.0 * sigma, carried.confidence_m))
    bound = np.maximum(smallest, np.abs(carried.slip_m))
    by_odometer = Rung(Evidence.REFERENCE, path, sigma, bound, carried.slip_m, samples.cross_m, samples.up_m)
    off_m = _HARDEST_MPS2 / 8.0 * samples.apart_s**2
    line = np.where(between, samples.path_m, np.nan)
    nothing = np.zeros(line.size)
    straight = Rung(Evidence.REFERENCE, line, samples.sigma_m, off_m, nothing, samples.cross_m, samples.up_m)
    return [by_odometer, straight]
