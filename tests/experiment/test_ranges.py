"""The pseudorange monitor in the experiment: its projection against the replay's monitor, and what it finds."""

from datetime import UTC, datetime

import numpy as np
import polars as pl
import pytest

from datasets.experiment import EXPERIMENTS
from datasets.experiment.geometry import CONSTELLATIONS, default_geometry
from datasets.experiment.ranges import RangePlan, range_passages, run_ranges, statistic
from datasets.experiment.workers import generator
from pipeline.stages.monitors.pseudorange import clock_columns, line_of_sight_rows, pseudorange_monitor
from schemas.config import Configuration
from schemas.stages import AlignedEpochs
from tests.arrays_of_table import arrays_of_table


@pytest.mark.parametrize("constellation", CONSTELLATIONS)
def test_projection_equals_the_monitor_of_the_replay(constellation: str) -> None:
    geometry = default_geometry(constellation)  # type: ignore[arg-type]
    heading, survey = 30.0, 1.0
    rng = np.random.default_rng(2)
    errors = rng.normal(0.0, 2.0, len(geometry.svs))
    one = statistic(RangePlan(geometry, survey_m=survey), heading)
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


def test_fault_free_value_is_chi_square() -> None:
    """A ramp of zero: the share of alarms after one epoch is the configured probability."""
    plan = RangePlan(
        default_geometry("gps"), rates_mps=(0.0,), headings_deg=(0.0,), span_s=1.0, false_alarm_probability=1e-2
    )
    result = range_passages(plan, 40_000, generator(1))
    alarms = int((result.detected_s > 0).sum())
    assert abs(alarms - 400) < 5 * np.sqrt(400)


def test_the_slow_ramp_is_found_before_its_failure_at_every_heading() -> None:
    """All courses, not only those of the paper, with residuals every half minute."""
    plans = tuple(RangePlan(default_geometry(name), rates_mps=(0.01,), period_s=30.0) for name in CONSTELLATIONS)
    table = run_ranges(200, seed=5, plans=plans)
    assert sorted(set(table["heading_deg"])) == [15.0 * k for k in range(12)]
    assert table["missed_at_failure"].sum() == 0
    assert table["censored"].sum() == 0


def test_the_slow_ramp_is_found_before_its_failure() -> None:
    plans = tuple(
        RangePlan(default_geometry(name), rates_mps=(0.01,), period_s=10.0, headings_deg=(0.0, 75.0))
        for name in CONSTELLATIONS
    )
    table = run_ranges(400, seed=3, plans=plans)
    assert table["missed_at_failure"].sum() == 0
    assert table["censored"].sum() == 0
    assert table["time_to_detect_s"].is_between(800.0, 1800.0).all()


@pytest.mark.usefixtures("in_process")
def test_results_do_not_depend_on_the_number_of_jobs() -> None:
    plans = (RangePlan(default_geometry("gps"), rates_mps=(1.0,), headings_deg=(0.0,)),)
    assert run_ranges(500, 4, 1, plans).equals(run_ranges(500, 4, 2, plans))


def test_experiments_are_named() -> None:
    assert {"diagnostics", "findings", "pseudorange"} <= set(EXPERIMENTS)
