"""A folder in which the commands of the documentation run as they are written: `RUN`, `SITE`, `OUT` exist there."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from datasets.experiment import diagnostics
from datasets.scenario import RunSpec, Scenario, load_scenario
from datasets.trial import build_run, build_site, write_run_log, write_site
from pipeline.campaign import make_plan
from pipeline.campaign.run import write_campaign
from pipeline.campaign.worker import replay_one
from pipeline.results.store import write_config
from pipeline.studies.safety import sensitivity
from schemas.config import Configuration, to_toml
from schemas.monitors import MONITORS
from tests.conftest import Shared
from tests.docs.blocks import ROOT

BLIND = ("windows_only_early", "windows_only_late")
WITHOUT_INPUT = ("pseudorange", "channel")
FAULTY = "jump_two"
RUNS = ("drift_early", FAULTY, "outage_and_slip")


@pytest.fixture(scope="session")
def workspace(shared: Shared) -> Path:
    """A small site, a run with faults and one without, their result, a receiver log. Not to be changed: `workplace`."""
    return shared("docs", _fill_workspace)


def _fill_workspace(folder: Path) -> None:
    scenario = _with_a_clean_run(load_scenario(ROOT / "tests/golden/golden.toml"))
    write_site(build_site(scenario), folder / "SITE")
    faulty = build_run(scenario, _spec(scenario, FAULTY))
    write_run_log(faulty.with_streams(faults=None), folder / "runs")
    shutil.copytree(folder / "runs" / FAULTY, folder / "RUN")
    write_run_log(build_run(scenario, _spec(scenario, "evening")), folder / "runs")
    assert scenario.vehicle is not None
    (folder / "vehicle.toml").write_text(to_toml(scenario.vehicle))
    _replay(folder, (FAULTY, "evening"), Configuration())
    shutil.copytree(folder / "OUT", folder / "OUT_A")
    shutil.copytree(folder / "OUT", folder / "OUT_B")
    _receiver_log(folder / "runs" / "evening", folder)
    _line(folder / "SITE", folder / "line.gpx")


@pytest.fixture(scope="session")
def asked(shared: Shared) -> Path:
    """A folder with a result `OUT` in which everything went wrong that one may ask for."""
    return shared("asked", _fill_asked)


def _fill_asked(folder: Path) -> None:
    scenario = load_scenario(ROOT / "tests/golden/golden.toml")
    write_site(build_site(scenario), folder / "SITE")
    for name in (*RUNS, *BLIND, "jump_without_odometer", "two_solutions"):
        write_run_log(build_run(scenario, _spec(scenario, name)), folder / "runs")
    (folder / "runs" / "broken").mkdir()
    (folder / "runs" / "broken" / "gnss.parquet").write_bytes(b"cut off")
    bank_off = Configuration.model_validate(
        {"monitors": {"disabled": [name for name in MONITORS if name not in WITHOUT_INPUT]}}
    )
    _replay(folder, BLIND, bank_off)
    _replay(folder, (*RUNS, "jump_without_odometer", "two_solutions", "broken"), Configuration())


@pytest.fixture
def workplace(
    workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_process: None, replayed_once: None
) -> Path:
    """A copy of the folder to work in; it is the working directory.

    The published Monte Carlo is run at a tenth of its size, and the verdict held against one other failure limit: what
    they find is the subject of `experiment/test_diagnostics.py` and `studies/safety/test_sensitivity.py`.
    """
    monkeypatch.setattr(diagnostics, "ExperimentPlan", partial(diagnostics.ExperimentPlan, span_s=1_500, onset_s=500))
    monkeypatch.setattr(sensitivity, "_VARIED", {"failure_limit_m": (0.5,)})
    folder = tmp_path / "work"
    shutil.copytree(workspace, folder)
    monkeypatch.chdir(folder)
    return folder


def _replay(folder: Path, names: Sequence[str], config: Configuration) -> None:
    """What `balise replay` leaves in `OUT`, without the seconds that its workers take to start."""
    out = str(folder / "OUT")
    plan = make_plan([str(folder / "runs" / name) for name in names], str(folder / "SITE"), out, config)
    for job in plan.jobs:
        replay_one(job)
    write_config(out, config)
    write_campaign(out, config)


def _with_a_clean_run(scenario: Scenario) -> Scenario:
    clean = _spec(scenario, FAULTY).model_copy(update={"id": "evening", "faults": ()})
    return scenario.model_copy(update={"runs": (*scenario.runs, clean)})


def _spec(scenario: Scenario, name: str) -> RunSpec:
    return next(run for run in scenario.runs if run.id == name)


def _line(site: Path, gpx: Path) -> None:
    """The line's track as somebody's GPX."""
    columns = ("latitude_deg", "longitude_deg", "height_m")
    rows = pl.read_parquet(site / "track.parquet").select(columns).iter_rows()
    points = "".join(f'<trkpt lat="{lat}" lon="{lon}"><ele>{up or 0.0}</ele></trkpt>' for lat, lon, up in rows)
    gpx.write_text(f'<gpx version="1.1"><trk><name>line</name><trkseg>{points}</trkseg></trk></gpx>')


def _receiver_log(run: Path, folder: Path) -> None:
    """`morning.ubx` and `odometer.csv`, as a receiver and a data logger would have left the run."""
    gnss = pl.read_parquet(run / "gnss.parquet").drop_nulls("latitude_deg")
    (folder / "morning.ubx").write_bytes(b"".join(_nav_pvt(row) for row in gnss.iter_rows(named=True)))
    odometer = pl.read_parquet(run / "odometer.parquet")
    odometer.select(time=pl.col("t").dt.strftime("%Y-%m-%dT%H:%M:%S%.6fZ"), km=pl.col("distance_m") / 1000).write_csv(
        folder / "odometer.csv"
    )


def _nav_pvt(row: dict[str, Any]) -> bytes:
    from pyubx2 import GET, UBXMessage

    t = row["t"]
    message = UBXMessage(
        *("NAV", "NAV-PVT", GET),
        year=t.year,
        month=t.month,
        day=t.day,
        hour=t.hour,
        min=t.minute,
        second=t.second,
        iTOW=((t.isoweekday() % 7) * 86_400 + t.hour * 3600 + t.minute * 60 + t.second + 18) * 1000,
        validDate=1,
        validTime=1,
        fullyResolved=1,
        fixType=3,
        gnssFixOk=1,
        diffSoln=1,
        numSV=11,
        lat=row["latitude_deg"],
        lon=row["longitude_deg"],
        height=round(row["height_m"] * 1000),
        velN=round(row["vel_n_mps"] * 1000),
        velE=round(row["vel_e_mps"] * 1000),
        velD=round(-row["vel_u_mps"] * 1000),
        hAcc=1414,
        vAcc=1500,
    )
    return message.serialize()
