"""Processor time that commands take before they do anything: nothing is loaded that is not needed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from benchmarks.results import Figure
from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site, write_run_log, write_site

_LIGHT = {"help": ["--help"], "version": ["--version"], "experiment list": ["experiment", "list"]}
_LIGHT_S, _BEFORE_READING_S = 0.4, 1.0
_TIMES = 5
_SAY = "import time\nprint('processor', time.process_time())\n"
# Stops where the worker would read the log.
_REPLAY = """
import os, sys, time, cli
import pipeline.campaign.worker as worker
def stop(*given, **named):
    print('processor', time.process_time(), flush=True)
    os._exit(0)
for name in ('read_run', 'RecordedLog'):
    if hasattr(worker, name):
        setattr(worker, name, stop)
cli._guarded(sys.argv[1:], False)
"""


def measure(out: Path) -> list[Figure]:
    """Shortest of some goes of each command [s of processor time]."""
    site, log = _trial(out)
    given = ["replay", str(log), "--site", str(site), "--out", str(out / "result"), "--force", "--quiet"]
    light = f"import sys, cli\ncli._guarded(sys.argv[1:], False)\n{_SAY}"
    figures = [Figure(name, _shortest(light, words), "s", _LIGHT_S) for name, words in _LIGHT.items()]
    return [*figures, Figure("replay before it reads", _shortest(_REPLAY, given), "s", _BEFORE_READING_S)]


def _trial(out: Path) -> tuple[Path, Path]:
    scenario = demo_scenario()
    write_site(build_site(scenario), out / "site")
    return out / "site", write_run_log(build_run(scenario, scenario.runs[-1]), out / "runs")


def _shortest(code: str, arguments: list[str]) -> float:
    return min(_processor_s(code, arguments) for _ in range(_TIMES))


def _processor_s(code: str, arguments: list[str]) -> float:
    done = subprocess.run([sys.executable, "-c", code, *arguments], text=True, capture_output=True, check=True)
    return float(done.stdout.split()[-1])
