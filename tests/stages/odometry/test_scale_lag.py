"""Scale and lag by hand: ten ways of a train that speeds up and brakes, seen by a counter 2 % short and 0.4 s early."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.odometry.scale_lag import scale_and_lag

# At the counter's stamps: way of each window [m], change of speed from its begin to its end [m/s].
COUNTED_M = np.array([10.0, 20.0, 30.0, 40.0, 40.0, 40.0, 30.0, 20.0, 10.0, 5.0])
CHANGE_MPS = np.array([2.0, 2.0, 2.0, 0.0, 0.0, 0.0, -2.0, -2.0, -2.0, -1.0])
WAY_M = 1.02 * (COUNTED_M - 0.4 * CHANGE_MPS)


def equations(change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    columns = np.column_stack([COUNTED_M, -change])
    return columns.T @ columns, columns.T @ WAY_M


@pytest.mark.parametrize("assumed_s", [0.0, 5.0, -0.1])
def test_scale_and_lag_are_solved_together(assumed_s: float) -> None:
    found = scale_and_lag(*equations(CHANGE_MPS), assumed_s=assumed_s)
    assert found is not None
    assert (found.scale, found.lag_s) == (pytest.approx(1.02), pytest.approx(assumed_s + 0.4))


def test_sigmas_are_those_of_least_squares() -> None:
    """Ways and changes are hardly correlated here: sigma / |counted|, sigma / (scale |change|), to 1 %."""
    found = scale_and_lag(*equations(CHANGE_MPS), spread=0.5)
    assert found is not None
    assert found.scale_sigma == pytest.approx(0.5 / np.linalg.norm(COUNTED_M), rel=0.01)
    assert found.lag_sigma_s == pytest.approx(0.5 / 1.02 / np.linalg.norm(CHANGE_MPS), rel=0.01)


@pytest.mark.parametrize("change", [np.zeros(10), 0.1 * COUNTED_M])
def test_at_constant_speed_nothing_tells_the_lag(change: np.ndarray) -> None:
    assert scale_and_lag(*equations(change)) is None
