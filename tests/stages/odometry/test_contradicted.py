"""Speeds that contradict the distance, worked by hand: a wheel that slides below the speeds of a radar."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.odometry import Odometry
from schemas.arrays import Floats, Ints
from tests.stages.alignment.straight import odometer_of, odometry_from

T_S = np.arange(0.0, 120.0, 0.1)
# From 60 s on the wheel slows down by 1.5 m/s^2 to half of 20 m/s, for 10 s, and back.
KNOTS_S, WHEEL_MPS = [0.0, 60.0, 66.7, 76.7, 83.4, 120.0], [20.0, 20.0, 10.0, 10.0, 20.0, 20.0]
MISSING_M = 10.0 * (6.7 + 10.0)


def sliding(speeds_mps: Floats, wheel_mps: Floats | None = None) -> Odometry:
    wheel_mps = np.interp(T_S, KNOTS_S, WHEEL_MPS) if wheel_mps is None else wheel_mps
    travelled_m = np.concatenate([[0.0], np.cumsum(0.05 * (wheel_mps[1:] + wheel_mps[:-1]))])
    return odometry_from(odometer_of(T_S, distance_m=travelled_m, speed_mps=speeds_mps))


def at_ns(odometry: Odometry, *at_s: float) -> Ints:
    return odometry.epoch_ns + np.array([round(1e9 * at) for at in at_s])


def test_a_wheel_that_slides_is_in_doubt_by_what_the_speeds_count_more() -> None:
    odometry = sliding(np.full(T_S.size, 20.0))
    begin_ns, end_ns, later_ns = at_ns(odometry, 50.0, 95.0, 115.0)
    way = odometry.distance_and_variance(begin_ns, np.array([end_ns]))
    assert abs(20.0 * 45.0 - way.distance_m[0]) == pytest.approx(MISSING_M, abs=0.5)
    assert way.bound_m[0] > MISSING_M
    assert np.isnan(odometry.distance_between(begin_ns, np.array([end_ns]))).all()
    assert odometry.distance_between(end_ns, np.array([later_ns]))[0] == pytest.approx(400.0)
    # The train itself learns of it once it is more than a fifth of the way and five metres: what it then knows of.
    begun = T_S[np.flatnonzero(np.diff(odometry.doubt_m) > 0.0)[0]]
    assert 62.0 < begun < 75.0
    assert 0.75 * MISSING_M < odometry.doubt_m[-1] <= MISSING_M


@pytest.mark.parametrize("factor", [3.6, -1.0, 0.0])
def test_speeds_of_another_unit_or_sign_contradict_nothing(factor: float) -> None:
    odometry = sliding(np.full(T_S.size, 20.0) * factor, wheel_mps=np.full(T_S.size, 20.0))
    assert odometry.doubt_m[-1] == 0.0
    assert odometry.bound is None


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_speeds_that_agree_leave_no_doubt(late_s: float) -> None:
    """A train that brakes and speeds up, by speeds off by 2 % and late."""
    mps = np.interp(T_S, [0.0, 30.0, 50.0, 60.0, 80.0, 120.0], [0.0, 30.0, 5.0, 5.0, 0.0, 40.0])
    odometry = sliding(1.02 * np.interp(T_S - late_s, T_S, mps), wheel_mps=mps)
    assert odometry.doubt_m[-1] == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_speeds_do_not_contradict_a_distance_that_is_read_with_noise(seed: int) -> None:
    """2 m of noise a row at 20 Hz, on a train that drives slowly and stands at times."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 400.0, 0.05)
    mps = np.interp(t_s, [0.0, 20.0, 60.0, 80.0, 100.0, 140.0, 400.0], [0.0, 12.0, 12.0, 0.0, 0.0, 16.0, 9.0])
    travelled_m = np.cumsum(mps) * 0.05 + rng.normal(0.0, 2.0, t_s.size)
    assert odometry_from(odometer_of(t_s, distance_m=travelled_m, speed_mps=mps)).doubt_m[-1] == 0.0


def test_what_is_known_of_it_does_not_depend_on_later_rows() -> None:
    speeds_mps = np.full(T_S.size, 20.0)
    whole = sliding(speeds_mps).doubt_m
    wheel_mps = np.interp(T_S, KNOTS_S, WHEEL_MPS)
    travelled_m = np.concatenate([[0.0], np.cumsum(0.05 * (wheel_mps[1:] + wheel_mps[:-1]))])
    for rows in (640, 700, 760, 800, 900):
        cut = odometry_from(odometer_of(T_S[:rows], distance_m=travelled_m[:rows], speed_mps=speeds_mps[:rows]))
        assert cut.doubt_m.tolist() == whole[:rows].tolist()
