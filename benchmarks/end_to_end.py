"""One hour of ROS 2 log to all tables on disk, against reading it and writing them, and against the obvious notebook.

Processor time, warm, in one process.

Twice: as `balise` writes such a log, with the speed alone in each odometry message, and as an odometry node does.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from benchmarks.filled import filled
from benchmarks.notebook import notebook
from benchmarks.results import Figure, processor_s, stopwatch
from benchmarks.trials import MAPPED_WHEEL, write_cdr_trial
from pipeline.campaign import make_plan, run_campaign
from pipeline.read.ingest import read_run
from pipeline.results import store
from schemas.config import Configuration
from schemas.enums import RunStatus

TIMES_READING_AND_WRITING = 2.7
TIMES_NOTEBOOK = 30.0
MEMORY_ONE_HOUR_MB, MEMORY_TEN_HOURS_MB = 600.0, 2500.0


def measure(folder: Path) -> list[Figure]:
    """Figures of one hour; memory of one and ten hours in processes of their own."""
    hour, ten = folder / "one-hour", folder / "ten-hours"
    log, site = write_cdr_trial(hour, 1.0, balises=20), hour / "site"
    with stopwatch() as command:
        peak_mb = command_peak_mb(log, site, hour / "command")
    ten_mb = command_peak_mb(write_cdr_trial(ten, 10.0, balises=200), ten / "site", ten / "out")
    return [
        *_log_to_tables(log, site, hour / "out", "speed alone"),
        *_log_to_tables(filled(log), site, hour / "out-filled", "all fields"),
        Figure("whole command", command.seconds, "s"),
        Figure("peak memory, one hour", peak_mb, "MB", MEMORY_ONE_HOUR_MB),
        Figure("peak memory, ten hours", ten_mb, "MB", MEMORY_TEN_HOURS_MB),
    ]


def _log_to_tables(log: Path, site: Path, out: Path, what: str) -> list[Figure]:
    """In this process, once warm."""
    plan = make_plan([str(log)], site, out, Configuration(ingest=MAPPED_WHEEL))
    if run_campaign(plan, force=True).count(RunStatus.OK) != 1:
        raise RuntimeError(f"the run of {log} is not ok: its time means nothing")
    tables = store.read_run(out, log.stem)
    again = out.with_name(f"{out.name}-again")
    replay_s = processor_s(3, lambda: run_campaign(plan, force=True))
    reading_s = processor_s(3, lambda: read_run(log, MAPPED_WHEEL))
    writing_s = processor_s(3, lambda: store.write_run(tables, again, {}))
    notebook_s = processor_s(1, lambda: notebook(log, site, out.with_name("notebook")))
    least_s = reading_s + writing_s
    return [
        Figure(f"{what}: log of one hour", log.stat().st_size / 1e6, "MB"),
        Figure(f"{what}: read the log", reading_s, "s"),
        Figure(f"{what}: write the tables", writing_s, "s"),
        Figure(f"{what}: log to tables, warm", replay_s, "s"),
        Figure(f"{what}: log to tables / read and write", replay_s / least_s, "times", TIMES_READING_AND_WRITING),
        Figure(f"{what}: obvious notebook", notebook_s, "s"),
        Figure(f"{what}: notebook / log to tables", notebook_s / replay_s, "times", TIMES_NOTEBOOK, "above"),
    ]


def command_peak_mb(log: Path, site: Path, out: Path) -> float:
    """Peak memory of the command on one run [MB]; it replays in its own process."""
    code = (
        "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL); "
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)"
    )
    config = site.parent / "config.toml"
    balise = [sys.executable, "-m", "cli", "replay", str(log), "--site", str(site), "--out", str(out)]
    balise += ["--config", str(config)]
    done = subprocess.run(
        [sys.executable, "-c", code, *balise, "--force", "--quiet"], check=True, capture_output=True, text=True
    )
    return float(done.stdout)
