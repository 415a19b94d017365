"""The demonstration: write the demo trial, replay it, and hold what was found against what was injected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import polars as pl

from datasets.comparison import Check, checks_table, compare
from datasets.scenario import Scenario, load_scenario, with_seed
from datasets.trial import write_trial
from pipeline.campaign.finish import write_campaign
from pipeline.figures.verdict import CampaignHead, head_of, worst_verdict
from pipeline.ingest.run import read_run
from pipeline.report import write_report
from pipeline.results.store import write_config, write_run
from pipeline.site.read import read_site
from pipeline.stages import replay
from schemas.config import Configuration, Vehicle
from schemas.run import RunLog, RunTables, Site
from schemas.version import SOFTWARE

Progress = Callable[[str], None]


@dataclass(frozen=True)
class DemoResult:
    """`checks`: one row per thing expected, as `comparison.checks_table`; `tables`: the replay of each run."""

    scenario: Scenario
    site: Site
    checks: pl.DataFrame
    tables: tuple[RunTables, ...]

    @property
    def head(self) -> CampaignHead:
        """The worst verdict of the runs, and their counts."""
        return head_of(worst_verdict(one.runs["verdict"].to_list()) for one in self.tables)

    @property
    def agrees(self) -> bool:
        return bool(self.checks["agrees"].all())


def demo(
    out: Path, config: Configuration | None = None, seed: int | None = None, progress: Progress | None = None
) -> DemoResult:
    """Write the trial under `out` (`site/`, `runs/`, `vehicle.toml`), replay every run from its files, and compare.

    Another `seed` than the scenario's own draws other errors; what has to be found is the same.
    `progress` is told of each run written and replayed.
    """
    scenario = demo_scenario(seed)
    paths = write_trial(scenario, out, progress)
    return replay_trial(scenario, read_site(out / "site"), paths, config or Configuration(), progress)


def demo_scenario(seed: int | None = None) -> Scenario:
    """The demo scenario of the package."""
    with as_file(files("datasets") / "scenarios" / "demo.toml") as path:
        scenario = load_scenario(path)
    return scenario if seed is None else with_seed(scenario, seed)


def replay_trial(
    scenario: Scenario, site: Site, paths: list[Path], config: Configuration, progress: Progress | None = None
) -> DemoResult:
    """Replay the runs of a trial that was written and compare each with what its scenario expects."""
    checks: list[Check] = []
    tables = []
    for spec, path in zip(scenario.runs, paths, strict=True):
        run: RunLog = read_run(path, config.ingest)
        vehicle = scenario.vehicle if spec.vehicle and scenario.vehicle else Vehicle()
        tables.append(replay(run, site, vehicle, config))
        checks += compare(spec, run, tables[-1])
        if progress is not None:
            progress(spec.id)
    return DemoResult(scenario, site, checks_table(checks), tuple(tables))


def write_demo(result: DemoResult, out: Path) -> Path:
    """The demo's tables as a campaign would leave them, and the report; returns the report's first page."""
    config = Configuration()
    for tables in result.tables:
        row = tables.runs.row(0, named=True)
        digests = {name: row[name] for name in ("config_digest", "input_digest")}
        write_run(tables, out, {"software": SOFTWARE, "site_digest": result.site.digest, **digests})
    write_config(out, config)
    write_campaign(out, config)
    return write_report(out, result.site)[0]
