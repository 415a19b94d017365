"""The rule of recovery by hand (DOMAIN section 4), as the LDS and the learning of scale and latency ask it."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest

from pipeline.stages.odometry.bound import RecoveryRule
from schemas.config import Configuration, HazardConfig

RULE = RecoveryRule(Configuration())
K_T = 5.3267238


@pytest.mark.parametrize(
    ("positions_m2", "elapsed_s", "travelled_m", "sigma_scale", "bound_m"),
    [
        (2.0, 0.0, 0.0, 0.0, K_T * sqrt(2.0)),
        (2.0, 100.0, 0.0, 0.0, K_T * sqrt(2.0 + 0.05**2 * 100.0)),
        (2.0, 100.0, 1000.0, 1e-3, K_T * sqrt(2.0 + 0.25 + 1.0)),
        (2.0, 100.0, -1000.0, 1e-3, K_T * sqrt(2.0 + 0.25 + 1.0)),
        (2.0, 100.0, 1500.0, 1e-3, 10.0),
        (8.0, 0.0, 0.0, 0.0, 10.0),
        (0.0, 0.0, 0.0, 0.0, 0.0),
    ],
)
def test_the_bound_is_of_both_positions_and_the_odometer_up_to_half_the_failure_limit(
    positions_m2: float, elapsed_s: float, travelled_m: float, sigma_scale: float, bound_m: float
) -> None:
    variance_m2 = RULE.variance_m2(positions_m2, elapsed_s, travelled_m, sigma_scale)
    assert float(RULE.bound_m(variance_m2)) == pytest.approx(bound_m)


def test_the_failure_limit_and_the_recovery_time_are_those_of_the_configuration() -> None:
    rule = RecoveryRule(Configuration(hazards=HazardConfig(failure_limit_m=6.0)))
    assert float(rule.bound_m(4.0)) == 3.0
    assert RULE.recovery_is_over(np.array([0.0, 29.9, 30.0, 31.0])).tolist() == [False, False, True, True]
