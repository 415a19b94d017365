"""`balise experiment recorded` from end to end: the same bytes again, resumed, and what it refuses."""

from __future__ import annotations

import shutil
from pathlib import Path

import polars as pl
import pytest

from datasets.experiment.recorded import command
from datasets.experiment.recorded.command import ExperimentResult, recorded_experiment
from datasets.trial import write_run_log, write_site
from schemas.config import Configuration, to_toml
from schemas.errors import BaliseError
from schemas.experiment import EXPERIMENT_TABLES
from schemas.run import RunLog
from tests.experiment.recorded.conftest import Journey

RAMPS = '[[faults]]\nkind = "ramp"\nrates_mps = [0.5]\n'
TWO_BANKS = '[[banks]]\nname = "default"\nconfig = "a.toml"\n[[banks]]\nname = "deaf"\nconfig = "b.toml"\n'


class Bench:
    """A site and runs on disk, and the command on them."""

    def __init__(self, folder: Path, journey: Journey) -> None:
        self.folder = folder
        self._run = journey.run
        write_site(journey.site, folder / "site")
        (folder / "vehicle.toml").write_text(to_toml(journey.vehicle))
        (folder / "a.toml").write_text("")
        (folder / "b.toml").write_text('[monitors]\ndisabled = ["along_ewma_0p1"]\n')

    said: list[str]

    def run(self, plan: str, out: str = "out", run: RunLog | None = None) -> ExperimentResult:
        self.said = []
        write_run_log(run or self._run, self.folder / "runs")
        (self.folder / "plan.toml").write_text(plan)
        runs = [str(self.folder / "runs")]
        vehicle = self.folder / "vehicle.toml"
        places = (str(self.folder / "site"), self.folder / out, self.folder / "plan.toml", vehicle)
        return recorded_experiment(runs, *places, Configuration(), None, None, "primary", 1, self.said.append)


@pytest.fixture(scope="module")
def bench(journey: Journey, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("recorded"), journey)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_two_banks_on_the_same_faults(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = "per_cell = 1\n" + RAMPS + TWO_BANKS
    made = bench.run(plan)
    injections = made.tables["injections"]
    assert made.failed == {}
    (estimate,) = bench.said
    assert estimate.startswith("4 injections, about ")
    assert injections.group_by("bank").len().sort("bank")["len"].to_list() == [2, 2]
    fast, deaf = (injections.filter(bank=bank).sort("injection_id") for bank in ("default", "deaf"))
    assert fast["t_onset"].equals(deaf["t_onset"])
    assert (deaf["time_to_detect_s"] > fast["time_to_detect_s"]).all()
    for name, table in made.tables.items():
        assert table.columns == EXPERIMENT_TABLES[f"experiment_{name}"].column_names()

    first = contents(bench.folder / "out")
    assert {"index.html", "pmd_default_along.svg", "time_to_detect_along.svg", "line_deaf.svg"} <= first.keys()
    bench.run(plan, "again")
    assert contents(bench.folder / "again") == first

    def never(*_: object) -> None:
        raise AssertionError("replayed again")

    monkeypatch.setattr(command, "inject_fault", never)
    bench.run(plan)
    assert contents(bench.folder / "out") == first


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ("per_sell = 3\n" + RAMPS, r"unknown key `per_sell` \(did you mean `per_cell`"),
        (RAMPS.replace("0.5", "0.0"), "greater than 0, found 0.0"),
        (RAMPS.replace("ramp", "noise"), "a plan takes faults of kind"),
        (RAMPS.replace("rates_mps", "sizes_m"), "a fault of kind ramp needs rates_mps; found sizes_m"),
        (RAMPS + RAMPS, "given more than once: ramp along 0.5 m/s ahead"),
        (
            "per_cell = 500\n" + RAMPS,
            r"ramp along 0.5 m/s ahead: has no room .* found room for \d+, each watched for 170",
        ),
        ("after_s = 3000.0\n" + RAMPS, "no run has room for any fault of the plan"),
        (RAMPS.replace("kind", 'target = "satellite"\nkind'), "no run has room for any fault"),
        (
            "per_cell = 2\n" + RAMPS + RAMPS.replace("kind", 'target = "satellite"\nkind'),
            "no run has satellites beside",
        ),
    ],
)
def test_plans_that_cannot_be_met(bench: Bench, plan: str, message: str) -> None:
    plan = plan if "per_cell" in plan else "per_cell = 2\n" + plan
    with pytest.raises(BaliseError, match=message):
        bench.run(plan, "refused")
    assert not (bench.folder / "refused" / "cells.parquet").exists()


def test_runs_that_cannot_be_used(bench: Bench, journey: Journey) -> None:
    faults = pl.DataFrame(
        {"t_start": [0], "t_end": [1], "kind": ["ramp"], "target": ["along"], "size": [1.0], "rate": [1.0]}
    )
    stamps = [pl.col(name).cast(pl.Datetime("ns", "UTC")) for name in ("t_start", "t_end")]
    with pytest.raises(BaliseError, match="holds injected faults already"):
        bench.run(RAMPS, run=journey.run.with_streams(faults=faults.with_columns(stamps)))
    slips = '[[faults]]\nkind = "slip"\nrates_mps = [0.5]\nduration_s = 20.0\n'
    with pytest.raises(BaliseError, match="no odometer that is declared to be free of the GNSS; found no odometer"):
        bench.run("per_cell = 1\n" + slips + RAMPS, run=journey.run.with_streams(odometer=None))
    assert journey.run.odometer is not None
    unsaid = journey.run.odometer.with_columns(origin=pl.lit(None, journey.run.odometer.schema["origin"]))
    with pytest.raises(BaliseError, match="no odometer that is declared to be free of the GNSS; found unknown"):
        bench.run(RAMPS, run=journey.run.with_streams(odometer=unsaid))


def test_a_copy_of_a_run_is_no_further_pass(bench: Bench) -> None:
    whole = bench.run("per_cell = 1\n" + RAMPS, "whole")
    (folder,) = (bench.folder / "runs").iterdir()
    shutil.copytree(folder, folder.with_name("zz_copy"))
    try:
        made = bench.run("per_cell = 1\n" + RAMPS, "copied")
    finally:
        shutil.rmtree(folder.with_name("zz_copy"))
    assert list(made.failed) == ["zz_copy"]
    assert "the same bytes as" in made.failed["zz_copy"]
    assert made.tables["cells"].equals(whole.tables["cells"])
    assert made.tables["banks"].equals(whole.tables["banks"])
