"""The unnoticed error of whole runs: proved by injection, and what its columns say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from benchmarks.truth.undetected import proof
from datasets.faults import FaultSpec
from datasets.inject import inject
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from pipeline.one_run import monitor_alone, replay
from pipeline.stages.monitored import MonitoredSolution
from pipeline.studies.undetected.columns import watched_rows
from pipeline.studies.undetected.error import largest_errors
from pipeline.studies.undetected.position_tests import range_bounds
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.run import RunLog, RunTables, Site
from tests.replay.journeys import VEHICLE, journey
from tests.stages.alignment.straight import NO_NOISE

ONE_HZ = {"rate_hz": 1.0}
BOTH = ("undetected_ahead_m", "undetected_behind_m")


def config(**undetected: Any) -> Configuration:
    return Configuration.model_validate({"monitors": NO_NOISE, "undetected": {"compute": True, **undetected}})


@pytest.fixture(scope="module")
def tables() -> RunTables:
    run, site = journey(gnss=ONE_HZ)
    return replay(run, site, VEHICLE, config())


def test_the_profile_is_not_detected_and_five_percent_more_is(tmp_path: Path) -> None:
    found = proof(3, False, tmp_path)
    assert found is not None
    assert found.not_detected
    assert found.detected_scaled
    assert found.judged_apart_m <= 1e-6
    assert 1.0 <= found.closeness <= 1.1


def test_a_read_ends_what_may_have_begun_before(tables: RunTables) -> None:
    passages = tables.passages.filter(pl.col("undetected_since").is_not_null())
    reads = passages.filter(kind="physical")["t_offered"].to_list()
    begin = tables.epochs["t"][0]
    for passage in passages.iter_rows(named=True):
        last = max((t for t in reads if t < passage["t_offered"]), default=begin)
        assert passage["undetected_since"] == last if last != begin else passage["undetected_since"] >= last
    errors = tables.epochs.select("t", larger=pl.max_horizontal(BOTH))
    for t in reads:
        before, after = errors.filter(pl.col("t") < t)["larger"][-1], errors.filter(pl.col("t") > t)["larger"][0]
        assert after < before


def test_who_holds_the_error_is_named(tables: RunTables) -> None:
    named = set(tables.passages["undetected_monitors"].drop_nulls().explode())
    assert named <= {"along_raw", "along_ewma_0p1", "along_ewma_0p01", "along_ewma_0p001"}
    assert "along_ewma_0p001" in named


def test_figures_of_the_run_are_those_of_its_epochs(tables: RunTables) -> None:
    larger = tables.epochs.filter("in_use").select(pl.max_horizontal(BOTH)).to_series().drop_nulls()
    row = tables.runs.row(0, named=True)
    assert row["undetected_max_m"] == larger.max()
    assert row["undetected_share_beyond"] == 0.0
    assert row["t_undetected_beyond"] is row["physical_spacing_m"] is None
    assert row["physical_spacing_starts"] == 6


def test_nobody_asked_is_null() -> None:
    run, site = journey(gnss=ONE_HZ)
    found = replay(run, site, VEHICLE)
    assert found.epochs.select(BOTH).null_count().sum_horizontal().item() == 2 * found.epochs.height
    assert found.passages["undetected_monitors"].null_count() == found.passages.height
    assert found.runs["physical_spacing_starts"].item() is None


def test_spacing_is_the_way_to_the_limit(tables: RunTables) -> None:
    run, site = journey(gnss=ONE_HZ)
    settings = config(fixes=[]).model_dump() | {"hazards": {"failure_limit_m": 6.0}}
    row = replay(run, site, VEHICLE, Configuration.model_validate(settings)).runs.row(0, named=True)
    assert row["physical_spacing_reached"] > 0
    # At 30 m/s after the first seconds; the train stands for the first 5 of them and then gains speed.
    assert 0.0 < row["physical_spacing_m"] < 30.1 * row["physical_spacing_s"]
    first_s = (row["t_undetected_beyond"] - tables.epochs["t"][0]).total_seconds()
    assert row["physical_spacing_s"] <= first_s


def since_the_start(
    run: RunLog, site: Site, vehicle: Vehicle, settings: Configuration
) -> tuple[Floats, Ints, MonitoredSolution]:
    """The largest errors ahead since the first row, their epochs, and what watched."""
    monitored = monitor_alone(run, site, vehicle, settings, "primary")
    rows = watched_rows(monitored)
    return largest_errors(rows.after_fix(0, rows.count - 1), settings.undetected).most_m, rows.epoch[1:], monitored


def test_no_vehicle_file_no_close_bound() -> None:
    run, site = journey(gnss=ONE_HZ)
    known, unknown = (since_the_start(run, site, one, Configuration())[0] for one in (VEHICLE, Vehicle()))
    assert (unknown[: known.size] >= known[: unknown.size]).all()
    # k_T times the prior sigma of 1 % of 6 to 8 km between the read and the end, and more.
    assert unknown.max() > 30.0


def test_what_is_negated_has_no_unnoticed_error() -> None:
    run, site = journey(gnss=ONE_HZ)
    step = FaultSpec.model_validate({"kind": "step", "start_s": 120.0, "size_m": 40.0})
    epochs = replay(inject(run, step, site), site, VEHICLE, config()).epochs
    negated = epochs["lds_mode"] == "fail_safe"
    assert negated.sum() > 10
    assert epochs.filter(negated).select(BOTH).null_count().row(0) == (negated.sum(), negated.sum())
    assert epochs.filter(~negated)["undetected_ahead_m"].drop_nulls().len() > 100


@pytest.fixture(scope="module")
def sky() -> tuple[RunLog, Site]:
    """Two minutes at 1 Hz on a straight line, GPS alone and GPS with Galileo, with ranges."""
    scenario = Scenario.model_validate(
        {
            "name": "sky",
            "seed": 3,
            "line": {
                "heading_deg": 0.0,
                "sections": [{"length_m": 9000.0}],
                "elements": [{"id": "A", "length_m": 9000.0}],
                "balises": [{"id": "VB", "at_m": 2000.0}],
            },
            "runs": [
                {
                    "id": "run",
                    "motion": {"start_m": 500.0, "phases": [{"speed_mps": 30.0, "hold_s": 60.0}]},
                    "gnss": {
                        "rate_hz": 1.0,
                        "sky": {"solutions": {"primary": ["gps", "galileo"], "gps": ["gps"]}},
                    },
                }
            ],
        }
    )
    return build_run(scenario, scenario.runs[0]), build_site(scenario)


def test_one_range_may_do_so_much_before_the_monitor_of_ranges_fails(sky: tuple[RunLog, Site]) -> None:
    both, site = sky
    assert both.satellites is not None
    alone = pl.col("solution") == "gps"
    run = both.with_streams(gnss=both.gnss.filter(alone).head(12), satellites=both.satellites.filter(alone))
    monitored = monitor_alone(run, site, VEHICLE, Configuration(), "gps")
    satellites = monitored.prepared.ranges("gps")
    assert satellites is not None
    low_m, high_m = range_bounds(monitored.aligned, satellites, Configuration())
    clean, at = replay(run, site, VEHICLE), 9
    most_m, least_m = -np.inf, np.inf
    for name in sorted(satellites.filter(pl.col("used"))["sv"].unique()):
        reached = _undetected_m(run, site, clean, name, at)
        most_m, least_m = max(most_m, *reached), min(least_m, *reached)
    assert high_m[at] == pytest.approx(most_m, abs=0.02)
    assert low_m[at] == pytest.approx(least_m, abs=0.02)


def _undetected_m(run: RunLog, site: Site, clean: RunTables, sv: str, at: int) -> list[float]:
    """Where the sum of squares, a parabola through three replays, meets the threshold; what the position does there."""
    before = clean.epochs.filter(solution="gps")
    sums, moved = [before["pseudorange_value"][at]], [0.0]
    for times in (1.0, 2.0):
        fault = {"kind": "step", "target": sv, "start_s": float(at), "duration_s": 0.5, "size_m": times}
        spec = FaultSpec.model_validate(fault | {"solution": "gps"})
        after = replay(inject(run, spec, site), site, VEHICLE).epochs.filter(solution="gps")
        sums.append(after["pseudorange_value"][at])
        moved.append(after["path_m"][at] - before["path_m"][at])
    a, b, c = np.polyfit([0.0, 1.0, 2.0], sums, 2)
    return [float(end * moved[1]) for end in np.roots([a, b, c - before["pseudorange_threshold"][at]])]


def test_a_second_solution_without_the_fault_holds_it(sky: tuple[RunLog, Site]) -> None:
    # A bank that forgets within seconds holds little by itself.
    chosen = {"monitors": {"channel_reference": "gps", "disabled": ["along_ewma_0p01", "along_ewma_0p001"]}}
    one = Configuration.model_validate({"undetected": {"solutions_at_fault": "one"}} | chosen)
    held, epoch, monitored = since_the_start(*sky, VEHICLE, one)
    free, _, _ = since_the_start(*sky, VEHICLE, Configuration.model_validate(chosen))
    channel = monitored.singles["channel"]
    room = (channel.threshold - channel.value)[epoch]
    assert (held <= room + 1e-9).all()
    assert (held <= free + 1e-9).all()
    assert (held < free - 0.5).any()
