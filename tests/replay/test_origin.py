"""What a replay makes of an odometer by where it comes from, and of one that is made of the positions."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest

from pipeline.stages.track.geodesy import SEMI_MAJOR_AXIS_M
from schemas.arrays import floats, times_ns
from schemas.config import Vehicle
from schemas.enums import NotEvaluated, Origin
from schemas.monitors import BANK_MONITORS
from schemas.run import RunLog, RunTables
from schemas.words import verdict_figures_words
from tests.replay.journeys import VEHICLE, journey, replay

ALONG = [name for name in (*BANK_MONITORS, "along_doppler") if name.startswith("along_")]
SLOW = {"speed_mps": 20.0}
FAST = {"speed_mps": 28.0, "hold_s": 60.0}
MOTION: dict[str, Any] = {
    "start_m": 200.0,
    "phases": [SLOW, {"speed_mps": 28.0, "hold_s": 60.0}, {"stop_at_m": 8000.0}],
}
GNSS: dict[str, Any] = {"rate_hz": 5.0}


def said(run: RunLog, origin: Origin | None) -> RunLog:
    assert run.odometer is not None
    return run.with_streams(odometer=run.odometer.with_columns(origin=pl.lit(origin, dtype=pl.Enum(Origin))))


def replayed(origin: Origin | None, vehicle: Vehicle = VEHICLE, *faults: dict[str, Any]) -> RunTables:
    run, site = journey(*faults, gnss=GNSS, motion=MOTION)
    return replay(said(run, origin), site, vehicle)


def row(tables: RunTables) -> dict[str, Any]:
    return tables.runs.row(0, named=True)


def of_positions(run: RunLog) -> RunLog:
    """The odometer that a script makes of a logger's positions: lengths of their steps, declared to be a wheel."""
    latitude, longitude = (np.radians(floats(run.gnss, f"{axis}_deg")) for axis in ("latitude", "longitude"))
    north_m = SEMI_MAJOR_AXIS_M * np.diff(latitude)
    east_m = SEMI_MAJOR_AXIS_M * np.cos(latitude[1:]) * np.diff(longitude)
    speed_mps = np.hypot(north_m, east_m) / (np.diff(times_ns(run.gnss)) * 1e-9)
    assert run.odometer is not None
    copied = run.gnss[1:].select("t", speed_mps=pl.Series(speed_mps), sensor=pl.lit("primary"))
    columns = run.odometer.columns
    return run.with_streams(odometer=pl.concat([run.odometer.head(0), copied], how="diagonal").select(columns))


@pytest.mark.parametrize("origin", [Origin.WHEEL, Origin.RADAR, Origin.INERTIAL])
def test_a_declared_sensor_free_of_the_gnss_may_prove_a_run_safe(origin: Origin) -> None:
    found = row(replayed(origin))
    assert found["odometer_origin"] == origin
    assert found["odometer_follows"] > 0.5
    assert not {"odometer_origin_unknown", "odometer_follows_gnss"} & set(found["reasons"])
    assert found["verdict"] == "safe"
    assert "provided that the odometer is" in verdict_figures_words(found)


@pytest.mark.parametrize("origin", [None, Origin.UNKNOWN])
def test_of_unknown_origin_it_monitors_and_proves_no_run_safe(origin: Origin | None) -> None:
    tables = replayed(origin)
    found = row(tables)
    assert (found["odometer_origin"], found["verdict"]) == ("unknown", "unproven")
    assert "odometer_origin_unknown" in found["reasons"]
    assert found["remedies"][0] == "odometer_origin"
    assert (tables.epochs["along_raw_state"] == "pass").any()
    assert "provided" not in verdict_figures_words(found)


def test_the_vehicle_file_declares_what_the_run_does_not_say() -> None:
    vehicle = VEHICLE.model_copy(update={"odometer_origin": Origin.WHEEL})
    assert row(replayed(None, vehicle))["verdict"] == "safe"
    assert row(replayed(Origin.GNSS, vehicle))["verdict"] == "unproven"


@pytest.mark.parametrize("origin", [Origin.GNSS, Origin.FUSED])
def test_of_the_gnss_no_monitor_along_the_track_passes(origin: Origin) -> None:
    tables = replayed(origin)
    found = row(tables)
    assert (found["odometer_origin"], found["verdict"]) == (origin, "unproven")
    assert {"odometer_origin_unknown", "not_diagnosed"} <= set(found["reasons"])
    # Nobody is asked to declare a wheel where the GNSS was declared.
    assert "odometer" in found["remedies"]
    assert "odometer_origin" not in found["remedies"]
    for name in (*ALONG, "link_distance"):
        assert not (tables.epochs[f"{name}_state"] == "pass").any()
    reasons = tables.epochs.filter(pl.col("along_raw_value").is_null())["along_raw_reason"]
    assert (reasons == NotEvaluated.ODOMETER_OF_GNSS.value).mean() > 0.7
    assert (tables.epochs["cross_raw_state"] == "pass").any()
    assert not tables.epochs["tvb"].any()


def test_a_fail_against_it_still_counts() -> None:
    leap = {"kind": "step", "size_m": 150.0, "at_m": 4000.0, "duration_s": 30.0}
    tables = replayed(Origin.GNSS, VEHICLE, leap)
    assert (tables.epochs["along_raw_state"] == "fail").any()
    failing = tables.epochs.filter(pl.col("along_raw_state") == "fail")
    assert failing["along_raw_threshold"].is_not_null().all()
    assert tables.epochs["alarm"].any()


def test_one_made_of_the_positions_is_found_against_its_declaration() -> None:
    run, site = journey(gnss=GNSS, motion=MOTION)
    tables = replay(said(of_positions(run), Origin.WHEEL), site, VEHICLE)
    found = row(tables)
    assert found["odometer_origin"] == "wheel"
    assert found["odometer_follows"] < 0.15
    assert "odometer_follows_gnss" in found["reasons"]
    assert "odometer_origin_unknown" not in found["reasons"]
    assert found["verdict"] == "unproven"
    assert "copy" in found["misfits"]
    assert not (tables.epochs["along_raw_state"] == "pass").any()


def test_of_two_sensors_the_one_that_the_lds_uses_decides() -> None:
    run, site = journey(gnss=GNSS, motion=MOTION)
    wheel = said(run, Origin.WHEEL).odometer
    doppler = said(of_positions(run), Origin.GNSS).odometer
    assert wheel is not None
    assert doppler is not None
    both = pl.concat([wheel, doppler.with_columns(sensor=pl.lit("receiver"))]).sort("t", maintain_order=True)
    found = row(replay(run.with_streams(odometer=both), site, VEHICLE))
    assert (found["odometer_origin"], found["verdict"]) == ("wheel", "safe")


def test_without_an_odometer_there_is_no_origin() -> None:
    run, site = journey(gnss=GNSS, motion=MOTION)
    found = row(replay(run.with_streams(odometer=None), site, VEHICLE))
    assert (found["odometer_origin"], found["odometer_follows"]) == (None, None)
    assert "odometer_origin_unknown" not in found["reasons"]


@pytest.mark.parametrize(("origin", "known"), [(Origin.WHEEL, True), (None, False), (Origin.GNSS, False)])
def test_only_an_independent_odometer_tells_motion(origin: Origin | None, known: bool) -> None:
    run, site = journey(gnss=GNSS, motion=MOTION)
    tables = replay(said(run, origin).with_streams(reference=None), site, VEHICLE)
    assert tables.epochs["moving"].is_not_null().any() is known
    assert (row(tables)["availability"] is not None) is known
