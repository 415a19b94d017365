"""Slip and slide: where Doppler and position agree against the odometer, the Doppler velocity carries the truth.

An odometer that slips would otherwise make a healthy position look like a hazard (DOMAIN section 5, Suspect).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipeline.figures.bounds import SURE_SIGMAS
from pipeline.hazards.travel import Travel
from schemas.arrays import NS_PER_S, Bools, Floats, Ints

# A short slip shows over seconds, a slow one over a minute.
_WINDOWS_S = (2.0, 10.0, 60.0)
_LEAST_M = 2.0
# Longest step between epochs over which the mean of two velocities stands for the way.
_LONGEST_STEP_S = 2.0


@dataclass(frozen=True)
class Doppler:
    """GNSS velocity along growing path per epoch, NaN where there is none, and its sigma at 1 Hz [m/s]."""

    velocity_mps: Floats
    sigma_mps: float


def repaired_by_doppler(travel: Travel, position_m: Floats, doppler: Doppler, healthy_m: float) -> Travel:
    """The travel with the odometer's steps replaced by Doppler's where the odometer stands alone.

    `position_m`: path position by GNSS, NaN where there is none; `healthy_m`: by how much a healthy position may be
    wrong (DOMAIN section 5), and so stray from Doppler's way.
    """
    dt_s = np.diff(travel.at_ns) / NS_PER_S
    by_doppler = 0.5 * (doppler.velocity_mps[1:] + doppler.velocity_mps[:-1]) * dt_s
    by_odometer = np.diff(travel.distance_m)
    by_odometer[np.diff(travel.stretch) != 0] = np.nan
    known = np.isfinite(by_doppler) & np.isfinite(by_odometer) & (dt_s <= _LONGEST_STEP_S)
    if not known.any():
        return travel
    apart = np.where(known, by_doppler - by_odometer, 0.0)
    wrong: Bools = np.zeros(apart.size, dtype=np.bool_)
    white_m2_per_s = doppler.sigma_mps**2 + travel.white_m2_per_s
    for window_s in _WINDOWS_S:
        wrong |= _odometer_alone(travel, position_m, apart, white_m2_per_s, window_s, healthy_m)
    correction = np.concatenate(([0.0], np.cumsum(np.where(wrong & known, apart, 0.0))))
    return replace(travel, distance_m=travel.distance_m + correction)


def _odometer_alone(
    travel: Travel, position_m: Floats, apart: Floats, white_m2_per_s: Floats, window_s: float, healthy_m: float
) -> Bools:
    """Steps within windows over which Doppler minus odometer exceeds its noise and GNSS positions follow Doppler.

    `apart`: Doppler minus odometer per step [m]; `white_m2_per_s`: what both add to its variance in a second.
    """
    stamps = travel.at_ns
    begin = np.searchsorted(stamps, stamps - round(window_s * NS_PER_S), side="left")
    total = np.concatenate(([0.0], np.cumsum(apart)))
    slipped = total - total[begin]
    moved = travel.distance_m - travel.distance_m[begin]
    readings_m2 = travel.reading_m2 + travel.reading_m2[begin]
    noise = np.sqrt(white_m2_per_s * window_s + (travel.scale_sigma * moved) ** 2 + readings_m2)
    follows = position_m - position_m[begin] - moved
    with np.errstate(invalid="ignore"):
        found = (np.abs(slipped) > np.maximum(_LEAST_M, SURE_SIGMAS * noise)) & (
            np.abs(follows - slipped) < 0.5 * np.abs(slipped)
        )
    ends = np.flatnonzero(found)
    limit_m = np.maximum(healthy_m, 0.5 * np.abs(slipped[ends]))
    ends = ends[_keeps_to(position_m - travel.distance_m - total, begin[ends], ends, limit_m)]
    return _covered(begin[ends], ends, apart.size)


def _keeps_to(strayed_m: Floats, begins: Ints, ends: Ints, limit_m: Floats) -> Bools:
    """Windows in which position minus Doppler's way stays together.

    A position that leaps to where the track heads elsewhere is not followed by Doppler along that track, but the sum
    of the leap and of the wrong velocity comes by any value.
    """
    spans = (strayed_m[begin : end + 1] for begin, end in zip(begins.tolist(), ends.tolist(), strict=True))
    ranges = np.array([np.nanmax(span) - np.nanmin(span) for span in spans])
    kept: Bools = ranges <= limit_m
    return kept


def _covered(begins: Ints, ends: Ints, size: int) -> Bools:
    """Steps from each begin to its end; step k leads from epoch k to k + 1."""
    depth = np.zeros(size + 1, dtype=np.int64)
    np.add.at(depth, begins, 1)
    np.add.at(depth, ends, -1)
    return np.cumsum(depth)[:size] > 0
