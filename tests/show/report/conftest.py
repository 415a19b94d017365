"""A small campaign on disk with its report, and a browser to open it in."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl
import pytest

from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site
from pipeline.one_run import replay
from pipeline.results.store import write_config, write_run
from pipeline.show.report import write_report
from pipeline.stages.prepare import Provenance
from pipeline.stages.run_row.summary import failed_row
from schemas.config import Configuration, Vehicle
from schemas.run import RunTables, Site
from schemas.tables import TABLES

if TYPE_CHECKING:
    from selenium.webdriver import Chrome

RUNS = ("jump_two", "drift_early", "jump_one_no_odometer")
FAILED = "broken & <b>odd</b>"
REASON = "gnss.parquet: column t: not in order"
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--disable-dev-shm-usage",
    "--window-size=1300,900",
)  # fmt: skip


def empty_tables(run_id: str, runs: pl.DataFrame) -> RunTables:
    frames = {name: schema.create_empty() for name, schema in TABLES.items()}
    return RunTables(run_id, **(frames | {"runs": runs}))


@pytest.fixture(scope="session")
def site() -> Site:
    return build_site(demo_scenario())


@pytest.fixture(scope="session")
def replayed(site: Site) -> dict[str, RunTables]:
    """Three runs of the demo; the first has its solution a second time under another name."""
    scenario, config = demo_scenario(), Configuration()
    tables: dict[str, RunTables] = {}
    for spec in scenario.runs:
        if spec.id in RUNS:
            vehicle = scenario.vehicle if spec.vehicle and scenario.vehicle else Vehicle()
            tables[spec.id] = replay(build_run(scenario, spec), site, vehicle, config)
    return tables


def twice(tables: RunTables) -> RunTables:
    """Every row again as another solution, whose name needs care in addresses and HTML."""
    frames = {
        name: pl.concat([getattr(tables, name), getattr(tables, name).with_columns(solution=pl.lit("egnos v2 & <3"))])
        for name in TABLES
    }
    return RunTables(tables.run_id, **frames)


@pytest.fixture(scope="session")
def out(replayed: dict[str, RunTables], site: Site, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder with a report for the site."""
    folder = tmp_path_factory.mktemp("report") / "out"
    for run_id, tables in replayed.items():
        write_run(twice(tables) if run_id == "drift_early" else tables, folder, {"software": "test"})
    failed = failed_row(REASON, Provenance("c", "i", "test"))
    write_run(empty_tables(FAILED, failed), folder, {"software": "test"})
    write_config(folder, Configuration())
    write_report(folder, site)
    return folder


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chrome]:
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no chromium and chromedriver on the PATH (Debian: chromium, chromium-driver)")
    pytest.importorskip("selenium", reason="selenium is not installed")
    from selenium.webdriver import Chrome, ChromeOptions
    from selenium.webdriver.chrome.service import Service

    options = ChromeOptions()
    options.binary_location = chromium
    for flag in (*_FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    # Selenium would else look on the network for a driver, and report its use.
    os.environ["SE_OFFLINE"], os.environ["SE_AVOID_STATS"] = "true", "true"
    chrome = Chrome(options=options, service=Service(driver))
    chrome.set_page_load_timeout(120)
    yield chrome
    chrome.quit()
