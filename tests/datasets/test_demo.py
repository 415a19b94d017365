"""The demonstration finds what it injects, and its comparison can say no."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import polars as pl
import pytest

import cli
from datasets.comparison import checks_table, compare_run, describe_faults
from datasets.demo import DemoResult, demo_scenario, make_demo
from datasets.trial import build_run, build_site
from pipeline import replay
from pipeline.campaign.verify import verify, verify_by_replay
from pipeline.show.terminal import table_lines, to_json
from schemas.config import Vehicle, load_settings
from schemas.run import RunTables
from tests.conftest import work_here
from tests.docs.json_page import fields, places


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> DemoResult:
    with pytest.MonkeyPatch.context() as patch:
        work_here(patch)
        return make_demo(tmp_path_factory.mktemp("demo"))


@pytest.mark.usefixtures("in_process")
def test_the_demo_verifies(result: DemoResult) -> None:
    """Its own files, and every log replayed again as `balise verify --logs` does it."""
    tables = result.page.parents[1]
    folder = tables.parent
    assert verify(tables).problems == ()
    vehicle = load_settings(folder / "vehicle.toml", Vehicle)
    logs = [str(folder / "runs" / run) for run in ("clean.mcap", "odometer_scale")]
    again = verify_by_replay(tables, logs, folder / "site", None, vehicle)
    assert (again.problems, again.compared) == ((), f"2 of {len(result.tables)} runs replayed again")


@pytest.mark.usefixtures("in_process")
def test_the_demo_is_a_project_that_is_up_to_date(
    result: DemoResult, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(result.page.parents[2])
    assert cli._run_guarded(["run", "--jobs", "1"], debug=False) == 0
    assert "All was up to date." in capfd.readouterr().out
    assert cli._run_guarded(["verify"], debug=False) == 0


def test_the_replay_finds_what_was_injected(result: DemoResult) -> None:
    differs = result.checks.filter(~pl.col("agrees"))
    assert differs.rows() == []
    assert result.agrees


def test_its_answer_in_json_has_the_fields_of_the_page(result: DemoResult) -> None:
    answer = json.loads(to_json({"out": "demo", **result.as_dict()}))
    assert set(places(answer, fields("demo"))) == set(fields("demo"))


def test_another_seed_shows_the_same() -> None:
    """Every other run; files and pages are as those of the first, and need not be made."""
    scenario = demo_scenario(seed=1)
    site = build_site(scenario)
    assert scenario.vehicle is not None
    checks = []
    for spec in scenario.runs[::2]:
        run = build_run(scenario, spec)
        checks += compare_run(spec, run, replay(run, site, scenario.vehicle if spec.vehicle else Vehicle()))
    assert checks_table(checks).filter(~pl.col("agrees")).rows() == []


def test_the_demo_line_is_long_and_hilly_and_its_balises_are_spaced_as_on_railways() -> None:
    line = demo_scenario().line
    assert sum(element.length_m for element in line.elements) >= 25_000
    assert len(line.elements) >= 3
    assert len({section.grade for section in line.sections}) >= 3
    places = sorted(balise.at_m for balise in line.balises)
    assert len(places) >= 10
    assert all(600.0 <= b - a <= 2500.0 for a, b in pairwise(places))
    assert {run.log for run in demo_scenario().runs} >= {"json", "parquet"}


def tables_of(result: DemoResult, run_id: str) -> RunTables:
    return next(tables for tables in result.tables if tables.run_id == run_id)


@pytest.mark.parametrize(
    ("run_id", "spoil"),
    [
        ("jump_two", {"hazards": lambda t: t.head(1)}),
        ("jump_two", {"hazards": lambda t: t.with_columns(detected=pl.lit(False))}),
        (
            "jump_two",
            {
                "hazards": lambda t: t.with_columns(
                    t_onset=pl.col("t_onset") + pl.duration(milliseconds=300, time_unit="ns")
                )
            },
        ),
        ("clean", {"passages": lambda t: t.head(5)}),
        ("clean", {"passages": lambda t: pl.concat([t, t.head(1)])}),
        ("outage", {"passages": lambda t: t.with_columns(status=pl.lit("accepted", t["status"].dtype))}),
        ("slip", {"alarms": lambda t: t.clear()}),
        ("odometer_scale", {"runs": lambda t: t.with_columns(odometer_scale=pl.lit(1.002))}),
        ("clean", {"runs": lambda t: t.with_columns(status=pl.lit("partial", t["status"].dtype))}),
    ],
)
def test_a_spoilt_result_differs(result: DemoResult, run_id: str, spoil: dict) -> None:  # type: ignore[type-arg]
    scenario = result.scenario
    spec = next(run for run in scenario.runs if run.id == run_id)
    run, tables = build_run(scenario, spec), tables_of(result, run_id)
    assert checks_table(compare_run(spec, run, tables))["agrees"].all()
    spoilt = replace(tables, **{name: change(getattr(tables, name)) for name, change in spoil.items()})
    assert not checks_table(compare_run(spec, run, spoilt))["agrees"].all()


def test_the_ending_is_one_line_per_run_and_a_sentence(result: DemoResult) -> None:
    lines = result.lines
    assert lines["run_id"].to_list() == [run.id for run in result.scenario.runs]
    table = table_lines(lines)
    assert (len(table), max(map(len, table)) <= 80) == (13, True)
    of = dict(lines.select("run_id", "verdict").iter_rows())
    assert (of["clean"], of["jump_one_no_odometer"]) == ("safe", "unsafe")
    assert "step along +1300 m" in lines["injected"].to_list()
    assert result.sentence == f"all {result.checks.height} checks agree"
    wrong = replace(result, checks=result.checks.with_columns(agrees=pl.int_range(pl.len()) > 1))
    assert wrong.sentence == f"2 of {result.checks.height} checks do not agree"
    assert wrong.lines["checks"][0].startswith("4/6")


def test_faults_in_words(result: DemoResult) -> None:
    words = dict(result.checks.select("run_id", "injected").unique().iter_rows())
    assert words["clean"] == "none"
    assert words["jump_two"] == "step along +1300 m for 3 s"
    assert describe_faults(None) == "none"
