"""A replayed run on disk, with its site and its log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site
from pipeline.one_run import replay
from pipeline.results.store import write_config, write_run
from schemas.config import Configuration
from schemas.run import RunLog, RunTables, Site


@dataclass(frozen=True)
class Result:
    """One run, `jump_two`: a jump over two balises, with a reference."""

    out: Path
    site: Site
    log: RunLog
    tables: RunTables


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    out = tmp_path_factory.mktemp("export") / "out"
    scenario = demo_scenario()
    spec = next(run for run in scenario.runs if run.id == "jump_two")
    site, log, config = build_site(scenario), build_run(scenario, spec), Configuration()
    assert scenario.vehicle is not None
    tables = replay(log, site, scenario.vehicle, config)
    write_run(tables, out, {"software": "test"})
    write_config(out, config)
    return Result(out, site, log, tables)
