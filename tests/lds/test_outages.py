"""Outages after which the position is off, through the whole replay: synthetic journeys and a real recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from datasets.comma2k19 import comma2k19_run
from datasets.faults import FaultSpec
from datasets.inject import inject_all
from datasets.scenario import Scenario
from datasets.trial import build_run, build_site
from pipeline.stages import replay
from schemas.config import AlignConfig, Configuration
from schemas.run import RunTables

SEGMENT = Path(__file__).parents[2] / ".." / "shared" / "data" / "comma2k19" / "segment"
LATE_S, EARLY_S = 300.0, 50.0


def journey(
    outage_s: float,
    offset_m: float,
    rate_hz: float,
    vehicle: bool,
    onset_s: float = LATE_S,
    shunting: bool = False,
    odometer: Callable[[pl.DataFrame], pl.DataFrame] | None = None,
) -> RunTables:
    """30 m/s over a line with curves and virtual balises every 700 m; the offset comes in the middle of the outage."""
    phases: list[dict[str, Any]] = [{"speed_mps": 30.0, "acceleration_mps2": 0.7, "hold_s": onset_s + outage_s + 60.0}]
    if shunting:
        # It turns round inside the outage: brakes from 235 s on, stands, and runs back.
        there, back = {"speed_mps": 30.0, "hold_s": 180.0}, {"speed_mps": -20.0, "hold_s": 120.0}
        phases = [{"acceleration_mps2": 0.7} | phase for phase in (there, {"speed_mps": 0.0, "hold_s": 5.0}, back)]
    faults: list[dict[str, Any]] = []
    if outage_s:
        faults = [{"kind": "outage", "target": "position", "start_s": onset_s, "duration_s": outage_s}]
    if offset_m:
        faults.append({"kind": "step", "target": "along", "start_s": onset_s + outage_s / 2, "size_m": offset_m})
    run: dict[str, Any] = {"id": "run", "vehicle": vehicle, "faults": faults}
    run |= {"motion": {"start_m": 300.0, "phases": phases}, "reference": {"rate_hz": 1.0}}
    run |= {"gnss": {"rate_hz": rate_hz, "latency_s": 0.08}, "odometer": {"rate_hz": 10.0, "scale": 1.003}}
    sections = [{"length_m": 1500.0}, {"length_m": 700.0, "radius_m": 1800.0}]
    scenario = Scenario.model_validate(
        {
            "name": "outages",
            "seed": 5,
            "vehicle": {
                "odometer_scale": 1.003,
                "odometer_scale_sigma": 1e-4,
                "gnss_latency_s": 0.08,
                "gnss_latency_sigma_s": 0.003,
            },
            "line": {
                "heading_deg": 60.0,
                "sections": sections,
                "elements": [{"id": f"NE{i}", "length_m": 3000.0} for i in range(9)],
                "balises": [{"id": f"VB{i:02}", "at_m": 600.0 + 700.0 * i} for i in range(35)],
            },
            "runs": [run],
        }
    )
    spec = scenario.runs[0]
    log = build_run(scenario, spec)
    if odometer is not None and log.odometer is not None:
        log = log.with_streams(odometer=odometer(log.odometer))
    return replay(log, build_site(scenario), scenario.vehicle if vehicle else None)


def unsafe(tables: RunTables) -> int:
    return int(tables.runs["unsafe_accepted"][0])


@pytest.mark.parametrize("vehicle", [True, False])
@pytest.mark.parametrize(("outage_s", "rate_hz"), [(50.0, 1.0), (50.0, 10.0), (90.0, 1.0), (90.0, 10.0), (300.0, 1.0)])
def test_an_offset_that_came_inside_an_outage_is_seen_where_the_position_comes_back(
    outage_s: float, rate_hz: float, vehicle: bool
) -> None:
    healthy = journey(outage_s, 0.0, rate_hz, vehicle)
    assert healthy.alarms.is_empty()
    first = healthy.epochs.filter(pl.col("path_m").is_not_null() & pl.col("exposure_s").gt(outage_s - 2.0)).row(
        0, named=True
    )
    assert (first["link_distance_state"], first["link_distance_threshold"] < 20.0) == ("pass", True)
    for offset_m in (25.0, 100.0):
        tables = journey(outage_s, offset_m, rate_hz, vehicle)
        found = tables.alarms.filter(pl.col("monitors").list.contains("link_distance"))
        assert found["t_start"].to_list() == [first["t"]]
        assert unsafe(tables) == 0
        assert tables.runs["missed_detections"][0] == 0


def test_a_turn_inside_the_outage() -> None:
    assert journey(90.0, 0.0, 1.0, True, onset_s=200.0, shunting=True).alarms.is_empty()
    tables = journey(90.0, 30.0, 1.0, True, onset_s=200.0, shunting=True)
    assert tables.alarms["monitors"].to_list() == [["link_distance"]]
    assert unsafe(tables) == 0


def test_before_the_scale_is_learned_nothing_can_tell_and_the_run_says_so() -> None:
    for offset_m in (0.0, 30.0):
        tables = journey(90.0, offset_m, 1.0, False, onset_s=EARLY_S)
        assert tables.alarms.is_empty()
        reasons = tables.epochs["link_distance_reason"].drop_nulls()
        assert reasons.str.contains("too far from the last validated position").any()
        assert "nothing could tell whether the position had moved" in tables.runs["notes"][0]


def _seconds() -> pl.Expr:
    return (pl.col("t") - pl.col("t").min()).dt.total_nanoseconds() * 1e-9


def _speed_alone_with_a_pause(odometer: pl.DataFrame) -> pl.DataFrame:
    """20 s at 30 m/s are lost."""
    speed = odometer.with_columns(distance_m=pl.lit(None, pl.Float64))
    return speed.filter(~_seconds().is_between(LATE_S, LATE_S + 20.0))


def _slip_that_is_reported(odometer: pl.DataFrame) -> pl.DataFrame:
    """A wheel turns 40 m too far within 2 s, and says so."""
    too_far_m = 20.0 * (_seconds() - LATE_S).clip(0.0, 2.0)
    return odometer.with_columns(
        distance_m=pl.col("distance_m") + too_far_m, slip=_seconds().is_between(LATE_S, LATE_S + 2.1)
    )


@pytest.mark.parametrize("odometer", [_speed_alone_with_a_pause, _slip_that_is_reported])
@pytest.mark.parametrize("vehicle", [True, False])
def test_a_way_that_the_odometer_lost_is_no_alarm(
    odometer: Callable[[pl.DataFrame], pl.DataFrame], vehicle: bool
) -> None:
    tables = journey(0.0, 0.0, 1.0, vehicle, odometer=odometer)
    assert tables.alarms.is_empty()
    reasons = tables.epochs["link_distance_reason"]
    assert (reasons == "odometer distance lost since the last validated position").sum() == 12
    assert tables.epochs["tvb"].tail(30).all()


@pytest.mark.skipif(not SEGMENT.exists(), reason="the public recordings are not beside the project")
@pytest.mark.parametrize("gap_reset_s", [5.0, 60.0])
def test_on_the_noise_of_a_real_recording(gap_reset_s: float) -> None:
    """A car for a minute, scale and latency learned on the way; the bank restarts after the outage, or bridges it."""
    run, site = comma2k19_run(SEGMENT, [150.0, 300.0, 500.0, 700.0])
    config = Configuration(align=AlignConfig(gap_reset_s=gap_reset_s))
    outage = FaultSpec.model_validate({"kind": "outage", "target": "position", "start_s": 28.0, "duration_s": 15.0})
    assert replay(inject_all(run, [outage], site), site, config=config).alarms.is_empty()
    for size_m in (-40.0, 25.0, 60.0):
        step = FaultSpec.model_validate({"kind": "step", "target": "along", "start_s": 33.0, "size_m": size_m})
        tables = replay(inject_all(run, [outage, step], site), site, config=config)
        [monitors] = tables.alarms["monitors"].to_list()
        assert "link_distance" in monitors
        assert (monitors == ["link_distance"]) is (gap_reset_s == 5.0)
        assert not tables.epochs.filter(pl.col("t") >= tables.alarms["t_start"][0])["tvb"].any()
