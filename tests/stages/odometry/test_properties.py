"""What holds of any odometer: shifted in time, reversed, split into segments, and with noise of known size."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import Configuration, Vehicle
from tests.stages.alignment.straight import odometer_of, odometry_from

NS = 10**9
PERIOD_S = 0.1
speeds = st.lists(st.floats(-30.0, 30.0), min_size=2, max_size=6)


def motion(phases_mps, period_s=PERIOD_S):
    """Times [s] and distances [m] of a train that goes from one speed to the next in 10 s and holds it for 20 s."""
    knots_s = np.cumsum([0.0, *([20.0, 10.0] * len(phases_mps))])[:-1]
    t = np.arange(0.0, knots_s[-1], period_s)
    speed = np.interp(t, knots_s, np.repeat(phases_mps, 2))
    return t, np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * period_s)])


def at_ns(t_s):
    return np.round(np.asarray(t_s) * NS).astype(np.int64)


def answers(odometry, t_ns):
    return {
        name: getattr(odometry, name)(t_ns)
        for name in (*("known_at", "distance_at", "travelled_at", "moving_s_at", "moved"),)
    }


def probes(t):
    return np.sort(np.concatenate([at_ns(t[::7]), at_ns(t[3::11] + 0.037), at_ns([-5.0, t[-1] + 5.0])]))


@settings(deadline=None, max_examples=16)
@given(speeds, st.integers(-(10**17), 10**17))
def test_answers_move_with_the_clock(phases, shift_ns):
    t, way = motion(phases)
    stream = odometer_of(t, distance_m=way)
    later = stream.with_columns(t=(stream["t"].to_physical() + shift_ns).cast(stream["t"].dtype))
    plain, moved = odometry_from(stream), odometry_from(later)
    expected, found = answers(plain, probes(t)), answers(moved, probes(t) + shift_ns)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


@settings(deadline=None, max_examples=16)
@given(speeds)
def test_reversed_the_same_way_is_driven_the_other_way(phases):
    t, way = motion(phases)
    plain = odometry_from(odometer_of(t, distance_m=way))
    backwards = odometry_from(odometer_of(t, distance_m=-way))
    turned, expected, found = (answers(one, probes(t)) for one in (plain.growing_along_path(-1), plain, backwards))
    for name, values in expected.items():
        sign = -1 if name == "distance_at" else 1
        for other in (turned, found):
            np.testing.assert_allclose(sign * other[name], values, atol=1e-9, err_msg=name)


@settings(deadline=None, max_examples=16)
@given(speeds, st.floats(0.2, 0.8))
def test_a_slip_is_in_doubt_and_nothing_else_changes(phases, share):
    t, way = motion(phases)
    slips = np.arange(t.size) == int(share * t.size)
    plain = odometry_from(odometer_of(t, distance_m=way))
    split = odometry_from(odometer_of(t, distance_m=way, slip=slips))
    at = probes(t)
    lost = (at > at_ns(t[slips] - PERIOD_S)) & (at < at_ns(t[slips] + PERIOD_S))
    assert (split.known_at(at) == (plain.known_at(at) & ~lost)).all()
    in_doubt = split.cumulative_doubt_m(split.seconds(at)) > 0.0
    assert (in_doubt[~lost] == (at[~lost] >= at_ns(t[slips]))).all()
    np.testing.assert_array_equal(split.distance_at(at)[~lost], plain.distance_at(at)[~lost])
    across = split.distance_and_variance(at[:1] + 6 * NS, at[-1:] - 6 * NS)
    assert (across.bound_m > 0.0).all()
    assert (plain.distance_and_variance(at[:1] + 6 * NS, at[-1:] - 6 * NS).bound_m == 0.0).all()


@settings(deadline=None, max_examples=16)
@given(speeds)
def test_ways_add_up_and_are_no_shorter_than_the_distance(phases):
    t, way = motion(phases)
    odometry = odometry_from(odometer_of(t, distance_m=way))
    at = at_ns(t)
    travelled, moving_s = odometry.travelled_at(at), odometry.moving_s_at(at)
    assert (np.diff(travelled) >= -1e-9).all()
    assert (np.diff(moving_s) >= 0.0).all()
    assert (np.diff(moving_s) <= np.diff(t) + 1e-9).all()
    assert (travelled >= np.abs(odometry.distance_at(at) - odometry.distance_at(at[:1])) - 1e-6).all()
    first, second, both = (
        odometry.distance_and_variance(at[begin : begin + 1], at[end : end + 1]).distance_m
        for begin, end in ((0, 100), (100, 200), (0, 200))
    )
    np.testing.assert_allclose(first + second, both, atol=1e-9)


def test_a_journey_there_and_back_by_hand():
    """10 m/s for 20 s, 60 s of standing, 10 m/s back for 10 s."""
    t = np.arange(0.0, 90.05, 0.1)
    way = 10.0 * np.minimum(t, 20.0) - 10.0 * np.maximum(t - 80.0, 0.0)
    odometry = odometry_from(odometer_of(t, distance_m=way))
    at = at_ns([0.0, 10.0, 20.0, 50.0, 80.0, 85.0, 90.0])
    np.testing.assert_allclose(odometry.distance_at(at), [0.0, 100.0, 200.0, 200.0, 200.0, 150.0, 100.0], atol=1e-6)
    np.testing.assert_allclose(odometry.travelled_at(at), [0.0, 100.0, 200.0, 200.0, 200.0, 250.0, 300.0], atol=1e-6)
    np.testing.assert_allclose(odometry.moving_s_at(at), [0.0, 10.0, 20.0, 20.5, 20.5, 26.0, 31.0], atol=0.6)
    assert odometry.moved(at).tolist() == [True, True, False, False, True, True]


@pytest.mark.parametrize("counter_m", [0.0, 0.5])
@pytest.mark.parametrize("moving", [True, False])
def test_the_variance_of_a_way_is_what_it_scatters_by(moving, counter_m):
    """200 odometers whose wheel slips by 0.05 m per root second while it turns, and whose counter rounds down."""
    rng = np.random.default_rng(8)
    white_mps, scale, scale_sigma = 0.05, 1.002, 5e-4
    t = np.arange(0.0, 120.0, 0.1)
    speed = np.where(t < 90.0, 20.0, 0.0) * moving
    begin, end = at_ns([5.03]), at_ns([115.0])
    vehicle = Vehicle(odometer_scale=scale, odometer_scale_sigma=scale_sigma)
    standardised = []
    # One that stands has no scatter: it differs from others in where its rows begin alone.
    for _ in range(200 if moving else 20):
        steps = speed * 0.1 / (scale + rng.normal(0.0, scale_sigma)) + rng.normal(0.0, 1.0, t.size) * (
            white_mps * np.sqrt(0.1) * (speed > 0.0)
        )
        rows = 7.3 + rng.uniform() + np.cumsum(steps)
        read = np.floor(rows / counter_m) * counter_m if counter_m else rows
        found = odometry_from(odometer_of(t, distance_m=read), vehicle).distance_and_variance(begin, end)
        true = np.interp(115.0, t, np.cumsum(speed * 0.1)) - np.interp(5.03, t, np.cumsum(speed * 0.1))
        standardised.append((found.distance_m[0] - true) / np.sqrt(max(found.variance_m2[0], 1e-18)))
    if moving:
        assert np.mean(standardised) == pytest.approx(0.0, abs=0.2)
        assert np.std(standardised) == pytest.approx(1.0, abs=0.12)
    else:
        assert np.max(np.abs(standardised)) == 0.0


@pytest.mark.parametrize("period_s", [0.05, 0.1, 1.0])
def test_noise_of_a_standing_odometer_is_neither_way_nor_movement(period_s):
    """Ten minutes of standing at any rate: a walk of 0.05 m per root second, or rows that scatter by 0.2 m."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 800.0, period_s)
    driven = 20.0 * np.minimum(t, 200.0)
    walk = np.cumsum(rng.normal(0.0, 0.05 * np.sqrt(period_s), t.size))
    for noise, most_m in ((walk, 6.0), (rng.normal(0.0, 0.2, t.size), 6.0)):
        odometry = odometry_from(odometer_of(t, distance_m=driven + noise))
        assert odometry.travelled_at(at_ns([799.0]))[0] == pytest.approx(4000.0, abs=most_m)
        assert odometry.moving_s_at(at_ns([799.0]))[0] == pytest.approx(200.0, abs=2.5)


@pytest.mark.parametrize(("counter_m", "speed_mps"), [(0.5, 0.5), (2.0, 1.0), (5.0, 3.0)])
def test_between_two_counts_a_slow_train_moves_on(counter_m, speed_mps):
    t = np.arange(0.0, 900.0, 0.1)
    way = 10.0 * np.minimum(t, 100.0) + speed_mps * np.clip(t - 100.0, 0.0, 400.0)
    odometry = odometry_from(odometer_of(t, distance_m=np.floor(way / counter_m) * counter_m))
    end = at_ns([890.0])
    assert odometry.moving_s_at(end)[0] == pytest.approx(500.0, rel=0.05)
    assert odometry.travelled_at(end)[0] == pytest.approx(1000.0 + 400.0 * speed_mps, abs=2.0 * counter_m)


def test_the_dead_band_is_the_configured_one():
    t = np.arange(0.0, 100.0, 0.1)
    stream = odometer_of(t, distance_m=0.5 * t)
    for deadband_mps, moves in ((0.3, True), (0.6, False)):
        config = Configuration.model_validate({"matching": {"deadband_mps": deadband_mps}})
        odometry = odometry_from(stream, config=config)
        assert odometry.moved(at_ns([10.0, 20.0])).tolist() == [moves]
        assert odometry.travelled_at(at_ns([100.0]))[0] == pytest.approx(49.95)
