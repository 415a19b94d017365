"""Campaigns: two jobs against one, a thousand runs unattended with a tenth of the logs damaged, start-up."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from benchmarks.results import Figure, best_of, children_peak_mb, stopwatch
from benchmarks.trials import write_campaign
from pipeline.campaign import Summary, make_plan, run_campaign
from pipeline.query import run_sql
from schemas.enums import RunStatus

SPEED_UP = 1.7
HELP_S = 0.3
QUERY_S = 2.0
MEMORY_MB = 600.0
FORTY, THOUSAND = 40, 1000


def measure(folder: Path) -> list[Figure]:
    """Figures of a campaign of forty runs, of a thousand runs of ten minutes, and of `balise --help`."""
    return [*_start_up(), *_speed_up(folder / "forty"), *_thousand(folder / "thousand")]


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
    query = "SELECT hazard, COUNT(*) FROM hazards GROUP BY hazard"
    query_s = best_of(3, lambda: run_sql(folder / "out", query))
    read = sum(outcome.log_bytes for outcome in summary.outcomes)
    return [
        Figure("a thousand runs of ten minutes", watch.seconds, "s"),
        Figure("runs per second", THOUSAND / watch.seconds, "1/s"),
        Figure("log bytes per second", read / 1e6 / watch.seconds, "MB/s"),
        Figure("peak memory of a worker", _worker_peak_mb(summary), "MB", MEMORY_MB),
        Figure("peak memory of any process", children_peak_mb(), "MB"),
        Figure("damaged logs not reported", damaged - summary.count(RunStatus.FAILED), "runs", 0),
        Figure("other runs not ok", THOUSAND - damaged - summary.count(RunStatus.OK), "runs", 0),
        Figure("the same again, all complete", again.seconds, "s"),
        Figure("of these replayed again", THOUSAND - resumed.skipped, "runs", 0),
        Figure("hazard query over a thousand runs", query_s, "s", QUERY_S),
    ]


def _worker_peak_mb(summary: Summary) -> float:
    return max(outcome.peak_memory_bytes for outcome in summary.outcomes) / 1e6


def _damage(logs: Path, each: int) -> int:
    """Cut every tenth run's GNSS file in half; returns how many."""
    runs = sorted(logs.iterdir())[::each]
    for run in runs:
        file = run / "gnss.parquet"
        content = file.read_bytes()
        if content.endswith(b"PAR1"):
            file.write_bytes(content[: len(content) // 2])
    return len(runs)
