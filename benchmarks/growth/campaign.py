"""Campaigns: two jobs against one, a thousand runs unattended with a tenth of the logs damaged, start-up."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from benchmarks.results import Figure, best_of, children_peak_mb, own_peak_mb, stopwatch
from benchmarks.trials import write_campaign
from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site, write_run_log, write_site
from pipeline.campaign import make_plan, run_campaign
from pipeline.campaign.compact import compact
from pipeline.campaign.run import write_campaign as write_tables
from pipeline.results.query import run_sql
from schemas.config import Configuration
from schemas.enums import RunStatus
from schemas.tables import TABLES

SPEED_UP = 1.7
HELP_S = 0.3
QUERY_S = 2.0
MEMORY_MB = 600.0
RESUME_S = 10.0
FORTY, THOUSAND, FIVE_THOUSAND, TEN_THOUSAND = 40, 1000, 5000, 10_000
_HAZARDS = "SELECT hazard, COUNT(*) AS n FROM hazards GROUP BY hazard"
_JOINED = (
    "SELECT hazard, COUNT(*) AS n, SUM(duration_s) AS seconds FROM hazards "
    "JOIN runs USING (run_id, solution) WHERE status = 'ok' GROUP BY hazard"
)


def measure(folder: Path) -> list[Figure]:
    """Figures of a campaign of forty runs, of a thousand runs of ten minutes, and of `balise --help`."""
    return [
        *_start_up(),
        *_speed_up(folder / "forty"),
        *_thousand(folder / "thousand"),
        *_questions(folder / "ten-thousand"),
        *_resumed(folder / "five-thousand"),
    ]


def _start_up() -> list[Figure]:
    command = [str(Path(sys.executable).parent / "balise"), "--help"]
    seconds = best_of(5, lambda: subprocess.run(command, check=True, capture_output=True))
    return [Figure("balise --help", seconds, "s", HELP_S)]


def _speed_up(folder: Path) -> list[Figure]:
    site, logs = write_campaign(folder, FORTY, minutes=10.0)
    seconds = {}
    for jobs in (1, 2):
        with stopwatch() as watch:
            run_campaign(make_plan([str(logs)], site, folder / f"out{jobs}"), jobs=jobs, force=True)
        seconds[jobs] = watch.seconds
    return [
        Figure("forty runs, one job", seconds[1], "s"),
        Figure("forty runs, two jobs", seconds[2], "s"),
        Figure("two jobs against one", seconds[1] / seconds[2], "times", SPEED_UP, "above"),
    ]


def _thousand(folder: Path) -> list[Figure]:
    site, logs = write_campaign(folder, THOUSAND, minutes=10.0)
    shutil.rmtree(folder / "out", ignore_errors=True)
    damaged = _damage(logs, each=10)
    plan = make_plan([str(logs)], site, folder / "out")
    with stopwatch() as watch:
        summary = run_campaign(plan, jobs=2)
    with stopwatch() as again:
        resumed = run_campaign(plan, jobs=2)
    read = sum(file.stat().st_size for file in logs.rglob("*.parquet"))
    return [
        Figure("a thousand runs of ten minutes", watch.seconds, "s"),
        Figure("runs per second", THOUSAND / watch.seconds, "1/s"),
        Figure("log bytes per second", read / 1e6 / watch.seconds, "MB/s"),
        Figure("peak memory of a worker", children_peak_mb(), "MB", MEMORY_MB),
        Figure("peak memory of the campaign's own process", own_peak_mb(), "MB"),
        Figure("damaged logs not reported", damaged - summary.count(RunStatus.FAILED), "runs", 0),
        Figure("other runs not ok", THOUSAND - damaged - summary.count(RunStatus.OK), "runs", 0),
        Figure("the same again, all complete", again.seconds, "s"),
        Figure("of these replayed again", THOUSAND - resumed.count_skipped, "runs", 0),
    ]


def _questions(folder: Path) -> list[Figure]:
    """Questions to ten thousand runs: those of the demonstration, with their hazards, under other names."""
    few, many = folder / "few", folder / "out"
    if not few.exists():
        for spec in demo_scenario().runs:
            write_run_log(build_run(demo_scenario(), spec), folder / "runs")
        write_site(build_site(demo_scenario()), folder / "site")
    run_campaign(make_plan([str(folder / "runs")], folder / "site", few), jobs=2)
    shutil.rmtree(many, ignore_errors=True)
    _multiply(few, many, TEN_THOUSAND)
    bare_s = best_of(2, lambda: run_sql(many, _HAZARDS))
    with stopwatch() as watch:
        write_tables(many, Configuration())
    compact(many)
    found = run_sql(many, _HAZARDS)["n"].sum()
    command = [str(Path(sys.executable).parent / "balise"), "sql", str(many), _JOINED]
    return [
        Figure("hazards of ten thousand runs", float(found), "hazards", 1.0, "above"),
        Figure("hazard query over ten thousand runs", best_of(3, lambda: run_sql(many, _HAZARDS)), "s", QUERY_S),
        Figure("hazards joined with runs", best_of(3, lambda: run_sql(many, _JOINED)), "s", QUERY_S),
        Figure(
            "the same as a command",
            best_of(3, lambda: subprocess.run(command, check=True, capture_output=True)),
            "s",
            QUERY_S,
        ),
        Figure("hazard query before they are compact", bare_s, "s"),
        Figure("tables over ten thousand runs", watch.seconds, "s"),
    ]


def _resumed(folder: Path) -> list[Figure]:
    """A complete campaign of five thousand runs, called again: one run under as many names."""
    shutil.rmtree(folder, ignore_errors=True)
    spec = demo_scenario().runs[0]
    log = write_run_log(build_run(demo_scenario(), spec), folder / "one")
    write_site(build_site(demo_scenario()), folder / "site")
    run_campaign(make_plan([str(log)], folder / "site", folder / "few"))
    _multiply(folder / "few", folder / "out", FIVE_THOUSAND)
    for number in range(FIVE_THOUSAND):
        target = folder / "logs" / f"r{number:05}"
        target.mkdir(parents=True)
        for file in log.iterdir():
            (target / file.name).hardlink_to(file)
    plan = make_plan([str(folder / "logs")], folder / "site", folder / "out")
    seconds = []
    for _ in range(2):
        with stopwatch() as watch:
            resumed = run_campaign(plan, jobs=2)
        seconds.append(watch.seconds)
    return [
        Figure("five thousand complete runs, looked into", seconds[0], "s"),
        Figure("five thousand complete runs, known", seconds[1], "s", RESUME_S),
        Figure("of these replayed again", FIVE_THOUSAND - resumed.count_skipped, "runs", 0),
    ]


def _multiply(few: Path, many: Path, count: int) -> None:
    """The runs of a result under as many other names, by links."""
    runs = sorted(path.name for path in (few / "runs").iterdir())
    for table in TABLES:
        for number in range(count):
            target = many / table / f"run_id=r{number:05}"
            target.mkdir(parents=True)
            (target / f"{table}.parquet").hardlink_to(few / table / runs[number % len(runs)] / f"{table}.parquet")


def _damage(logs: Path, each: int) -> int:
    """Cut every tenth run's GNSS file in half; returns how many."""
    runs = sorted(logs.iterdir())[::each]
    for run in runs:
        file = run / "gnss.parquet"
        content = file.read_bytes()
        if content.endswith(b"PAR1"):
            file.write_bytes(content[: len(content) // 2])
    return len(runs)
