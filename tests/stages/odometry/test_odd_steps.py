"""Leaps, stalls and wrong rows of a counter, and healthy counters that have none; of random drives with truth."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.stages.odometry.bound import is_lost, odd_runs
from schemas.arrays import NS_PER_S
from schemas.config import AlignConfig
from tests.stages.alignment.straight import odometer_of, odometry_from
from tests.stages.odometry.drives import drive, recorded

RATES_HZ = (1, 2, 5, 10, 20)
HEALTHY = [("counts", 0.02), ("counts", 0.5), ("counts", 5.0), ("noise", 0.5), ("noise", 2.0), ("jitter", 0.03)]


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize(("kind", "size"), [*HEALTHY, ("bunched", 0.5)])
def test_a_healthy_counter_has_no_odd_step(kind, size, rate_hz) -> None:
    t, reads, _ = recorded(np.random.default_rng([rate_hz, int(100 * size)]), kind, size, rate_hz)
    found = odd_runs(t, reads, size if kind == "counts" else 0.0, AlignConfig())
    assert found.odd == []
    assert found.near == []


@pytest.mark.parametrize("rate_hz", RATES_HZ)
@pytest.mark.parametrize("set_m", [150.0, -60.0])
def test_a_counter_set_at_a_stand_did_not_drive(set_m, rate_hz) -> None:
    """20 m/s for 100 s, a stand of 60 s with the counter set in the middle, and on again."""
    t = np.arange(0.0, 300.0, 1.0 / rate_hz)
    speed = np.interp(t, [0.0, 20.0, 80.0, 100.0, 160.0, 180.0], [0.0, 20.0, 20.0, 0.0, 0.0, 20.0])
    true = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) / rate_hz)])
    odometry = odometry_from(odometer_of(t, distance_m=true + set_m * (t > 130.0)))
    assert len(odometry.leaps_ns) == 1
    np.testing.assert_allclose(odometry.distance_m, true, atol=0.01)


@pytest.mark.parametrize("stall_s", [1.3, 1.4, 1.6])
@pytest.mark.parametrize("rate_hz", [5, 10, 20])
def test_a_logger_that_stalls_neither_stands_nor_leaps(rate_hz, stall_s) -> None:
    """28 m/s: the rows repeat, and the next one has caught up."""
    t = np.arange(0.0, 120.0, 1.0 / rate_hz)
    true = 28.0 * t
    held = np.where((t >= 60.0) & (t < 60.0 + stall_s), 28.0 * 60.0, true)
    odometry = odometry_from(odometer_of(t, distance_m=held))
    assert odometry.leaps_ns == ()
    np.testing.assert_allclose(odometry.distance_m, true, atol=0.01)


@pytest.mark.parametrize("rate_hz", [5, 10, 20])
def test_short_stalls_at_low_speed_add_up_within_the_bound(rate_hz) -> None:
    """About 3.5 m/s: ten stalls of 1.2 s lose 4 m each, too little for a leap; all together they are twice the limit.

    Of each, braking and acceleration explain less than that.
    """
    t = np.arange(0.0, 400.0, 1.0 / rate_hz)
    true = 3.5 * t + np.sin(t / 6.0)
    missing = np.zeros(t.size)
    for at_s in np.arange(30.0, 330.0, 30.0):
        begin_m, end_m = np.interp([at_s, at_s + 1.2], t, true)
        missing += np.clip(true, begin_m, end_m) - begin_m
    odometry = odometry_from(odometer_of(t, distance_m=true - missing))
    at_ns = odometry.epoch_ns + np.array([20, 350]) * NS_PER_S
    way = odometry.distance_and_variance(at_ns[:1], at_ns[1:])
    assert odometry.leaps_ns == ()
    assert missing[-1] == pytest.approx(42.0, abs=1.0)
    assert missing[-1] <= way.bound_m[0] < missing[-1] + 10 * 4.0


def test_a_stall_that_loses_its_way_is_no_bridged_reset() -> None:
    """The counter counts on where it stopped: 36 m are missing, more than a second of braking tells."""
    t = np.arange(0.0, 120.0, 0.1)
    missing = 28.0 * np.clip(t - 60.0, 0.0, 1.3)
    odometry = odometry_from(odometer_of(t, distance_m=28.0 * t - missing))
    assert is_lost(np.diff(odometry.cumulative_doubt_m(np.array([59.0, 63.0])))).all()


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_what_is_bridged_or_interpolated_is_off_by_no_more_than_its_bound(rate_hz) -> None:
    """Five resets to anywhere in a random drive: the error of each way over a run that is not lost."""
    for seed in range(3):
        rng = np.random.default_rng([seed, rate_hz])
        fine, way = drive(rng)
        t = np.arange(0.0, 590.0, 1.0 / rate_hz)
        true = np.interp(t, fine, way)
        sets = np.sort(rng.choice(np.arange(20, t.size - 20), 5, replace=False))
        reads = true + sum(rng.uniform(-400.0, 400.0) * (np.arange(t.size) >= row) for row in sets)
        odometry = odometry_from(odometer_of(t, distance_m=reads))
        step_m = np.diff(odometry.distance_at_s(t))
        off_m = np.abs(step_m - np.diff(true))[np.diff(odometry.cumulative_doubt_m(t)) == 0.0]
        assert off_m.max() <= 5.0
        assert np.abs(np.diff(reads) - np.diff(true)).max() > 30.0
