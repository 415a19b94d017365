"""Small runs whose tables stay as they are, compared value by value; and whether they cover what can happen.

To regenerate after a change that is meant: delete `tests/golden/expected`, run the tests twice (the first run
writes the tables and fails on purpose), and give the reason under "Results change" in the changelog.
"""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from datasets.scenario import Scenario, load_scenario
from datasets.trial import write_trial
from pipeline import replay
from pipeline.diff import compare_tables
from pipeline.ingest import read_run
from pipeline.site.read import read_site
from schemas.config import Configuration, Vehicle
from schemas.enums import Hazard, NotEvaluated, PassageStatus
from schemas.run import RunTables
from schemas.tables import BANK_MONITORS, MONITORS, TABLES

HERE = Path(__file__).parent
EXPECTED = HERE / "expected"
SCENARIO = HERE / "golden.toml"
COMPARED = ("hazards", "passages", "alarms", "runs", "epochs")
BANK_OFF = {"monitors": {"disabled": [*BANK_MONITORS, "link_order", "link_distance", "along_doppler"]}}
CONFIGS = {
    "windows_only_late": BANK_OFF,
    "windows_only_early": BANK_OFF,
    "two_solutions": {"monitors": {"channel_reference": "galileo"}},
}
RUNS = [run.id for run in load_scenario(SCENARIO).runs]
# Digests follow the input files' bytes, which a new version of a library may write differently.
NOT_COMPARED = ["input_digest", "config_digest", "software"]
# Computed only where asked for, and held by tests/undetected.
ASKED_FOR = "^(undetected|t_undetected|physical_spacing)_.*$"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(SCENARIO)


@pytest.fixture(scope="module")
def replayed(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> dict[str, RunTables]:
    folder = tmp_path_factory.mktemp("golden")
    paths = write_trial(scenario, folder)
    site = read_site(folder / "site")
    vehicle = scenario.vehicle or Vehicle()
    tables = {}
    for path in paths:
        config = Configuration.model_validate(CONFIGS.get(path.stem, {}))
        tables[path.stem] = replay(read_run(path, config.ingest), site, vehicle, config)
    return tables


def table(tables: RunTables, name: str) -> pl.DataFrame:
    frame: pl.DataFrame = getattr(tables, name).select(pl.exclude(ASKED_FOR))
    return frame.drop(NOT_COMPARED) if name == "runs" else frame


@pytest.mark.parametrize("run_id", RUNS)
def test_tables_are_what_they_were(run_id: str, replayed: dict[str, RunTables]) -> None:
    folder = EXPECTED / run_id
    fresh = not folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    differences = []
    for name in COMPARED:
        frame, file = table(replayed[run_id], name), folder / f"{name}.parquet"
        if fresh:
            frame.write_parquet(file, compression="zstd", compression_level=19)
        elif not file.exists():
            differences.append(f"{name}: no expected table")
        else:
            differences += compare_tables(pl.read_parquet(file), frame, TABLES[name])
    assert not fresh, f"no expected tables for {run_id}: written now, look at them and run again"
    assert not differences


def test_every_table_keeps_the_ranges_of_its_contract(replayed: dict[str, RunTables]) -> None:
    for tables in replayed.values():
        for name, schema in TABLES.items():
            schema.validate(getattr(tables, name))


def test_every_class_status_and_monitor_happens_somewhere(replayed: dict[str, RunTables]) -> None:
    hazards, statuses, failing = set(), set(), set()
    for tables in replayed.values():
        hazards |= set(tables.hazards["hazard"])
        statuses |= set(tables.passages["status"])
        failing |= {name for name in MONITORS if (tables.epochs[f"{name}_state"] == "fail").any()}
    # A wrong track needs a world with two tracks and a truth on one of them: tests/judge holds it.
    assert hazards == {item.value for item in Hazard} - {Hazard.VB_WRONG_TRACK.value}
    assert {item.value for item in PassageStatus} - statuses == set()
    assert set(MONITORS) - failing == set()


def test_every_reason_of_a_monitor_is_of_the_closed_set(replayed: dict[str, RunTables]) -> None:
    known = {reason.value for reason in NotEvaluated}
    found = {
        reason
        for tables in replayed.values()
        for name in MONITORS
        for reason in tables.epochs[f"{name}_reason"].drop_nulls().unique()
    }
    assert found <= known
    assert len(found) > 5
