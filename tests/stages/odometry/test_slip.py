"""Slip by the odometer's own word: what it may have miscounted, and another odometer's count over it, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.odometry import counted_over_slip
from schemas.config import AlignConfig
from tests.stages.alignment.straight import odometer_of, odometry_from

T_S = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
COUNTED_M = [0.0, 10.0, 25.0, 40.0, 50.0, 60.0]
SLIPS = [False, False, True, False, False, False]


def test_a_tenth_of_the_way_into_and_out_of_slip_is_in_doubt() -> None:
    odometry = odometry_from(odometer_of(T_S, distance_m=COUNTED_M, slip=SLIPS))
    assert odometry.doubt_m == pytest.approx([0.0, 0.0, 1.5, 3.0, 3.0, 3.0])
    assert odometry.slips_at_s(np.array([1.0, 1.1, 2.9, 3.0])).tolist() == [False, True, True, False]


@pytest.mark.parametrize(("sigma_mps", "doubt_m"), [(0.18, None), (0.19, 3.0), (1.4, 3.0), (2.0, 4.0)])
def test_a_sigma_beyond_the_limit_is_slip_and_counts_where_it_is_more(sigma_mps: float, doubt_m: float | None) -> None:
    frame = odometer_of(T_S, distance_m=COUNTED_M)
    stated = [0.02, 0.02, sigma_mps, 0.02, 0.02, 0.02]
    odometry = odometry_from(frame.with_columns(sigma_speed_mps=np.array(stated)))
    assert odometry.slip.any() == (doubt_m is not None)
    assert odometry.doubt_m[-1] == pytest.approx(doubt_m or 0.0)


def test_a_pause_of_speeds_puts_the_way_in_doubt() -> None:
    """5 s at 10 m/s are 50 m, to 1.8 m/s^2 x (5 s)^2 / 4; slip before it by a tenth of the way: 5 m twice."""
    t_s = [0.0, 0.5, 1.0, 6.0, 6.5]
    odometry = odometry_from(odometer_of(t_s, speed_mps=[10.0] * 5, slip=[False, True, False, False, False]))
    assert odometry.distance_m == pytest.approx([0.0, 5.0, 10.0, 60.0, 65.0])
    assert odometry.doubt_m == pytest.approx([0.0, 0.5, 1.0, 12.25, 12.25])


def test_a_pause_of_a_counter_that_is_reset_loses_the_count() -> None:
    odometry = odometry_from(odometer_of([0.0, 0.5, 1.0, 6.0, 6.5], distance_m=[900.0, 905.0, 910.0, 0.0, 5.0]))
    assert odometry.doubt_m.tolist() == [0.0, 0.0, 0.0, 1e6, 1e6]


def test_a_locked_wheel_that_counts_nothing_is_in_doubt_all_the_same() -> None:
    """1 mm a step: less than anything measured, but no way over it is sure."""
    odometry = odometry_from(odometer_of(T_S, distance_m=[0.0, 4.0, 4.0, 4.0, 8.0, 12.0], slip=SLIPS))
    assert odometry.doubt_m == pytest.approx([0.0, 0.0, 1e-3, 2e-3, 2e-3, 2e-3])
    begin_ns, end_ns = odometry.epoch_ns + np.array([5, 45]) * 10**8
    assert np.isnan(odometry.distance_between(begin_ns, np.array([end_ns]))).all()


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_another_odometer_counts_over_slip(sense: float) -> None:
    one = odometry_from(odometer_of(T_S, distance_m=COUNTED_M, slip=SLIPS))
    other = odometry_from(odometer_of(T_S, distance_m=[sense * 11.0 * t for t in T_S]))
    found = counted_over_slip(one, [other], 20.0, AlignConfig())
    # The steps into slip and out of it are the other's 11 m each, with one percent in doubt.
    assert found.distance_m == pytest.approx([0.0, 10.0, 21.0, 32.0, 42.0, 52.0])
    assert found.doubt_m == pytest.approx([0.0, 0.0, 0.11, 0.22, 0.22, 0.22])
    assert found.slip.tolist() == SLIPS
    slips_too = odometry_from(odometer_of(T_S, distance_m=[11.0 * t for t in T_S], slip=SLIPS))
    assert counted_over_slip(one, [slips_too], 20.0, AlignConfig()).distance_m == pytest.approx(COUNTED_M)
