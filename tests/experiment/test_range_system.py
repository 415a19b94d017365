"""The pseudorange monitor as a system: against the replay's monitor, counting and exact tails; configured too."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from datasets.experiment import EXPERIMENTS, rare
from datasets.experiment.geometry import CONSTELLATIONS, Constellation, default_geometry
from datasets.experiment.range_system import RangePlan, miss_at_one_epoch, monitor_statistic, range_system
from datasets.experiment.sampling import false_alarm_probability, missed_detection_probability
from datasets.experiment.workers import random_generator
from pipeline.stages.monitors.pseudorange import clock_columns, line_of_sight_rows, pseudorange_monitor
from schemas.config import Configuration, MonitorConfig
from schemas.stages import AlignedEpochs
from tests.arrays_of_table import arrays_of_table
from tests.experiment.counting import counted_alarms, counted_misses


def plan(constellation: Constellation = "gps", probability: float = 1e-7, period_s: float = 10.0) -> RangePlan:
    return RangePlan(default_geometry(constellation), period_s=period_s, false_alarm_probability=probability)


@pytest.mark.parametrize("constellation", CONSTELLATIONS)
def test_projection_equals_the_monitor_of_the_replay(constellation: Constellation) -> None:
    geometry = default_geometry(constellation)
    heading, survey = 30.0, 1.0
    rng = np.random.default_rng(2)
    errors = rng.normal(0.0, 2.0, len(geometry.svs))
    one = monitor_statistic(RangePlan(geometry, survey_m=survey), heading)
    rows = line_of_sight_rows(geometry.azimuth_deg, geometry.elevation_deg)
    position = geometry.gain @ errors
    design = np.hstack([rows, clock_columns(geometry.svs)])
    weight = 1.0 / geometry.range_variance_m2.sum(axis=1)
    state = np.linalg.solve(design.T @ (weight[:, None] * design), design.T @ (weight * errors))
    axes = geometry.axes(heading)
    t = [datetime(2024, 3, 20, tzinfo=UTC)]
    epochs = pl.DataFrame(
        {
            "t": t,
            "heading_deg": float((geometry.azimuth_deg[geometry.faulty] + heading) % 360.0),
            "slope": 0.0,
            "cross_track_m": float(axes[1] @ position),
            "vertical_m": float(position[2]),
            "survey_sigma_m": survey,
            "interpolation_error_m": 0.0,
            "fix_valid": True,
            "on_track": True,
            "gate_probability": 1.0,
        }
    ).with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))
    satellites = pl.DataFrame(
        {
            "t": epochs["t"].gather([0] * len(geometry.svs)),
            "sv": list(geometry.svs),
            "azimuth_deg": geometry.azimuth_deg,
            "elevation_deg": geometry.elevation_deg,
            "residual_m": errors - design @ state,
            "sigma_m": np.sqrt(geometry.range_variance_m2.sum(axis=1)),
            "used": True,
        }
    )
    replayed = pseudorange_monitor(arrays_of_table(AlignedEpochs, epochs), satellites, Configuration())
    value = one.project @ errors
    assert replayed.value[0] == pytest.approx(value @ value, rel=1e-9)
    assert replayed.threshold[0] == pytest.approx(one.threshold, rel=1e-12)


@pytest.mark.parametrize("constellation", CONSTELLATIONS)
def test_residuals_are_white_at_an_epoch_and_related_over_time_as_simulated(constellation: Constellation) -> None:
    system = range_system(plan(constellation, period_s=100.0), 30.0)
    assert system.covariance_by_lag(1)[0] == pytest.approx(np.eye(system.size), abs=1e-12)
    rng = random_generator(1)
    first = system.draw_start(40_000, rng)
    second = system.draw_next(first, rng)
    together = system.values(second) @ system.values(first).T / 40_000
    assert together == pytest.approx(system.covariance_by_lag(2)[2], abs=5 / np.sqrt(40_000))


@pytest.mark.parametrize("constellation", CONSTELLATIONS)
def test_misses_agree_with_counting(constellation: Constellation) -> None:
    system = range_system(plan(constellation), 0.0)
    clever = missed_detection_probability(system, 19, 0.1, runs=4_000, seed=2)
    plain = counted_misses(system, 19, 0.1, runs=50_000, seed=3)
    assert 1e-4 < plain.value < 0.3
    spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
    assert clever.value == pytest.approx(plain.value, abs=4 * spread)


def test_one_epoch_has_the_exact_probability_and_bounds_all_others() -> None:
    system = range_system(plan(period_s=300.0), 0.0)
    one = missed_detection_probability(system, 1, 0.1, runs=4_000, seed=4)
    assert one.value == pytest.approx(miss_at_one_epoch(system, 30.0), rel=5 * one.relative_error)
    assert one.value < 1e-6
    many = range_system(plan(period_s=10.0), 0.0)
    assert missed_detection_probability(many, 20, 0.1, runs=2_000, seed=4).value < miss_at_one_epoch(many, 20.0)


def test_false_alarms_agree_with_counting() -> None:
    system = range_system(plan(probability=1e-5), 0.0)
    clever = false_alarm_probability(system, 100, runs=1_000, seed=5)
    plain = counted_alarms(system, 100, runs=30_000, seed=6)
    spread = np.hypot(clever.relative_error * clever.value, plain.relative_error * plain.value)
    assert clever.value == pytest.approx(plain.value, abs=4 * spread)
    assert clever.value < 100 * 1e-5
    assert clever.variance_reduction > 100


@pytest.mark.parametrize("constellation", CONSTELLATIONS)
def test_probabilities_of_1e_9_are_within_reach(constellation: Constellation) -> None:
    system = range_system(plan(constellation), 0.0)
    epochs = {"gps": 31, "gps_galileo": 27}[constellation]
    result = missed_detection_probability(system, epochs, 0.1, runs=4_000, seed=7)
    assert 1e-11 < result.value < 1e-7
    assert result.relative_error < 0.2
    assert result.variance_reduction > 1e5


def test_every_table_of_rare_events_is_written_for_a_configured_bank(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rare, "_RATES_MPS", (1.0,))
    monkeypatch.setattr(rare, "HOUR_S", 60)
    monkeypatch.setattr(rare, "_TRANSIENT_RATES_MPS", (1.0,))
    monkeypatch.setattr(rare, "_SEARCH_RUNS", 100)
    monkeypatch.setattr(rare, "_RANGES_ASKED", ((0.1, 30.0),))
    config = Configuration(monitors=MonitorConfig(ewma_alphas=(0.3, 0.1, 0.03), false_alarm_probability=1e-5))
    EXPERIMENTS["rare"](tmp_path, 100, 1, 1, config)
    tables = {path.stem: pl.read_parquet(path) for path in tmp_path.glob("*.parquet")}
    assert set(tables) == {"missed", "transients", "false_alarms", "pseudorange"}
    for table in tables.values():
        assert {"probability", "relative_error", "variance_reduction", "runs"} <= set(table.columns)
    assert set(tables["missed"]["alphas"]) == {"1, 0.3, 0.1, 0.03"}
    assert set(tables["missed"]["rate_hz"]) == set(tables["false_alarms"]["rate_hz"]) == {1.0, 10.0}
    assert set(tables["false_alarms"]["false_alarm_probability"]) == {1e-5}
    assert set(tables["pseudorange"]["event"]) == {"missed_detection", "false_alarm"}
    for table in tables.values():
        assert (table["probability"].drop_nulls() >= 1e-12).all()
    assert set(tables["transients"]["age_s"]) == {0.0, 10.0, 60.0, 300.0, None}


@pytest.mark.parametrize("constellation", CONSTELLATIONS)
@pytest.mark.parametrize("heading_deg", [15.0 * k for k in range(12)])
def test_the_slow_ramp_is_found_before_its_failure_at_every_heading(
    constellation: Constellation, heading_deg: float
) -> None:
    """0.01 m/s, residuals every half minute, all courses: the last epoch alone misses it less often than 1e-12.

    To the other side the error along the track is the same with the other sign.
    """
    asked = plan(constellation, period_s=30.0)
    failure_s = asked.mean_failure_s(heading_deg, 0.01)
    assert miss_at_one_epoch(range_system(asked, heading_deg), 0.01 * failure_s) < 1e-12
