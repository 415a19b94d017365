"""The demonstration: write the demo trial, replay it, and hold what was found against what was injected."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path

import polars as pl
import tomli_w

from datasets.comparison import checks_table, compare_run
from datasets.scenario import Scenario, load_scenario, with_seed
from datasets.trial import write_trial
from pipeline import storage
from pipeline.campaign import RunOutcome, run_campaign
from pipeline.project.opened import open_project
from pipeline.project.run import plan_of
from pipeline.read.ingest.run import read_run as read_log
from pipeline.read.site.read import read_site
from pipeline.results.figures.head import CampaignHead, head_of, word_of, worst_verdict
from pipeline.results.store import read_run
from pipeline.show.progress import CampaignWatch
from pipeline.show.report import write_report
from schemas.config import Configuration
from schemas.frozen import frozen
from schemas.project import FILE_NAME, NO_VEHICLE
from schemas.run import RunTables

_HEAD = (
    "# The demo as a project: `balise run`, `balise verify` and `balise sql` need no option here (docs/project.md).\n"
)
Progress = Callable[[str], None]


@frozen
class DemoResult:
    """`checks`: one row per thing expected, as `comparison.checks_table`; `tables`: the replay of each run."""

    scenario: Scenario
    checks: pl.DataFrame
    tables: tuple[RunTables, ...]
    page: Path

    @property
    def head(self) -> CampaignHead:
        """The worst verdict of the runs, and their counts."""
        return head_of(worst_verdict(one.runs["verdict"].to_list()) for one in self.tables)

    @property
    def agrees(self) -> bool:
        """Every check of the demonstration holds."""
        return bool(self.checks["agrees"].all())

    @property
    def differing(self) -> pl.DataFrame:
        """Checks that found something else than expected."""
        return self.checks.filter(~self.checks["agrees"]).drop("title", "agrees")

    @property
    def lines(self) -> pl.DataFrame:
        """One line per run, `run_id, injected, verdict, hazards, checks`, as short as a terminal is wide."""
        of_runs = self.checks.group_by("run_id", maintain_order=True)
        agreement = of_runs.agg(pl.col("injected").first(), pl.col("agrees").sum(), pl.len()).rows()
        rows = [
            (run_id, _shorten_faults(injected), _verdict_word(one), _hazard_classes(one.hazards), f"{agreeing}/{of}")
            for (run_id, injected, agreeing, of), one in zip(agreement, self.tables, strict=True)
        ]
        names = ("run_id", "injected", "verdict", "hazards", "checks")
        return pl.DataFrame(rows, schema=dict.fromkeys(names, pl.String), orient="row")

    def as_dict(self) -> dict[str, object]:
        """The demonstration for programs; `checks` holds what was expected and found in full."""
        verdicts = {"verdict": self.head.word, "verdicts": self.head.counts()}
        return {**verdicts, "page": self.page, "agrees": self.agrees, "checks": self.checks}

    @property
    def sentence(self) -> str:
        """`all 87 checks agree`, or how many do not."""
        wrong = int((~self.checks["agrees"]).sum())
        return (
            f"{wrong} of {self.checks.height} checks do not agree"
            if wrong
            else f"all {self.checks.height} checks agree"
        )


def _shorten_faults(injected: str) -> str:
    """Faults in words without how long they last."""
    return ", ".join(fault.partition(" for ")[0] for fault in injected.split(", "))


def _verdict_word(tables: RunTables) -> str:
    """The worst verdict of a run's solutions, in a word."""
    return word_of(worst_verdict(tables.runs["verdict"].to_list()))


def _hazard_classes(hazards: pl.DataFrame) -> str:
    """Classes of the hazards of a run."""
    return " ".join(hazards["hazard"].cast(pl.String).unique(maintain_order=True)) or "none"


def make_demo(out: Path, seed: int | None = None, progress: Progress | None = None, jobs: int = 1) -> DemoResult:
    """Write the trial under `out` as a project, replay it to `tables/`, compare, and write pages.

    Another `seed` than the scenario's own draws other errors; what has to be found is the same.
    `progress` receives a line for each run written and replayed.
    """
    scenario = demo_scenario(seed)
    paths = write_trial(scenario, out, None if progress is None else lambda run_id: progress(f"{run_id}: written"))
    _replay_trial(scenario, out, progress, jobs)
    tables = tuple(read_run(out / "tables", spec.id) for spec in scenario.runs)
    config = Configuration()
    logs = (read_log(path, config.ingest) for path in paths)
    checks = [check for case in zip(scenario.runs, logs, tables, strict=True) for check in compare_run(*case)]
    site = read_site(out / "site", config.site)
    return DemoResult(scenario, checks_table(checks), tables, write_report(out / "tables", site, jobs)[0])


def _replay_trial(scenario: Scenario, out: Path, progress: Progress | None, jobs: int) -> None:
    """Replay a trial as `balise run` would: as a project, some of whose runs have no vehicle file."""
    bare = {spec.id: NO_VEHICLE for spec in scenario.runs if not spec.vehicle}
    named = {"vehicle": "vehicle.toml", "vehicles": bare} if scenario.vehicle else {}
    project = {"site": "site", "out": "tables", **named, "replay": {"runs": ["runs/*"]}}
    storage.write_bytes(out / FILE_NAME, (_HEAD + tomli_w.dumps(project)).encode())
    watches = [] if progress is None else [_Replayed(progress)]
    run_campaign(plan_of(open_project(out)), jobs=jobs, force=True, watches=watches)


class _Replayed(CampaignWatch):
    """Passes each run on that was replayed."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def counted(self, outcome: RunOutcome) -> None:
        """Say that a run is done."""
        self._progress(f"{outcome.run_id}: replayed")

    def noted(self, text: str) -> None:
        """Say a sentence."""
        self._progress(text)


def demo_scenario(seed: int | None = None) -> Scenario:
    """The demo scenario of the package."""
    with as_file(files("datasets") / "scenarios" / "demo.toml") as path:
        scenario = load_scenario(path)
    return scenario if seed is None else with_seed(scenario, seed)
