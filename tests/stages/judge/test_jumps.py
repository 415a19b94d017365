"""Jumps of positions: what is skipped where nothing moves holds no jump."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.judge.failures import PositionChanges, largest_changes_m
from schemas.arrays import NS_PER_S, Bools
from schemas.config import HazardConfig

CONFIG = HazardConfig()


def _beyond(steps: PositionChanges, sign: float) -> Bools:
    """Position by position: the largest change from any position of the window before it is over the limit."""
    window_ns = round(CONFIG.jump_window_s * NS_PER_S)
    found = np.zeros(steps.t_ns.size, dtype=np.bool_)
    for row in range(1, steps.t_ns.size):
        largest_m = 0.0
        for earlier in range(row - 1, -1, -1):
            near = row - earlier == 1 or steps.t_ns[row] - steps.t_ns[earlier] <= window_ns
            if not (near and steps.linked[earlier + 1 : row + 1].all()):
                break
            change_m = float(steps.excess_m[row] - steps.excess_m[earlier])
            largest_m = change_m if abs(change_m) > abs(largest_m) else largest_m
        found[row] = sign * largest_m > CONFIG.limits.jump_m
    return found


@pytest.mark.parametrize("seed", range(12))
def test_the_largest_changes_over_the_limit_are_those_found_pair_by_pair(seed: int) -> None:
    draw = np.random.default_rng(seed)
    count = 240
    step_s = draw.choice([0.1, 0.3, 1.0, 8.0], count, p=[0.6, 0.2, 0.15, 0.05])
    leaps_m = np.where(draw.random(count) < 0.04, draw.normal(0.0, 3.0 * CONFIG.limits.jump_m, count), 0.0)
    change_m = np.where(draw.random(count) < 0.9, 0.1 * draw.normal(size=count), 0.0) + leaps_m
    t_ns = np.cumsum(np.round(step_s * NS_PER_S)).astype(np.int64)
    steps = PositionChanges(t_ns, np.cumsum(change_m), draw.random(count) < 0.98)
    largest_m = largest_changes_m(steps, CONFIG)
    assert (np.abs(largest_m) > CONFIG.limits.jump_m).any()
    for sign in (1.0, -1.0):
        np.testing.assert_array_equal(sign * largest_m > CONFIG.limits.jump_m, _beyond(steps, sign))
