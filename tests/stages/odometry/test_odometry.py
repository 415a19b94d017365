"""The odometer as a function of time: hand-worked tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.stages.odometry.bound import LOST_M, is_lost
from pipeline.stages.odometry.driven import turns_of
from pipeline.stages.odometry.odometry import odometry_of as odometry_of_stream
from pipeline.stages.odometry.polarity import grows_with, polarity
from pipeline.stages.odometry.quantisation import Noise, QuantisationNoise
from schemas.arrays import NS_PER_S
from schemas.config import Configuration, Vehicle
from tests.stages.alignment.straight import odometer_of, odometry_from


def test_distance_is_interpolated_and_never_extrapolated():
    odometry = odometry_from(odometer_of([0.0, 1.0, 2.0], distance_m=[100.0, 110.0, 121.0]))
    at = np.array([-0.1, 0.0, 0.5, 1.5, 2.0, 2.1])
    assert odometry.known_at_s(at).tolist() == [False, True, True, True, True, False]
    np.testing.assert_allclose(odometry.distance_at_s(at)[1:5], [0.0, 5.0, 15.5, 21.0])


def test_figures_at_the_begin_of_a_step_are_looked_up_where_the_latency_changed():
    odometry = odometry_from(odometer_of(np.arange(20.0), distance_m=np.arange(20.0) ** 2))
    t_ns = odometry.epoch_ns + np.arange(2, 12) * NS_PER_S
    scale = np.linspace(0.99, 1.01, 10)
    latency_s = np.array([0.2, 0.2, 0.2, 0.3, 0.3, 0.1, 0.1, 0.1, 0.0, 0.0])
    found = odometry.increments(t_ns, scale, latency_s)
    now_s = odometry.seconds(t_ns) - latency_s
    before_s = np.concatenate([now_s[:1], odometry.seconds(t_ns)[:-1] - latency_s[1:]])
    moved_m = odometry.distance_at_s(now_s) - odometry.distance_at_s(before_s)
    faster_mps = odometry.speed_at_s(now_s) - odometry.speed_at_s(before_s)
    np.testing.assert_array_equal(found.distance_m, scale * moved_m)
    np.testing.assert_array_equal(found.speed_mps, scale * faster_mps)
    begin_m, end_m = (
        odometry.travelled_at(odometry.epoch_ns + np.round(at_s * NS_PER_S).astype(np.int64))
        for at_s in (before_s, now_s)
    )
    np.testing.assert_allclose(odometry.driven(t_ns, scale, latency_s), scale * (end_m - begin_m), atol=1e-6)


def test_rows_scatter_by_their_step_and_by_stamps_with_the_square_of_the_speed():
    """20 cm at a stand, and 50 ms: 10 cm at 2 m/s, 20 cm at 4 m/s."""
    noise = QuantisationNoise(still_m2=0.04, moving_s2=0.0025)
    np.testing.assert_allclose(noise.variance_m2(np.array([0.0, 2.0, -4.0])), [0.04, 0.05, 0.08])


def test_speed_alone_is_integrated_and_guessed_over_a_pause():
    frame = odometer_of([0.0, 0.5, 1.0, 5.0, 5.5], speed_mps=[10.0, 12.0, 10.0, 10.0, 10.0])
    odometry = odometry_from(frame)
    np.testing.assert_allclose(odometry.distance_m, [0.0, 5.5, 11.0, 51.0, 56.0])
    assert odometry.doubt_m == pytest.approx([0.0, 0.0, 0.0, 7.2, 7.2])
    assert odometry.known_at_s(np.array([0.7, 1.0, 3.0, 5.0])).tolist() == [True, True, False, True]


@pytest.mark.parametrize(
    ("before_mps", "after_mps", "pause_s", "travelled_m", "doubt_m"),
    [
        (0.0, 0.0, 45.0, 0.0, 0.0),
        # From rest in a period of 0.5 s, half of which is sure.
        (0.0, 0.8, 45.0, 0.2, 0.2),
        (-0.8, 0.0, 45.0, -0.2, 0.2),
        # It may have crept on: 0.2 m/s for 45 s.
        (0.2, 0.6, 45.0, 0.2, 9.2),
        # More than 0.3 + 1.8 x 0.5 m/s is not reached in a period; nor does a train stand at 0.4 m/s: mean speed.
        (0.0, 1.3, 4.0, 2.6, 7.2),
        (0.4, 0.4, 4.0, 1.6, 7.2),
    ],
)
def test_a_logger_that_writes_nothing_at_a_stand_leaves_little_in_doubt(
    before_mps, after_mps, pause_s, travelled_m, doubt_m
) -> None:
    t = [0.0, 0.5, 1.0, 1.5, 1.5 + pause_s, 2.0 + pause_s, 2.5 + pause_s]
    odometry = odometry_from(odometer_of(t, speed_mps=[*[before_mps] * 4, *[after_mps] * 3]))
    assert np.diff(odometry.distance_m)[3] == pytest.approx(travelled_m)
    assert np.diff(odometry.doubt_m) == pytest.approx([0.0, 0.0, 0.0, doubt_m, 0.0, 0.0])


def test_a_cumulative_distance_carries_over_a_pause_but_not_inside_it():
    frame = odometer_of([0.0, 0.5, 1.0, 5.0, 5.5], distance_m=[0.0, 5.0, 10.0, 50.0, 55.0])
    odometry = odometry_from(frame)
    assert (odometry.doubt_m == 0.0).all()
    assert odometry.known_at_s(np.array([1.0, 3.0, 5.0])).tolist() == [True, False, True]
    np.testing.assert_allclose(odometry.distance_at_s(np.array([5.0])), 50.0)


def test_distance_and_speed_by_turns_are_carried_between_their_own_rows():
    nan = np.nan
    t = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0]
    distance = [0.0, nan, 10.0, nan, 22.0, nan, 36.0]
    speed = [nan, 11.0, nan, 12.0, nan, 13.0, nan]
    odometry = odometry_from(odometer_of(t, distance_m=distance, speed_mps=speed))
    np.testing.assert_allclose(odometry.distance_m, [0.0, 5.0, 10.0, 16.0, 22.0, 29.0, 36.0])
    assert odometry.known_at_s(np.array(t)).all()


def test_where_distance_and_speed_by_turns_pause_the_way_is_lost():
    """The counter's next row stands after a speed's: nobody knows whether it went on counting in between."""
    nan = np.nan
    t = [0.0, 0.5, 1.0, 1.5, 8.0, 8.5, 9.0]
    distance = [0.0, nan, 10.0, nan, nan, 80.0, nan]
    speed = [nan, 10.0, nan, 10.0, 12.0, nan, 12.0]
    odometry = odometry_from(odometer_of(t, distance_m=distance, speed_mps=speed))
    assert odometry.doubt_m[3] < odometry.doubt_m[4]
    assert odometry.known_at_s(np.array([1.5, 4.0, 8.0])).tolist() == [True, False, True]


def test_rows_too_far_apart_are_not_carried():
    nan = np.nan
    frame = odometer_of(np.arange(5.0), distance_m=[0.0, nan, nan, nan, 40.0], speed_mps=[nan, 10.0, nan, 12.0, nan])
    odometry = odometry_from(frame)
    assert odometry.known_at_s(np.array([0.5, 1.5, 2.5, 3.5])).tolist() == [False, True, True, False]
    np.testing.assert_allclose(np.diff(odometry.distance_m)[1:3], [10.5, 11.5])


def test_a_missing_distance_beside_a_speed_is_driven():
    """The counter was set to zero in the second that it does not report: no way was run backwards."""
    frame = odometer_of([0.0, 0.5, 1.0, 1.5, 2.0], distance_m=[100.0, 105.0, np.nan, 0.0, 5.0], speed_mps=[10.0] * 5)
    np.testing.assert_allclose(odometry_from(frame).distance_m, [0.0, 5.0, 10.0, 15.0, 20.0])


def test_reported_slip_is_no_distance():
    frame = odometer_of([0.0, 0.5, 1.0, 1.5], distance_m=[0.0, 5.0, 20.0, 25.0], slip=[False, False, True, False])
    odometry = odometry_from(frame)
    assert odometry.known_at_s(np.array([0.2, 0.7, 1.2, 1.5])).tolist() == [True, False, False, True]
    assert odometry.doubt_m[0] < odometry.doubt_m[3]


def test_a_noisier_odometer_than_configured_counts():
    frame = odometer_of([0.0, 0.5, 1.0], speed_mps=[10.0, 10.0, 10.0]).with_columns(sigma_speed_mps=0.4)
    assert odometry_from(frame).noise.white_m2_per_s == pytest.approx(0.4**2 * 0.5)
    assert odometry_from(frame.with_columns(sigma_speed_mps=0.01)).noise.white_m2_per_s == 0.05**2


@pytest.mark.parametrize(
    ("reads", "expected"), [([0.0, 15.0, 30.0], 1), ([0.0, -15.0, -30.0], -1), ([0.0, 0.0, 0.0], 1)]
)
def test_polarity_comes_from_the_first_twenty_metres(reads, expected):
    odometry = odometry_from(odometer_of([0.0, 1.0, 2.0], distance_m=reads))
    t = np.array([0.0, 1.0, 2.0])
    assert polarity(odometry, np.round(1e9 * t).astype(np.int64), np.array([500.0, 515.0, 530.0]), 20.0) == expected


def test_speed_is_the_mean_over_the_second_before():
    odometry = odometry_from(odometer_of([0.0, 1.0, 2.0], distance_m=[0.0, 10.0, 22.0]))
    np.testing.assert_allclose(odometry.speed_at_s(np.array([0.5, 1.0, 2.0, 1.5])), [10.0, 10.0, 12.0, 11.0])


def test_a_leap_in_the_first_metres_does_not_turn_the_odometer_round():
    t = np.arange(0.0, 10.0, 0.1)
    odometry = odometry_from(odometer_of(t, distance_m=5.0 * t))
    path = 5.0 * t - np.where((t > 3.9) & (t < 4.2), 300.0, 0.0)
    assert polarity(odometry, np.round(1e9 * t).astype(np.int64), path, 20.0) == 1


@pytest.mark.parametrize("counts", [1.0, -1.0])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_the_first_movement_went_as_positions_say_along_which_the_odometer_says_how_far(way, counts):
    """Forwards or backwards, counted up or down; a leap just when 20 m are covered misleads positions alone."""
    t = np.arange(0.0, 10.0, 0.1)
    path = 500.0 + way * (5.0 * t - np.where((t > 3.95) & (t < 4.25), 300.0, 0.0))
    t_ns, odometry = (
        np.round(1e9 * t).astype(np.int64),
        odometry_from(odometer_of(t, distance_m=counts * way * 5.0 * t)),
    )
    assert grows_with(path, t_ns, odometry, 20.0) == (way > 0.0)
    assert grows_with(path, t_ns, None, 20.0) == (way < 0.0)


@pytest.mark.parametrize("speed", [None, 10.0])
@pytest.mark.parametrize(
    ("reads", "leap"),
    [
        ([1000.0, 1005.0, 1010.0, 0.0, 5.0, 10.0], 3),  # reset
        ([4085.0, 4090.0, 4095.0, 4.0, 9.0, 14.0], 3),  # run over
        ([0.0, -5.0, -10.0, 985.0, 980.0, 975.0], 3),  # reset in reverse
    ],
)
def test_a_counter_that_is_reset_or_runs_over_drives_nowhere(reads, leap, speed):
    forth = 1.0 if reads[1] > reads[0] else -1.0
    t = 0.5 * np.arange(6.0)
    speeds = None if speed is None else [forth * speed] * 6
    odometry = odometry_from(odometer_of(t, distance_m=reads, speed_mps=speeds))
    known = odometry.known_at_s(t[:-1] + 0.25)
    np.testing.assert_allclose(odometry.distance_m, forth * 5.0 * np.arange(6.0))
    assert (odometry.doubt_m == 0.0).all()
    assert known.all()
    assert odometry.leaps_ns == (int(1e9 * t[leap]),)


def test_a_reset_at_the_end_or_between_rows_far_apart_loses_the_way():
    """No step after it, or 2 s between rows, in which braking at 1.8 m/s^2 changes the way by 1.8 m."""
    at_the_end = odometry_from(odometer_of(0.5 * np.arange(4.0), distance_m=[1000.0, 1005.0, 1010.0, 0.0]))
    far_apart = odometry_from(odometer_of(2.0 * np.arange(5.0), distance_m=[1000.0, 1020.0, 1040.0, 0.0, 20.0]))
    assert at_the_end.doubt_m.tolist() == [0.0, 0.0, 0.0, LOST_M]
    assert far_apart.cumulative_doubt_m(2.0 * np.arange(5.0)).tolist() == [0.0, 0.0, 0.0, LOST_M, LOST_M]


@pytest.mark.parametrize(("reset_m", "step_s"), [(138.0, 1.0), (39.0, 1.0), (30.0, 0.1), (9.0, 0.1)])
@pytest.mark.parametrize("speed", [None, 20.0])
def test_a_counter_that_is_reset_by_little_turns_no_train_round(reset_m, step_s, speed):
    """20 m/s throughout; a reset by 138 m at 1 Hz was a speed of -118 m/s."""
    t = step_s * np.arange(60.0)
    reads = reset_m + 20.0 * t - np.where(np.arange(60) >= 30, reset_m, 0.0)
    odometry = odometry_from(odometer_of(t, distance_m=reads, speed_mps=None if speed is None else np.full(60, speed)))
    np.testing.assert_allclose(odometry.distance_m, 20.0 * t, atol=1e-9)
    assert odometry.doubt_m[-1] == 0.0
    assert len(odometry.leaps_ns) == 1


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_resets_one_after_the_other_count_nothing(turned: float) -> None:
    """15 m a row at 10 m/s: the counter begins anew in the 4th, 5th and 6th step, and shows 6, 4 and 9 m after each."""
    t = 1.5 * np.arange(10.0)
    reads = np.array([955.0, 970.0, 985.0, 1000.0, 6.0, 4.0, 9.0, 24.0, 39.0, 54.0])
    odometry = odometry_from(odometer_of(t, distance_m=turned * reads))
    assert (odometry.doubt_m / LOST_M).tolist() == [0, 0, 0, 0, 1, 2, 3, 3, 3, 3]
    np.testing.assert_allclose(np.diff(odometry.distance_m)[[0, 1, 2, 6, 7, 8]], turned * 15.0)


def test_two_wrong_rows_are_no_resets() -> None:
    """The rows at 4 and 5 s are 60 and 30 m short: the ways over them sum up to what the train drives."""
    reads = 20.0 * np.arange(12.0) - 60.0 * (np.arange(12) == 4) - 30.0 * (np.arange(12) == 5)
    assert odometry_from(odometer_of(np.arange(12.0), distance_m=reads)).leaps_ns == ()


def test_a_wrong_row_at_a_stand_is_no_reset() -> None:
    """41 m too far at 3 s; moves of some metres from 11 s on are like that of 41 m, but for as long a time."""
    reads = [0.0, 0.0, 0.0, 41.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 3.0, 5.0, 9.0, 13.0, 19.0]
    odometry = odometry_from(odometer_of(np.arange(17.0), distance_m=reads))
    assert odometry.leaps_ns == ()
    assert (odometry.doubt_m == 0.0).all()


def test_a_bridged_reset_has_its_own_noise() -> None:
    """At 1 Hz: 1.8 / 4 + 1.8 x 1.5 / 2 = 1.8 m at most, 0.6 m one sigma, beside 0.05 m a second."""
    t = np.arange(20.0)
    odometry = odometry_from(odometer_of(t, distance_m=500.0 + 20.0 * t - np.where(t >= 10.0, 600.0, 0.0)))
    expected = np.where(t == 10.0, 0.05**2 + 0.6**2, 0.05**2)
    np.testing.assert_allclose(odometry.read(t).white_m2_per_s, expected)


def test_reversing_noise_and_single_rows_are_no_reset():
    """At 1 Hz: a train that runs to and fro in 4 s, a counter of whole 5 m at an edge, a row 30 m ahead or behind."""
    to_and_fro = np.abs(np.arange(20.0) % 8.0 - 4.0) * 3.0
    edge = np.arange(20) % 2 * 5.0
    ahead, behind = (20.0 * np.arange(20.0) + size_m * (np.arange(20) == 9) for size_m in (30.0, -30.0))
    for reads in (to_and_fro, edge, ahead, behind):
        assert odometry_from(odometer_of(np.arange(20.0), distance_m=reads)).leaps_ns == ()


@pytest.mark.parametrize("speed", [None, "by turns", "always"])
def test_a_counter_that_is_reset_in_a_pause_loses_the_way(speed):
    t = np.concatenate([np.arange(0.0, 10.0, 0.5), np.arange(15.0, 25.0, 0.5)])
    reads = np.where(t < 12.0, 5000.0 + 10.0 * t, 10.0 * (t - 15.0))
    turns = np.arange(t.size) % 2 == 1
    speeds = np.full(t.size, 10.0) if speed else None
    if speed == "by turns":
        reads, speeds = np.where(turns, np.nan, reads), np.where(turns, speeds, np.nan)
    odometry = odometry_from(odometer_of(t, distance_m=reads, speed_mps=speeds))
    assert (odometry.doubt_m > 0.0).tolist() == [False] * 20 + [True] * 20
    assert np.diff(odometry.distance_m).min() >= 0.0


def test_a_spike_of_the_counter_is_passed_over():
    t = 0.5 * np.arange(7.0)
    reads = 0.2 * np.arange(7.0) ** 2
    for row in (1, 3, 5):
        spiked = 1e5 + reads + 500.0 * (np.arange(7) == row)  # of a counter that has run for 100 km
        odometry = odometry_from(odometer_of(t, distance_m=spiked))
        # Between its neighbours by a straight line; all other rows count.
        np.testing.assert_allclose(odometry.distance_m, reads + 0.2 * (np.arange(7) == row))
        assert (odometry.doubt_m == 0.0).all()
        assert odometry.known_at_s(t).all()


def test_what_a_fast_train_drives_over_gaps_and_bunched_stamps_is_no_leap():
    t = np.array([0.0, 0.5, 0.501, 0.502, 1.5, 21.5, 22.0])
    reads = np.array([0.0, 50.0, 60.0, 70.0, 150.0, 2150.0, 2200.0])
    odometry = odometry_from(odometer_of(t, distance_m=reads))
    np.testing.assert_allclose(odometry.distance_m, reads)
    assert (odometry.doubt_m == 0.0).all()


@pytest.mark.parametrize("with_speed", [False, True])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_between_rows_far_apart_the_way_follows_the_speeds(sign, with_speed):
    """A train that gathers 1 m/s2 from standstill, then runs on at 20 m/s, with a row every 4 s."""

    def way(at):
        return sign * np.where(at < 20.0, 0.5 * at**2, 200.0 + 20.0 * (at - 20.0))

    t = np.arange(0.0, 41.0, 4.0)
    speeds = sign * np.minimum(t, 20.0) if with_speed else None
    odometry = odometry_from(odometer_of(t, distance_m=way(t), speed_mps=speeds))
    at = np.arange(0.0, 40.0, 0.1)
    assert odometry.known_at_s(at).all()
    np.testing.assert_allclose(odometry.distance_at_s(t), way(t), atol=1e-9)
    off = np.abs(odometry.distance_at_s(at) - way(at)).max()
    straight = np.abs(np.interp(at, t, way(t)) - way(at)).max()
    assert straight == pytest.approx(2.0, abs=0.01)
    assert off < (0.05 if with_speed else 0.7)
    assert (np.diff(sign * odometry.distance_m) >= 0.0).all()


@pytest.mark.parametrize(
    "wrong",
    [lambda speeds: 3.6 * speeds, np.abs, np.zeros_like, np.negative, lambda speeds: np.full_like(speeds, 20.0)],
    ids=["km/h", "unsigned", "stuck at zero", "turned round", "stuck at speed"],
)
@pytest.mark.parametrize("period_s", [2.0, 5.0])
def test_speeds_that_contradict_the_way_fill_in_nothing(period_s, wrong):
    """A train that drives 300 m ahead, stands, and drives back."""
    fine = np.arange(0.0, 100.0, 0.01)
    speed = np.interp(
        fine, [0.0, 20.0, 30.0, 45.0, 60.0, 75.0, 85.0, 100.0], [0.0, 15.0, 15.0, 0.0, 0.0, -12.0, -12.0, 0.0]
    )
    way = np.cumsum(speed) * 0.01
    t = np.arange(0.0, 99.0, period_s)
    reads, speeds = np.interp(t, fine, way), np.interp(t, fine, speed)
    frames = (odometer_of(t, distance_m=reads, speed_mps=given) for given in (None, speeds, wrong(speeds)))
    inside = fine <= t[-1]
    without, right, misled = (np.abs(odometry_from(frame).distance_at_s(fine) - way)[inside].max() for frame in frames)
    straight = np.abs(np.interp(fine, t, reads) - way)[inside].max()
    assert right < without < straight
    assert misled < straight


@pytest.mark.parametrize("factor", [3.6, 0.0, -1.0])
def test_a_speed_of_another_unit_or_sign_tells_no_way_over_a_leap(factor):
    """Rows 0.5 s apart: the counter's own steps do, 5 m in place of 5.5. Rows 2 s apart: nothing does."""
    for period_s, counted_m in ((0.5, 5.0), (2.0, None)):
        t = period_s * np.arange(40.0)
        reads = np.where(np.arange(40) < 20, 1000.0 + 10.0 * t, 10.0 * (t - t[20]))
        for noisy in (1.1, factor):
            odometry = odometry_from(odometer_of(t, distance_m=reads, speed_mps=[10.0 * noisy] * 40))
            lost = noisy == factor and counted_m is None
            assert is_lost(odometry.doubt_m[-1:]).tolist() == [lost]
            if not lost:
                expected_m = counted_m if noisy == factor else 11.0 * period_s
                assert np.diff(odometry.distance_at_s(t[19:21])) == pytest.approx(expected_m)


def test_a_standstill_between_rows_far_apart_stays_one():
    odometry = odometry_from(
        odometer_of([0.0, 4.0, 8.0, 12.0], distance_m=[0.0, 20.0, 20.0, 40.0], speed_mps=[9.0, 1.0, 1.0, 9.0]),
    )
    np.testing.assert_allclose(odometry.distance_at_s(np.arange(4.0, 8.1, 0.25)), 20.0)


def test_nothing_is_filled_in_where_the_way_is_lost():
    frame = odometer_of(
        [0.0, 2.0, 4.0, 6.0, 26.0, 28.0], speed_mps=[10.0] * 6, slip=[False, False, True, False, False, False]
    )
    odometry = odometry_from(frame)
    assert odometry.known_at_s(np.array([1.0, 3.0, 5.0, 16.0, 27.0])).tolist() == [True, False, False, False, True]
    # Slip by a tenth of 20 m twice; a pause of 20 s by 1.8 / 4 x 400 m.
    assert odometry.cumulative_doubt_m(np.array([1.0, 27.0])) == pytest.approx([0.0, 4.0 + 180.0])


def test_the_variance_between_two_instants_has_the_noise_of_both_rows():
    """Rows off by 0.5 m at a stand: 0.25 m2 at each end; under way white noise of 0.05 m per second beside."""
    t_s = np.arange(0.0, 40.0, 0.5)
    still = odometry_from(odometer_of(t_s, distance_m=np.maximum(20.0 * (t_s - 20.0), 0.0)))
    noisy = replace(still, noise=Noise(still.noise.white_m2_per_s, QuantisationNoise(0.25, 0.0)))
    begin, end = (still.epoch_ns + np.array([round(at * 1e9) for at in pair]) for pair in ((2.0, 22.0), (18.0, 32.0)))
    standing, driving = noisy.distance_and_variance(begin, end).variance_m2
    assert standing == pytest.approx(2.0 * 0.25, abs=1e-9)
    assert driving == pytest.approx(2.0 * 0.25 + 10.0 * 0.05**2, abs=1e-6)


def test_turns_show_once_the_train_came_back_so_far():
    """Back by 4 m is none, by 6 m is one, and so is going on by 6 m: with 5 m."""
    distance_m = np.array([0.0, 10.0, 6.0, 20.0, 17.0, 14.0, 10.0, 13.0, 16.0])
    assert turns_of(distance_m, 5.0) == [(3, 5, -1), (6, 8, 1)]
    assert turns_of(np.array([0.0, -3.0, -6.0, -20.0]), 5.0) == [(0, 2, -1)]
    assert turns_of(np.zeros(0), 5.0) == []


def test_one_row_or_none_is_no_odometry() -> None:
    one_row = odometer_of(np.array([0.0]), np.array([5.0]), np.array([1.0]))
    assert odometry_of_stream(one_row, Vehicle(), Configuration()) is None
    assert odometry_of_stream(None, Vehicle(), Configuration()) is None
