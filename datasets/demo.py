"""The demonstration: write the demo trial, replay it, and hold what was found against what was injected."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import polars as pl

from datasets.comparison import ComparisonRow, checks_table, compare
from datasets.scenario import Scenario, load_scenario, with_seed
from datasets.trial import write_trial
from pipeline.campaign.finish import write_campaign
from pipeline.campaign.plan import software_digest
from pipeline.one_run import replay
from pipeline.read.ingest.run import read_run
from pipeline.read.site.read import read_site
from pipeline.results.manifest import listing
from pipeline.results.store import write_config, write_run
from pipeline.show.report import write_report
from pipeline.stages.run_row.verdict import CampaignHead, head_of, word_of, worst_verdict
from pipeline.storage import file_digests
from schemas.config import Configuration, Vehicle
from schemas.run import RunLog, RunTables, Site
from schemas.version import SOFTWARE

Progress = Callable[[str], None]


@dataclass(frozen=True)
class DemoResult:
    """`checks`: one row per thing expected, as `comparison.checks_table`; `tables`: the replay of each run.

    `paths`: its log.
    """

    scenario: Scenario
    site: Site
    checks: pl.DataFrame
    tables: tuple[RunTables, ...]
    paths: tuple[Path, ...] = ()

    @property
    def head(self) -> CampaignHead:
        """The worst verdict of the runs, and their counts."""
        return head_of(worst_verdict(one.runs["verdict"].to_list()) for one in self.tables)

    @property
    def agrees(self) -> bool:
        return bool(self.checks["agrees"].all())

    @property
    def differing(self) -> pl.DataFrame:
        """Checks that found something else than expected."""
        return self.checks.filter(~self.checks["agrees"]).drop("title", "agrees")

    @property
    def lines(self) -> pl.DataFrame:
        """One line per run, `run_id, injected, verdict, hazards, checks`, as short as a terminal is wide."""
        of_runs = self.checks.group_by("run_id", maintain_order=True)
        counts = of_runs.agg(pl.col("injected").first(), pl.col("agrees").sum(), pl.len()).rows()
        rows = [
            (run_id, _in_short(injected), _verdict(one), _classes(one.hazards), f"{agreeing}/{of}")
            for (run_id, injected, agreeing, of), one in zip(counts, self.tables, strict=True)
        ]
        names = ("run_id", "injected", "verdict", "hazards", "checks")
        return pl.DataFrame(rows, schema=dict.fromkeys(names, pl.String), orient="row")

    @property
    def sentence(self) -> str:
        """`all 87 checks agree`, or how many do not."""
        wrong = int((~self.checks["agrees"]).sum())
        return (
            f"{wrong} of {self.checks.height} checks do not agree"
            if wrong
            else f"all {self.checks.height} checks agree"
        )


def _in_short(injected: str) -> str:
    """Faults in words without how long they last."""
    return ", ".join(fault.partition(" for ")[0] for fault in injected.split(", "))


def _verdict(tables: RunTables) -> str:
    return word_of(worst_verdict(tables.runs["verdict"].to_list()))


def _classes(hazards: pl.DataFrame) -> str:
    return " ".join(hazards["hazard"].cast(pl.String).unique(maintain_order=True)) or "none"


def demo(
    out: Path, config: Configuration | None = None, seed: int | None = None, progress: Progress | None = None
) -> DemoResult:
    """Write the trial under `out` (`site/`, `runs/`, `vehicle.toml`), replay every run from its files, and compare.

    Another `seed` than the scenario's own draws other errors; what has to be found is the same.
    `progress` hears of each run written and replayed.
    """
    scenario = demo_scenario(seed)
    paths = write_trial(scenario, out, _ended(progress, "written"))
    config = config or Configuration()
    return replay_trial(scenario, read_site(out / "site", config.site), paths, config, progress)


def demo_scenario(seed: int | None = None) -> Scenario:
    """The demo scenario of the package."""
    with as_file(files("datasets") / "scenarios" / "demo.toml") as path:
        scenario = load_scenario(path)
    return scenario if seed is None else with_seed(scenario, seed)


def replay_trial(
    scenario: Scenario, site: Site, paths: list[Path], config: Configuration, progress: Progress | None = None
) -> DemoResult:
    """Replay the runs of a trial that was written and compare each with what its scenario expects."""
    checks: list[ComparisonRow] = []
    tables = []
    done = _ended(progress, "replayed")
    for spec, path in zip(scenario.runs, paths, strict=True):
        run: RunLog = read_run(path, config.ingest)
        vehicle = scenario.vehicle if spec.vehicle and scenario.vehicle else Vehicle()
        tables.append(replay(run, site, vehicle, config))
        checks += compare(spec, run, tables[-1])
        if done is not None:
            done(spec.id)
    return DemoResult(scenario, site, checks_table(checks), tuple(tables), tuple(paths))


def _ended(progress: Progress | None, what: str) -> Progress | None:
    """Tells of a run what has been done to it."""
    return None if progress is None else lambda run_id: progress(f"{run_id}: {what}")


def write_demo(result: DemoResult, out: Path) -> Path:
    """The demo's tables as a campaign would leave them, and the report; returns the report's first page."""
    config = Configuration()
    made = {"software": SOFTWARE, "software_digest": software_digest(), "site_digest": result.site.digest}
    for tables, path in zip(result.tables, result.paths, strict=True):
        row = tables.runs.row(0, named=True)
        digests = {name: row[name] for name in ("config_digest", "input_digest")}
        listed = {"log_files": listing(file_digests(path)), "site_files": listing(result.site.files)}
        write_run(tables, out, {**made, **digests, **listed, "status": row["status"]})
    write_config(out, config)
    write_campaign(out, config)
    return write_report(out, result.site)[0]
