"""Scale and latency known or learned causally: synthetic runs with the answer known before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from pipeline.stages.alignment.align import BEYOND_SPAN, align, odometer_at, speed_of_positions
from pipeline.stages.alignment.odometer_filter import stamp_jitter_s
from pipeline.stages.epochs.clock import periods_before_s
from pipeline.stages.epochs.verdicts import NO_ODOMETER
from pipeline.stages.odometry.quantisation import Noise, QuantisationNoise
from schemas.arrays import NS_PER_S
from schemas.config import Configuration, Vehicle, threshold_factor
from schemas.stages import AlignedEpochs, MatchedEpochs
from tests.arrays_of_table import arrays_of_table
from tests.frames import bank_over
from tests.stages.alignment.straight import (
    NO_NOISE,
    Straight,
    align_run,
    distance,
    epochs_of,
    odometer_of,
    odometry_from,
    run,
    times,
)

CONFIG = Configuration()
REAL = Straight(scale=1.004, latency_s=0.08)


def alarms(aligned):
    bank = bank_over(aligned, {}, CONFIG)
    return [k for k in range(aligned.height) if bank.failed(k)]


def seconds(aligned, epoch):
    return aligned["t"].dt.timestamp("ns")[epoch] * 1e-9


def test_threshold_factor_is_the_two_sided_quantile():
    assert threshold_factor(1e-7) == pytest.approx(5.3267, abs=5e-5)


@pytest.mark.parametrize("seed", range(5))
def test_a_clean_run_without_vehicle_file_raises_no_alarm_and_finds_the_scale(seed):
    aligned = align_run(*run(REAL, seed), Vehicle(), CONFIG)
    assert alarms(aligned) == []
    scale, scale_sigma, latency_s, latency_sigma_s = aligned.select(
        "odometer_scale", "scale_sigma", "latency_s", "latency_sigma_s"
    ).row(-1)
    assert scale == pytest.approx(1.004, abs=1e-3)
    assert abs(scale - 1.004) < 5 * scale_sigma
    assert abs(latency_s - 0.08) < 4 * latency_sigma_s


def test_constant_speed_tells_no_latency_and_the_filter_knows_it():
    cruising = Straight(duration_s=900.0, latency_s=0.1, cruise_s=2000.0)
    found = pl.concat(
        align_run(*run(cruising, seed), Vehicle(), CONFIG).select("latency_s", "latency_sigma_s")[-1]
        for seed in range(8)
    )
    away = (found["latency_s"] - 0.1) / found["latency_sigma_s"]
    assert float((away**2).mean() ** 0.5) < 1.5
    assert found["latency_sigma_s"].min() > 0.5 * CONFIG.align.latency_prior_sigma_s


@pytest.mark.parametrize(
    ("known", "expected"),
    [
        ({"odometer_scale": 1.004, "odometer_scale_sigma": 2e-4}, {"odometer_scale": 1.004, "scale_sigma": 2e-4}),
        ({"gnss_latency_s": 0.08, "gnss_latency_sigma_s": 0.01}, {"latency_s": 0.08, "latency_sigma_s": 0.01}),
    ],
)
def test_what_the_vehicle_file_gives_alone_stays_and_the_other_is_learned(known, expected):
    aligned = align_run(*run(REAL, 1), Vehicle(**known), CONFIG)
    for column in ("odometer_scale", "scale_sigma", "latency_s", "latency_sigma_s"):
        found = aligned[column]
        assert (found.min() == found.max() == expected[column]) if column in expected else (found[0] != found[-1])


def test_braking_after_a_long_cruise_raises_no_alarm():
    plan = Straight(duration_s=1900.0, period_s=1.0, latency_s=0.25, cruise_s=1800.0)
    assert [seed for seed in range(6) if alarms(align_run(*run(plan, seed), Vehicle(), CONFIG))] == []


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("rate_mps", [0.5, -0.5])
def test_a_drift_after_five_kilometres_is_detected_before_the_position_failure(seed, rate_mps):
    begin_s = 200.0
    aligned = align_run(*run(REAL, seed, lambda t: rate_mps * np.maximum(t - begin_s, 0.0)), Vehicle(), CONFIG)
    assert aligned["path_m"].filter(aligned["t"].dt.timestamp("ns") < begin_s * 1e9)[-1] > 5_000.0
    first = alarms(aligned)[0]
    assert begin_s <= seconds(aligned, first) < begin_s + 20.0 / abs(rate_mps)


def test_scale_error_and_latency_would_alarm_if_they_were_taken_as_zero():
    wrong = Vehicle(odometer_scale=1.0, gnss_latency_s=0.0)
    assert alarms(align_run(*run(REAL, 1), wrong, CONFIG))


def test_the_vehicle_file_is_used_as_it_is():
    vehicle = Vehicle(odometer_scale=1.004, odometer_scale_sigma=2e-4, gnss_latency_s=0.08, gnss_latency_sigma_s=0.01)
    aligned = align_run(*run(REAL, 2), vehicle, CONFIG)
    assert aligned["odometer_scale"].unique().to_list() == [1.004]
    assert aligned["scale_sigma"].unique().to_list() == [2e-4]
    assert aligned["latency_s"].unique().to_list() == [0.08]
    assert alarms(aligned) == []


def test_estimates_use_the_past_only():
    epochs, odometer = run(REAL, 3)
    whole = align_run(epochs, odometer, Vehicle(), CONFIG)
    cut = 3_000
    end = epochs["t"][cut]
    part = align_run(epochs[:cut], odometer.filter(pl.col("t") <= end), Vehicle(), CONFIG)
    names = ["odometer_scale", "scale_sigma", "latency_s", "latency_sigma_s"]
    assert_frame_equal(part.select(names), whole[:cut].select(names), check_exact=True)


def test_learning_stands_still_under_an_alarm_that_persists():
    aligned = align_run(*run(REAL, 4, lambda t: np.where(t >= 300.0, 45.0, 0.0)), Vehicle(), CONFIG)
    after = aligned.filter(pl.col("t").dt.timestamp("ns") >= 300 * 10**9)
    assert after["odometer_scale"].n_unique() == 1
    assert after["odometer_scale"][0] == pytest.approx(1.004, abs=1e-3)


def test_learning_goes_on_after_a_jump_there_and_back():
    aligned = align_run(*run(REAL, 5, lambda t: np.where((t >= 300.0) & (t < 303.0), 500.0, 0.0)), Vehicle(), CONFIG)
    after = aligned.filter(pl.col("t").dt.timestamp("ns") >= 400 * 10**9)
    assert after["odometer_scale"].n_unique() > 10
    assert aligned["odometer_scale"][-1] == pytest.approx(1.004, abs=1e-3)


def test_an_odometer_that_falls_while_the_path_grows_is_turned_round():
    plain = align_run(*run(Straight(), 6), Vehicle(), CONFIG)
    turned = align_run(*run(Straight(polarity=-1), 6), Vehicle(), CONFIG)
    names = ["odometer_scale", "odometer_m", "speed_mps", "direction"]
    assert_frame_equal(plain.select(names), turned.select(names), abs_tol=1e-9, rel_tol=0.0)


def test_epochs_beyond_the_odometer_say_so():
    epochs, odometer = run(Straight(duration_s=100.0), 7)
    aligned = align_run(epochs, odometer.filter(pl.col("t").dt.timestamp("ns") < 60 * 10**9), Vehicle(), CONFIG)
    late = aligned.filter(pl.col("t").dt.timestamp("ns") > 61 * 10**9)
    assert late["odometer_reason"].unique().to_list() == [BEYOND_SPAN]
    assert late["odometer_m"].null_count() == late.height


def test_without_odometer_speed_comes_from_positions():
    epochs, _ = run(Straight(duration_s=200.0, sigma_m=0.01), 8)
    aligned = align_run(epochs, None, Vehicle(), CONFIG)
    assert aligned["odometer_reason"].unique().to_list() == [NO_ODOMETER]
    assert aligned["odometer_m"].null_count() == aligned.height
    assert aligned["speed_mps"][-1] == pytest.approx(40.0, abs=0.2)


def test_time_may_start_anywhere():
    epochs, odometer = run(REAL, 9)
    shift = pl.duration(days=400)
    later = align_run(
        epochs.with_columns(pl.col("t") + shift), odometer.with_columns(pl.col("t") + shift), Vehicle(), CONFIG
    )
    plain = align_run(epochs, odometer, Vehicle(), CONFIG)
    assert_frame_equal(plain.drop("t"), later.drop("t"), check_exact=True)


def test_the_odometer_is_known_at_times_between_epochs_and_inside_gaps():
    epochs, odometer = run(Straight(duration_s=200.0, polarity=-1, scale=1.004), 10)
    vehicle = Vehicle(odometer_scale=1.004, gnss_latency_s=0.0)
    gap = epochs.filter((pl.col("t").dt.timestamp("ns") < 100 * 10**9) | (pl.col("t").dt.timestamp("ns") > 120 * 10**9))
    aligned = align_run(gap, odometer, vehicle, CONFIG)
    at_ns = np.round(np.array([0.5, 90.05, 110.0, 150.0, 300.0]) * 1e9).astype(np.int64)
    start = distance(np.array([1.0, 200.0]))[0]
    expected = distance(np.array([0.5, 90.05, 110.0, 150.0, 200.0]))[:4] - start
    odometry = odometry_from(odometer, vehicle, CONFIG).growing_along_path(-1)
    found = odometer_at(at_ns, arrays_of_table(AlignedEpochs, aligned), odometry)
    assert np.isnan(found[4])
    np.testing.assert_allclose(found[:4], expected, atol=2.5)


def test_what_cannot_be_compared_freezes_the_learning() -> None:
    epochs, odometer = run(REAL, 7)
    unknown = pl.int_range(pl.len()).is_between(3000, 3100)
    aligned = align_run(
        epochs.with_columns(sigma_along_m=pl.when(~unknown).then("sigma_along_m")), odometer, Vehicle(), CONFIG
    )
    scale = aligned["odometer_scale"]
    assert scale.is_finite().all()
    assert scale[3001:].n_unique() == 1


def test_learning_counts_with_the_calibrated_sigma():
    epochs, odometer = run(REAL, seed=3)
    overstated = epochs.with_columns(pl.col("sigma_along_m") * 3.0)
    calibrated = CONFIG.model_copy(update={"monitors": CONFIG.monitors.model_copy(update={"sigma_slope": 1.0 / 3.0})})
    stated = align_run(epochs, odometer, Vehicle(), CONFIG)
    found = align_run(overstated, odometer, Vehicle(), calibrated)
    learned = ["odometer_scale", "scale_sigma", "latency_s", "latency_sigma_s"]
    assert_frame_equal(found.select(learned), stated.select(learned), rel_tol=1e-9)
    assert stated["scale_sigma"][-1] < align_run(overstated, odometer, Vehicle(), CONFIG)["scale_sigma"][-1]


def test_a_long_stand_where_rows_scatter_with_the_speed_alone():
    """Stamps on receipt: no row scatters at a stand, and the thresholds' model of the errors stays the same."""
    t_s = np.arange(0.0, 650.0, 0.1)
    travelled_m = np.minimum(20.0 * t_s, 2000.0)
    odometry = odometry_from(odometer_of(t_s, travelled_m), Vehicle(), CONFIG)
    noise = Noise(odometry.noise.white_m2_per_s, QuantisationNoise(0.0, 1e-3))
    known = replace(odometry.known_noise, moving_s2=np.full(t_s.size, 1e-3))
    scattered = replace(odometry, noise=noise, known_noise=known)
    epochs = arrays_of_table(MatchedEpochs, epochs_of(t_s[20:-20], travelled_m[20:-20]))
    aligned = align(epochs, scattered, Vehicle(), CONFIG).table
    # 0.03 s at 20 m/s, 0.6 m, counts under way alone; GNSS and odometer agree, so the scale stays 1.
    rows_m = aligned["odometer_rows_m"]
    assert rows_m[500] == pytest.approx(20.0 * 1e-3**0.5, rel=1e-3)
    assert rows_m[-1] == 0.0
    assert aligned["odometer_scale"][-1] == pytest.approx(1.0, abs=1e-4)


def test_speed_of_positions_is_over_the_window_before():
    speed = speed_of_positions(np.array([0.0, 1.0, 2.0, 2.5]), np.array([0.0, 10.0, 30.0, 45.0]), 1.0)
    # At 2.5 s the last position a second before is that of 1 s.
    assert speed == pytest.approx([np.nan, 10.0, 20.0, 35.0 / 1.5], nan_ok=True)


def test_the_odometer_at_any_time_goes_on_from_the_epoch_before_at_its_time_of_validity():
    """20 m/s; the position of 10 s is 0.5 s old, where 190 m were counted."""
    t_s = np.arange(0.0, 20.0, 0.1)
    odometry = odometry_from(odometer_of(t_s, 20.0 * t_s))
    aligned = pl.DataFrame(
        {"t": times(np.array([10.0])), "odometer_m": [190.0], "odometer_scale": [1.0], "latency_s": [0.5]}
    )
    at_ns = np.array([9, 10, 12, 30]) * NS_PER_S
    found = odometer_at(at_ns, arrays_of_table(AlignedEpochs, aligned), odometry)
    assert found == pytest.approx([180.0, 200.0, 240.0, np.nan], nan_ok=True)


def test_nothing_is_learned_from_positions_off_the_track():
    epochs, odometer = run(Straight(duration_s=400.0, period_s=1.0, scale=1.004), 3)
    aside = pl.int_range(epochs.height).is_between(150, 300)
    off = epochs.with_columns(path_m=pl.when(~aside).then("path_m"), on_track=~aside, near_track=~aside)
    off = off.with_columns(fix_valid=~aside)
    aligned = align_run(off, odometer, Vehicle(), CONFIG)
    assert aligned["odometer_scale"].is_finite().all()
    assert aligned["odometer_scale"][-1] == pytest.approx(1.004, abs=4.0 * aligned["scale_sigma"][-1])
    # What comes after them still teaches.
    assert aligned["scale_sigma"][-1] < 0.9 * aligned["scale_sigma"][149]


KNOWN_NOISE = Configuration.model_validate({"monitors": NO_NOISE})


def ten_epochs(leap_m):
    """Twelve seconds at 20 m/s, epochs from 2 s on; between the first two of them the position leaps."""
    t_s = np.arange(2.0, 12.0)
    epochs = epochs_of(t_s, 20.0 * t_s + leap_m * (t_s > 2.0))
    odometer_s = np.arange(0.0, 13.0, 0.5)
    aligned = align_run(epochs, odometer_of(odometer_s, distance_m=20.0 * odometer_s), Vehicle(), KNOWN_NOISE)
    return aligned["scale_sigma"].to_numpy()


def test_learning_begins_with_the_first_epoch():
    """Epochs 1 s and 2 s after it first tell of scale; of each the odometer up to 2 s later is read."""
    learned = ten_epochs(0.0)
    np.testing.assert_allclose(learned[:4], 0.01, rtol=1e-6)
    assert learned[4] < 0.009


def test_a_leap_to_the_second_epoch_stops_the_learning():
    np.testing.assert_array_equal(ten_epochs(50.0), 0.01)


@pytest.mark.parametrize(("beside_m", "goes_on"), [(0.0, True), (6.0, True), (-6.0, True), (9.0, False)])
def test_after_an_alarm_learning_goes_on_within_the_bound_of_both_positions(beside_m, goes_on):
    """Speeding up; 50 m off from 20 s to 30 s, then beside its place. Both sigmas are 1 m: 5.33 sqrt(2 + 0.1) = 7.7 m.

    The scale is known, so learning shows in the latency; 30 s after the last failure and its echo it goes on.
    """
    t_s = np.arange(1.0, 120.0)
    off_m = np.where(t_s < 20.0, 0.0, np.where(t_s < 30.0, 50.0, beside_m))
    odometer_s = np.arange(0.0, 123.0, 0.5)
    aligned = align_run(
        epochs_of(t_s, 10.0 * t_s + 0.15 * t_s**2 + off_m),
        odometer_of(odometer_s, distance_m=10.0 * odometer_s + 0.15 * odometer_s**2),
        Vehicle(odometer_scale=1.0, odometer_scale_sigma=0.0),
        KNOWN_NOISE,
    )
    latency_sigma_s = aligned["latency_sigma_s"].to_numpy()
    assert np.ptp(latency_sigma_s[20:59]) == 0.0
    assert (latency_sigma_s[-1] < latency_sigma_s[20]) == goes_on


def test_slip_is_that_of_the_rows_about_an_epoch_inside_the_odometer():
    """Rows at 0, 1, ... 6 s, of which those at 2 s and at 6 s slip; epochs half a second later, two of them beyond."""
    odometer = odometer_of(np.arange(7.0), distance_m=10.0 * np.arange(7.0), slip=[k in (2, 6) for k in range(7)])
    epochs = epochs_of(0.5 + np.arange(-1.0, 8.0), 5.0 + 10.0 * np.arange(-1.0, 8.0))
    vehicle = Vehicle(odometer_scale=1.0, odometer_scale_sigma=1e-4, gnss_latency_s=0.0, gnss_latency_sigma_s=0.01)
    found = align_run(epochs, odometer, vehicle, CONFIG)["odometer_slips"].to_list()
    assert found == [False, False, True, True, False, False, True, False, False]


@pytest.mark.parametrize(
    ("t_s", "clock_periods", "jitter_s"),
    [
        ([0.0, 1.0, 2.0, 3.0, 4.0], 3.0, 0.0),
        # Of the period known before each, here the first step of 1.02 s and means of 1.02 s and 0.98 s.
        ([0.0, 1.02, 2.0, 3.02, 4.0], 3.0, np.sqrt((0.04**2 + 0.02**2 + 0.04**2) / 3 / 2)),
        ([0.0, 1.0, 2.0, 3.0, 5.1], 3.0, np.sqrt(0.1**2 / 3 / 2)),  # of two periods, 0.1 s late
        ([0.0, 1.0, 2.0, 3.0, 8.1], 3.0, 0.0),  # of five: the clock may have started anew
        ([0.0, 1.0, 101.0], 1.0, 0.0),  # no step is of one period: nothing shows how the stamps scatter
    ],
)
def test_stamps_scatter_by_how_far_their_steps_are_off_whole_periods(t_s, clock_periods, jitter_s):
    stamps_s = np.array(t_s)
    period_s = periods_before_s(np.round(1e9 * stamps_s).astype(np.int64))
    found_s = stamp_jitter_s(stamps_s, period_s, clock_periods)
    assert found_s[-1] == pytest.approx(jitter_s, abs=1e-12)
    for rows in range(1, stamps_s.size):
        assert (stamp_jitter_s(stamps_s[:rows], period_s[:rows], clock_periods) == found_s[:rows]).all()
