"""Receivers whose errors come from geometry, and what surroundings do to them, up to the replay."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

import datasets
from datasets.scenario import Scenario, load_scenario
from datasets.trial import build_run, build_site
from pipeline.one_run import replay
from schemas.run import RunLog, RunTables
from tests.datasets.small import BOTH, scenario


def run_with(*faults: dict[str, Any], **sky: Any) -> RunLog:
    spec = scenario({"faults": list(faults), "gnss": {"sky": {**BOTH, **sky}}})
    return build_run(spec, spec.runs[0])


def solution(run: RunLog, name: str) -> pl.DataFrame:
    return run.gnss.filter(pl.col("solution") == name)


def test_two_constellations_are_better_than_one() -> None:
    run = run_with()
    both, gps = solution(run, "primary"), solution(run, "gps")
    assert both["t"].equals(gps["t"])
    for column in ("cov_ee_m2", "cov_nn_m2", "cov_uu_m2", "hpl_m", "vpl_m"):
        assert (both[column] < gps[column]).all()
    assert (both["satellites"] > gps["satellites"]).all()


def test_protection_of_precision_approach_has_the_smaller_factor() -> None:
    levels = [run_with(protection=kind).gnss["hpl_m"].to_numpy() for kind in ("pa", "npa")]
    assert levels[1] / levels[0] == pytest.approx(6.18 / 6.0)


def test_satellites_stream_is_what_the_solution_used() -> None:
    run = run_with()
    assert run.satellites is not None
    counted = run.satellites.filter("used").group_by("t", "solution").len("satellites")
    stated = run.gnss.select("t", "solution", "satellites").with_columns(pl.col("satellites").cast(pl.UInt32))
    assert counted.sort("t", "solution").equals(stated.sort("t", "solution"))
    assert (run.satellites["elevation_deg"] >= 5.0).all()
    assert (run.satellites.filter(pl.col("solution") == "gps")["sv"].str.starts_with("G")).all()


def test_a_tunnel_takes_every_solution_and_only_there() -> None:
    run = run_with({"kind": "outage", "target": "satellites", "at_m": 1200.0, "until_m": 1600.0})
    assert run.faults is not None
    begin, end = run.faults.select("t_start", "t_end").row(0)
    assert run.gnss.filter((pl.col("t") >= begin) & (pl.col("t") < end)).is_empty()
    assert (end - begin).total_seconds() == pytest.approx(400.0 / 25.0, abs=0.15)
    lost = round((end - begin).total_seconds() * 10)
    assert run_with().gnss.height - run.gnss.height == 2 * lost


def test_a_constellation_that_fails_leaves_the_other_solution_as_it_was() -> None:
    hit = run_with({"kind": "outage", "target": "galileo", "start_s": 40.0, "duration_s": 30.0})
    clean = run_with()
    assert solution(hit, "gps").equals(solution(clean, "gps"))
    within = solution(hit, "primary").slice(400, 300)
    assert within["hpl_m"].equals(solution(hit, "gps").slice(400, 300)["hpl_m"])


def test_multipath_touches_its_sector_alone() -> None:
    sector = {"below_deg": 35.0, "azimuth_deg": [300.0, 60.0], "at_m": 1000.0, "until_m": 1500.0}
    hit = run_with({"kind": "bias", "target": "satellites", "size_m": 10.0, **sector})
    clean = run_with()
    assert hit.satellites is not None
    assert clean.satellites is not None
    pairs = hit.satellites.join(clean.satellites, on=["t", "solution", "sv"], suffix="_clean")
    changed = (pairs["residual_m"] - pairs["residual_m_clean"]).abs() > 1e-9
    angle = (pairs["azimuth_deg"] - 300.0) % 360.0
    inside = (pairs["elevation_deg"] < 35.0) & (angle <= 120.0)
    assert changed.any()
    largest = pairs.filter(changed & inside)["residual_m"].mean()
    others = pairs.filter(changed & ~inside)["residual_m"].mean()
    assert largest > 1.0 > others  # type: ignore[operator]


@pytest.fixture(scope="module")
def local() -> Scenario:
    return load_scenario(Path(datasets.__file__).parent / "scenarios" / "satellites.toml")


def replayed(spec: Scenario, run_id: str) -> RunTables:
    run = build_run(spec, next(run for run in spec.runs if run.id == run_id))
    return replay(run, build_site(spec), spec.vehicle)


def test_clean_ranges_raise_no_alarm(local: Scenario) -> None:
    tables = replayed(local, "clean")
    assert tables.alarms.is_empty()
    assert tables.hazards.is_empty()
    assert set(tables.passages["status"]) == {"accepted"}
    # In the first second no track is claimed yet.
    later = tables.epochs.filter(pl.col("t") >= pl.col("t").min() + pl.duration(seconds=1))
    assert set(later["pseudorange_state"]) == {"pass"}


def test_a_range_that_drifts_is_seen_before_the_position_fails(local: Scenario) -> None:
    tables = replayed(local, "satellite_ramp")
    assert set(tables.alarms["verdict"]) == {"true"}
    assert all("pseudorange" in monitors for monitors in tables.alarms["monitors"].to_list())
    failed = tables.epochs.filter(pl.col("error_along_m").abs() > 20.0)
    first_alarm = dict(tables.alarms.group_by("solution").agg(pl.col("t_start").min()).iter_rows())
    assert failed.height > 0
    assert all(t > first_alarm[name] for t, name in failed.select("t", "solution").iter_rows())


def test_a_balise_in_a_tunnel_is_not_available(local: Scenario) -> None:
    statuses = replayed(local, "tunnel").passages
    lost = statuses.filter(pl.col("status") == "not_available")
    assert lost["balise_id"].to_list() == ["VB05", "VB05"]
    assert set(statuses.filter(pl.col("balise_id") != "VB05")["status"]) == {"accepted"}


def test_every_run_of_the_scenario_can_be_built(local: Scenario) -> None:
    kinds = {fault.kind.value for run in local.runs for fault in run.faults}
    assert kinds >= {"ramp", "step", "noise", "bias", "outage"}
    for spec in local.runs:
        run = build_run(local, spec)
        assert np.isfinite(run.gnss["latitude_deg"].to_numpy()).all()
