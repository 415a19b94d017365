"""The way over slip as another odometer of the train counted it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.stages.odometry.bound import LEAST_DOUBT_M
from pipeline.stages.odometry.odometry import Odometry
from pipeline.stages.odometry.polarity import sense_of_ways
from schemas.arrays import Floats, Ints
from schemas.config import AlignConfig


def counted_over_slip(
    odometry: Odometry, others: Sequence[Odometry], orientation_m: float, config: AlignConfig
) -> Odometry:
    """The distance over each step of slip by the first other odometer that counted it.

    Slip stays reported, but only `other_way_share` of the way is in doubt. Others may count the other way round, as the
    first `orientation_m` show.
    """
    if not others or not odometry.slip.any():
        return odometry
    t_ns: Ints = odometry.epoch_ns + np.round(odometry.t_s * 1e9).astype(np.int64)
    step_m, doubt_m = np.diff(odometry.distance_m), np.diff(odometry.doubt_m)
    own_m = step_m.copy()
    open_steps = odometry.slip[1:] | odometry.slip[:-1]
    for odometer in others:
        counted_m = np.diff(odometer.distance_at(t_ns))
        counts = open_steps & np.isfinite(counted_m) & (np.diff(odometer.doubt_at_s(odometer.seconds(t_ns))) == 0.0)
        sense = sense_of_ways(own_m, counted_m, orientation_m)
        step_m[counts] = sense * counted_m[counts] / (odometry.scale or 1.0)
        doubt_m[counts] = np.maximum(config.other_way_share * np.abs(step_m[counts]), LEAST_DOUBT_M)
        open_steps &= ~counts
    return replace(odometry, distance_m=odometry.distance_m[0] + _sums(step_m), doubt_m=_sums(doubt_m))


def _sums(steps: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(steps)])
