"""The way over slip as another odometer of the train counted it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipeline.stages.odometry.bound import LEAST_DOUBT_M
from pipeline.stages.odometry.odometry import Odometry
from schemas.arrays import Floats, Ints, spans_of
from schemas.config import AlignConfig


def counted_over_slip(odometry: Odometry, others: Sequence[Odometry], config: AlignConfig) -> Odometry:
    """The distance over each slip by the first other odometer that counted throughout.

    Slip stays reported, but only `other_way_share` of the way is in doubt.
    """
    if not others or not odometry.slip.any():
        return odometry
    t_ns: Ints = odometry.epoch_ns + np.round(odometry.t_s * 1e9).astype(np.int64)
    step_m = np.diff(odometry.distance_m)
    doubt_m = np.diff(odometry.doubt_m)
    senses = [_sense(odometry, odometer, t_ns) for odometer in others]
    for first, last in spans_of(odometry.slip):
        part = slice(max(first - 1, 0), min(last + 1, t_ns.size - 1))
        at_ns = t_ns[part.start : part.stop + 1]
        for odometer, sense in zip(others, senses, strict=True):
            if odometer.known_at(at_ns).all() and np.ptp(odometer.doubt_at_s(odometer.seconds(at_ns))) == 0.0:
                step_m[part] = sense * np.diff(odometer.distance_at(at_ns)) / (odometry.scale or 1.0)
                doubt_m[part] = np.maximum(config.other_way_share * np.abs(step_m[part]), LEAST_DOUBT_M)
                break
    distance_m = odometry.distance_m[0] + _sums(step_m)
    return replace(odometry, distance_m=distance_m, doubt_m=_sums(doubt_m))


def _sense(odometry: Odometry, witness: Odometry, t_ns: Ints) -> float:
    """-1 where one of the two counts backwards: the sign of the steps' correlation."""
    products = np.diff(odometry.distance_m) * np.diff(witness.distance_at_s(witness.seconds(t_ns)))
    return -1.0 if products.sum() < 0.0 else 1.0


def _sums(steps: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(steps)])
