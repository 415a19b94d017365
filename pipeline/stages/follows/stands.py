"""Whether odometer and positions err as one while the train stands."""

from __future__ import annotations

import numpy as np

from pipeline.stages.follows.steps import Steps, around_sum
from schemas.arrays import Bools, Floats, median, spans_of
from schemas.config import EvidenceConfig

# Steps of this length are compared; what lies so near to a movement is no stand [s].
_STEP_S = 1.0
_EDGE_S = 5.0


def correlated_at_stands(steps: Steps, config: EvidenceConfig) -> bool:
    """Whether steps of all stands together have r > `follows_correlation` and r sqrt(t / 2 s) > `follows_sigmas`.

    A step of a differenced position shares its middle with the next one: two seconds are one independent step.
    """
    pairs = [_seconds(steps, first, last) for first, last in spans_of(_standing(steps, config))]
    if not pairs:
        return False
    odometer_m, along_m, length_m = np.concatenate(pairs, axis=1)
    time_s = odometer_m.size * _STEP_S
    if time_s < config.follows_stand_s:
        return False
    return any(_tells(odometer_m, other_m, time_s, config) for other_m in (along_m, length_m))


def _standing(steps: Steps, config: EvidenceConfig) -> Bools:
    """Within stands, away from their ends, by the positions: an odometer of their steps without sign never stands."""
    reach = max(1, round(_EDGE_S / steps.period_s))
    least_m = config.follows_stand_mps * 2.0 * _EDGE_S
    still = steps.unbroken & ~steps.moving
    for moved_m in (steps.along_m, steps.across_m):
        still &= np.abs(around_sum(moved_m, reach)) <= least_m
    inside: Bools = around_sum(still.astype(np.float64), reach) > 2 * reach + 0.5
    return inside


def _seconds(steps: Steps, first: int, last: int) -> Floats:
    """Odometer, along, and length of the position's step, over each second of a stand, shape (3, seconds) [m]."""
    stride = max(1, round(_STEP_S / steps.period_s))
    count = (last + 1 - first) // stride
    part = slice(first, first + count * stride)
    odometer_m, along_m, across_m = (
        axis[part].reshape(count, stride).sum(axis=1) for axis in (steps.odometer_m, steps.along_m, steps.across_m)
    )
    return np.stack([odometer_m, along_m, np.hypot(along_m, across_m)])


def _tells(odometer_m: Floats, other_m: Floats, time_s: float, config: EvidenceConfig) -> bool:
    """Steps beyond four usual ones count as four: a train that creeps moves both, and its wheel is no copy."""
    first, second = (_usual(steps_m) for steps_m in (odometer_m, other_m))
    if not (first.any() and second.any()):
        return False
    r = float(first @ second) / float(np.sqrt((first @ first) * (second @ second)))
    # Lengths have no sign, and a counter may fall.
    return abs(r) > config.follows_correlation and abs(r) * np.sqrt(0.5 * time_s) > config.follows_sigmas


def _usual(steps_m: Floats) -> Floats:
    """About their mean, and none beyond four deviations (by the median); none at all where most are alike."""
    apart_m = steps_m - median(steps_m)
    sigma_m = median(np.abs(apart_m)) / 0.674490
    clipped = np.clip(apart_m, -4.0 * sigma_m, 4.0 * sigma_m)
    return np.asarray(clipped - clipped.mean())
