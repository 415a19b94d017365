"""Noise of single odometer rows, measured from rows of known noise."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from pipeline.stages.monitors.axis import AlongEpochs, along_series, run_axis
from pipeline.stages.odometry.odometry import Increments
from pipeline.stages.odometry.quantisation import QuantisationNoise
from pipeline.stages.odometry.rows import count_step
from schemas.config import Configuration, threshold_factor
from tests.replay.journeys import VEHICLE, hides_no_fault, journey, replay
from tests.stages.alignment.straight import align_run, epochs_of, odometer_of, odometry_from
from tests.stages.odometry.drives import recorded

WHITE_MPS = 0.05
CONFIG = Configuration()


def way(at_s):
    """A train at 10 m/s for 200 s, then at 1 m/s2 to 30 m/s, on for 200 s, and standing from then on."""
    at = np.asarray(at_s)
    driven = np.where(at < 200.0, 10.0 * at, 2000.0 + 10.0 * (at - 200.0) + 0.5 * (at - 200.0) ** 2)
    driven = np.where(at > 220.0, 2400.0 + 30.0 * (at - 220.0), driven)
    return np.minimum(driven, 2400.0 + 30.0 * 200.0)


def noise_of(t_s, distance_m, **columns):
    return odometry_from(odometer_of(t_s, distance_m=distance_m, **columns)).noise.quantisation


def walk(t_s, seed=1):
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.normal(0.0, WHITE_MPS * np.sqrt(np.diff(t_s, prepend=t_s[0] - 0.05))))


@pytest.mark.parametrize("rate_hz", [1.0, 5.0, 20.0, 100.0])
def test_white_noise_of_the_increments_is_no_noise_of_the_rows(rate_hz):
    t = np.arange(0.0, 500.0, 1.0 / rate_hz)
    assert not noise_of(t, way(t))
    assert not noise_of(t, way(t) + walk(t))
    assert not noise_of(t, None, speed_mps=np.round(np.gradient(way(t), t)))


@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 50.0])
@pytest.mark.parametrize("step_m", [0.5, 1.0, 2.0])
def test_counts_scatter_by_their_step_over_root_twelve(step_m, rate_hz):
    t = np.arange(0.0, 500.0, 1.0 / rate_hz)
    found = noise_of(t, np.floor((way(t) + walk(t)) / step_m) * step_m)
    for speed_mps in (10.0, 30.0):
        assert np.sqrt(found.variance_m2(speed_mps)) == pytest.approx(step_m / np.sqrt(12.0), rel=0.35)


def test_a_counter_is_known_by_its_step():
    ways = np.concatenate([[0.0], np.cumsum(0.5 * np.tile([3, 1, 0, 3, 2, 5], 4))])

    def count_m(rows_m):
        return count_step(rows_m, CONFIG.align).step_m[-1]

    assert count_m(ways) == 0.5
    assert count_m(ways - 1000.0 * (ways > 10.0) + 1e-7 * np.sin(ways)) == pytest.approx(0.5, rel=1e-5)
    assert count_m(ways / 50.0) == 0.0
    assert count_m(ways + 0.1 * np.sin(ways)) == 0.0
    assert count_m(ways + 0.2 * (np.arange(ways.size) > 7)) == 0.0
    # A leap that no train drives is no way.
    assert count_m(ways + 300.2 * (np.arange(ways.size) > 7)) == 0.5


def test_the_step_of_a_counter_is_known_once_enough_ways_have_shown_it():
    """Ways of 1.5, 0.5, 0, 1.5, 1, 2.5 m by turns: each differs from the one before, so the ninth is enough."""
    ways = np.concatenate([[0.0], np.cumsum(0.5 * np.tile([3, 1, 0, 3, 2, 5], 4))])
    known = count_step(ways, CONFIG.align)
    assert known.shown.tolist() == [True] * 2 + [False] * 7 + [True] * 16
    assert known.step_m.tolist() == [0.0] * 9 + [0.5] * 16
    rows = np.insert(ways, 12, np.nan)
    assert count_step(rows, CONFIG.align).step_m.tolist() == [0.0] * 9 + [0.5] * 17
    # From a way that is no multiple of it on there is none.
    assert count_step(np.append(ways, ways[-1] + 0.7), CONFIG.align).step_m.tolist() == [0.0] * 9 + [0.5] * 16 + [0.0]


def test_a_smooth_way_at_few_speeds_is_no_counter():
    t = np.arange(0.0, 400.0, 0.1)
    assert not noise_of(t, np.where(t < 200.0, 10.0 * t, 2000.0 + 20.0 * (t - 200.0)))
    assert not noise_of(t, np.zeros(t.size))


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_the_reading_is_found_whatever_the_speed(seed):
    t = np.arange(0.0, 500.0, 0.05)
    rng = np.random.default_rng(seed)
    found = noise_of(t, way(t) + walk(t, seed) + rng.normal(0.0, 0.2, t.size))
    for speed_mps in (0.0, 10.0, 30.0):
        assert np.sqrt(found.variance_m2(speed_mps)) == pytest.approx(0.2, rel=0.15)


@pytest.mark.parametrize("seed", range(5))
def test_stamps_that_scatter_weigh_with_the_speed(seed):
    true_s = np.arange(0.0, 500.0, 0.1)
    stamps = true_s + np.random.default_rng(seed).uniform(-0.02, 0.02, true_s.size)
    found = noise_of(stamps, way(true_s))
    assert np.sqrt(found.moving_s2) == pytest.approx(0.04 / np.sqrt(12.0), rel=0.15)
    assert found.still_m2 < 0.1**2


@pytest.mark.parametrize("seed", range(3))
def test_speeds_near_each_other_show_the_noise_of_stamps_too(seed):
    """10 and 21 m/s: the sum of their squares for the difference would make 20 ms 16 ms."""
    true_s = np.arange(0.0, 500.0, 0.05)
    distance_m = np.where(true_s < 250.0, 10.0 * true_s, 2500.0 + 21.0 * (true_s - 250.0))
    stamps = true_s + np.random.default_rng(seed).uniform(-0.02, 0.02, true_s.size)
    found = noise_of(stamps, distance_m)
    assert np.sqrt(found.moving_s2) == pytest.approx(0.04 / np.sqrt(12.0), rel=0.1)


def test_noise_of_the_reading_and_of_the_stamps_are_told_apart():
    """0.3 m whatever the speed, and 20 ms: 0.2 m at 10 m/s, 0.6 m at 30 m/s."""
    t = np.arange(0.0, 500.0, 0.05)
    rng = np.random.default_rng(3)
    found = noise_of(t, way(t + rng.normal(0.0, 0.02, t.size)) + rng.normal(0.0, 0.3, t.size))
    assert np.sqrt(found.still_m2) == pytest.approx(0.3, rel=0.2)
    assert np.sqrt(found.moving_s2) == pytest.approx(0.02, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_what_the_white_noise_explains_is_left_out(seed):
    t = np.arange(0.0, 500.0, 0.05)
    rng = np.random.default_rng(seed)
    walked = np.cumsum(rng.normal(0.0, 0.45 * np.sqrt(0.05), t.size))
    frame = odometer_of(t, distance_m=way(t) + walked + rng.normal(0.0, 0.2, t.size))
    noisy = Configuration.model_validate({"monitors": {"odometer_sigma_mps": 0.45}})
    found = odometry_from(frame, config=noisy).noise.quantisation
    assert np.sqrt(found.variance_m2(10.0)) == pytest.approx(0.2, rel=0.12)


def test_rows_of_a_run_that_mostly_stands_are_judged_where_it_moves():
    t = np.arange(0.0, 2000.0, 0.05)
    noise = np.random.default_rng(1).normal(0.0, 0.2, t.size) * (t < 420.0)
    found = noise_of(t, way(t) + noise)
    assert np.sqrt(found.variance_m2(10.0)) == pytest.approx(0.2, rel=0.15)


@pytest.mark.parametrize("period_s", [0.1, 0.5, 2.0])
def test_a_train_that_gathers_speed_and_brakes_all_the_time_scatters_not(period_s):
    t = np.arange(0.0, 1000.0, period_s)
    assert not noise_of(t, 8.0 * t + 3.0 * np.sin(0.6 * t))


def test_ways_that_are_lost_do_not_count():
    t = np.arange(0.0, 420.0, 0.05)
    slips = np.arange(t.size) % 60 == 59
    assert not noise_of(t, way(t) + np.cumsum(slips), slip=slips.tolist())


def test_slips_and_standstill_do_not_count():
    t = np.arange(0.0, 500.0, 0.05)
    slips = sum(3.0 * np.clip(t - begin, 0.0, 1.0) for begin in (30.0, 90.0, 170.0, 260.0, 330.0))
    assert not noise_of(t, way(t) + slips)
    standing = np.arange(0.0, 500.0, 0.05)
    assert not noise_of(standing, np.random.default_rng(1).normal(0.0, 0.2, standing.size) * 0.01)


def test_too_few_rows_or_rows_too_far_apart_tell_nothing():
    short = np.arange(0.0, 12.0, 0.05)
    assert noise_of(short, np.floor(20.0 * short)) == QuantisationNoise()
    sparse = np.arange(0.0, 500.0, 2.0)
    assert noise_of(sparse, np.floor(way(sparse))) == QuantisationNoise()


@pytest.mark.parametrize("step_m", [0.5, 2.0])
def test_a_coarse_counter_raises_no_alarm_and_hides_no_leap(step_m):
    def coarse(run):
        counts = (run.odometer["distance_m"] / step_m).floor() * step_m
        return run.with_streams(odometer=run.odometer.with_columns(counts.alias("distance_m")))

    run, site = journey()
    healthy = replay(coarse(run), site, VEHICLE)
    assert healthy.runs["alarms"].item() == 0
    assert healthy.passages["status"].unique().to_list() == ["accepted"]
    hides_no_fault(coarse)


def by_counts_of_20_m(*faults, **settings):
    run, site = journey(*faults, **settings)
    counts = (run.odometer["distance_m"] / 20.0).floor() * 20.0
    return replay(run.with_streams(odometer=run.odometer.with_columns(counts.alias("distance_m"))), site, VEHICLE)


def reasons_of(tables):
    """Of the epochs from the first count on, none of which passes."""
    epochs = tables.epochs.filter(pl.col("odometer_m") > 0.0)
    names = [name for name in epochs.columns if name.startswith("along_") and name.endswith("_state")]
    assert len(names) == 5
    assert "pass" not in {state for name in names for state in epochs[name].cast(pl.String)}
    return set(epochs["along_raw_reason"].cast(pl.String))


@pytest.mark.parametrize("sigma_m", [0.3, 1.5])
def test_by_a_counter_too_coarse_for_the_failure_limit_a_healthy_run_has_no_alarm_and_nothing_accepted(sigma_m):
    tables = by_counts_of_20_m(gnss={"sigma_east_m": sigma_m, "sigma_north_m": sigma_m})
    assert "noise too large" in reasons_of(tables)
    assert tables.alarms.height == 0
    assert tables.runs["balises_accepted"].item() == 0


def test_by_a_counter_too_coarse_for_the_failure_limit_no_drift_is_hidden():
    """A ramp of 80 m, which no monitor can tell from counts: no balise is accepted, and nothing calls it safe."""
    tables = by_counts_of_20_m({"kind": "ramp", "rate_mps": 0.5, "start_s": 90.0, "duration_s": 160.0})
    assert "noise too large" in reasons_of(tables)
    assert tables.epochs["error_along_m"].max() > 60.0
    assert tables.runs["balises_accepted"].item() == 0
    assert tables.runs["verdict"].item() != "safe"


def test_no_more_noise_enters_than_leaves_the_failure_limit_seen():
    config = Configuration()
    most_m = config.scatter_limit_m
    assert threshold_factor(1e-7) * np.sqrt(2.0) * most_m == pytest.approx(config.hazards.failure_limit_m)
    t = np.arange(0.0, 500.0, 0.1)
    for step_m, expected_m in ((5.0, 5.0 / np.sqrt(12.0)), (20.0, most_m)):
        odometer = odometer_of(t, distance_m=np.floor(way(t) / step_m) * step_m)
        aligned = align_run(
            epochs_of(np.array([100.0, 300.0, 400.0]), way([100.0, 300.0, 400.0])), odometer, VEHICLE, config
        )
        found_m = aligned["odometer_rows_m"].to_numpy()
        assert found_m == pytest.approx(expected_m, rel=0.35 if step_m == 5.0 else 1e-9)


def standing(t_s, along_m, period_s):
    """Epochs of a train that stands, whose only noise is that of the odometer's rows, 1 m."""
    zero, one = np.zeros(t_s.size), np.ones(t_s.size)
    index = np.arange(t_s.size)
    return AlongEpochs(index, t_s, along_m, 0 * index, zero, zero, 0.0, zero, zero, 0.0, one, period_s)


@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.13, 0.5, 1.0, 1.4, 5.0])
@pytest.mark.parametrize("step_s", [0.05, 0.1, 1.0])
def test_no_statistic_has_more_noise_of_the_rows_than_its_sigma(step_s, period_s):
    count = 60_000
    rows = np.arange(0.0, count * step_s + 2.0 * period_s, period_s)
    at = np.arange(count) * step_s
    errors = np.interp(at, rows, np.random.default_rng(1).normal(0.0, 1.0, rows.size))
    series = along_series(standing(at, errors, period_s), Increments(np.zeros(count), np.zeros(count)), CONFIG)
    value, sigma, _ = run_axis(series, np.array(Configuration().monitors.ewma_alphas[:2]))
    spread = value[count // 5 :].std(axis=0) / sigma[-1]
    assert (spread < 1.06).all()
    # As far as the odometer is no slower than an epoch it is exact, but for straight lines between rows.
    assert (spread[1:] > 0.7).all()


STOPS = {
    "start_m": 200.0,
    "phases": [
        {"speed_mps": 20.0, "acceleration_mps2": 1.0},
        {"stop_at_m": 1710.0, "acceleration_mps2": 1.0, "hold_s": 5.0},
        {"speed_mps": 30.0},
        {"stop_at_m": 4310.0, "acceleration_mps2": 0.8, "hold_s": 5.0},
        {"speed_mps": 25.0},
        {"stop_at_m": 8000.0},
    ],
}


def counted(run, _):
    return run.odometer.with_columns((pl.col("distance_m") / 2.0).floor() * 2.0)


def stamped(run, seed):
    stamps = run.odometer["t"].to_physical().to_numpy()
    late = np.random.default_rng(seed).uniform(-0.03, 0.03, stamps.size) * 1e9
    stamps = pl.Series("t", np.sort(stamps + late.astype(np.int64))).cast(pl.Datetime("ns", "UTC"))
    return run.odometer.with_columns(stamps)


@pytest.mark.parametrize("recorded", [counted, stamped])
def test_the_scale_is_learned_with_rows_that_scatter_and_no_surer_than_it_is(recorded):
    gnss = {"sigma_east_m": 0.3, "sigma_north_m": 0.3}
    off = []
    for seed in range(4):
        run, site = journey(seed=seed, odometer={"scale": 1.003}, motion=STOPS, gnss=gnss)
        learned = replay(run.with_streams(odometer=recorded(run, seed)), site).runs.row(0, named=True)
        assert learned["odometer_scale_sigma"] < 0.001
        off.append((learned["odometer_scale"] - 1.003) / learned["odometer_scale_sigma"])
    assert np.sqrt(np.mean(np.square(off))) < 1.3


def test_between_rows_a_straight_line_changes_with_the_square_of_the_step():
    at = np.cumsum([0.0, 0.1, 0.5, 1.0, 3.0])
    series = along_series(standing(at, np.zeros(5), 1.0), Increments(np.zeros(5), np.zeros(5)), CONFIG)
    np.testing.assert_allclose(series.decorrelation[1:, -1], [0.02, 0.25, 1.0, 1.0])


@pytest.mark.parametrize("rate_hz", [1, 10])
@pytest.mark.parametrize(("kind", "size"), [("counts", 0.5), ("counts", 5.0), ("noise", 0.3), ("jitter", 0.03)])
def test_what_is_known_of_the_rows_does_not_depend_on_later_ones(kind, size, rate_hz):
    """Half of the drive at another rate, so that the period, too, is what the rows before show."""
    t, reads, _ = recorded(np.random.default_rng(11), kind, size, rate_hz)
    kept = (t < 300.0) | (np.arange(t.size) % 3 == 0)
    t, reads = t[kept], reads[kept]
    declared = np.where(t < 200.0, 0.05, 0.4)
    frame = odometer_of(t, distance_m=reads).with_columns(sigma_speed_mps=pl.Series(declared))
    whole = odometry_from(frame)
    for rows in np.random.default_rng(rate_hz).integers(40, t.size, 6).tolist():
        cut = odometry_from(frame.head(rows))
        assert cut.t_s.size <= whole.t_s.size
        at_s = t[: rows - 4] - t[0]
        found, expected = cut.noise_at_s(at_s), whole.noise_at_s(at_s)
        for name in ("white_m2_per_s", "still_m2", "moving_s2", "faster_s2", "shown_mps", "period_s", "shown"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
        at_ns = whole.epoch_ns + np.round(1e9 * at_s).astype(np.int64)
        np.testing.assert_array_equal(cut.travelled_at(at_ns)[:-20], whole.travelled_at(at_ns)[:-20])


def test_speeds_alone_and_rows_far_apart_have_no_such_noise():
    t = np.arange(0.0, 200.0, 0.1)
    speeds = odometry_from(odometer_of(t, speed_mps=np.round(np.gradient(way(t), t)))).known_noise
    sparse = odometry_from(odometer_of(t[::30], distance_m=np.floor(way(t[::30])))).known_noise
    for known in (speeds, sparse):
        assert known.shown.all()
    assert not speeds.still_m2.any()
