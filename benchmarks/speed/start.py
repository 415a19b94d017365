"""Processor time of commands that do little, and of one short run: whole processes, with compiled modules there."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.results import Figure
from datasets.demo import demo_scenario
from datasets.trial import build_run, build_site, write_run_log, write_site

_LIGHT = {"help": ["--help"], "version": ["--version"], "experiment list": ["experiment", "list"]}
_LIGHT_S, _INSPECT_S, _MISTYPED_S, _BEFORE_READING_S = 0.4, 0.5, 0.4, 1.0
# Against loading the two libraries that hold the tables: 0.2.0 had 5.9, of whose 1.15 s the goal is 1.0.
_COLD_TIMES = 5.1
_TIMES = 5
# One process that runs the command as often as wanted, so that what is measured is the command alone.
_COST = """
import resource, subprocess, sys
subprocess.run([sys.executable, '-m', 'cli', *sys.argv[1:]], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)
"""
# Stops where the worker would read the log, and tells what takes long to load and is there already.
_BEFORE_READING = """
import os, sys, time, cli
import pipeline.campaign.worker as worker
def stop(*given, **named):
    print(len({'scipy', 'duckdb', 'rich', 'jinja2', 'pandas'} & set(sys.modules)), time.process_time(), flush=True)
    os._exit(0)
worker.RecordedLog = stop
cli._run_guarded(sys.argv[1:], False)
"""


@dataclass(frozen=True)
class Cost:
    """What a command took, its workers among it: processor time, and the memory of its largest process."""

    processor_s: float
    peak_mb: float


def measure(out: Path) -> list[Figure]:
    """Shortest of some goes of each command [s of processor time]."""
    site, log = _trial(out)
    empty = out / "empty"
    empty.mkdir(parents=True, exist_ok=True)
    given = ["--site", str(site), "--out", str(out / "result"), "--force", "--quiet"]
    loaded, before_s = _before_reading(["replay", str(log), *given])
    return [
        *(Figure(name, cost_of(words).processor_s, "s", _LIGHT_S) for name, words in _LIGHT.items()),
        Figure("inspect of an empty folder", cost_of(["inspect", str(empty)]).processor_s, "s", _INSPECT_S),
        Figure("inspect of a mistyped path", cost_of(["inspect", f"{log}x"]).processor_s, "s", _MISTYPED_S),
        Figure("replay of a mistyped path", cost_of(["replay", f"{log}x", *given]).processor_s, "s", _MISTYPED_S),
        Figure("replay before it reads", before_s, "s", _BEFORE_READING_S),
        Figure("heavy libraries loaded before it reads", loaded, "", 0.0),
        *_cold(["replay", str(log), *given]),
    ]


def _cold(arguments: list[str]) -> list[Figure]:
    """A replay in a fresh process, beside one that loads libraries alone, in turn."""
    code = _COST.replace("'-m', 'cli', *sys.argv[1:]", "'-c', 'import polars, pyarrow'")
    pairs = [(_printed(_COST, arguments)[0], _printed(code, [])[0]) for _ in range(_TIMES)]
    replay_s, libraries_s = (min(seconds) for seconds in zip(*pairs, strict=True))
    return [
        Figure("replay of seven minutes, cold", replay_s, "s"),
        Figure("replay of seven minutes, cold / loading libraries", replay_s / libraries_s, "times", _COLD_TIMES),
    ]


def _trial(out: Path) -> tuple[Path, Path]:
    scenario = demo_scenario()
    write_site(build_site(scenario), out / "site")
    return out / "site", write_run_log(build_run(scenario, scenario.runs[-1]), out / "runs")


def cost_of(arguments: list[str]) -> Cost:
    """The cheapest of some goes of a command."""
    costs = [Cost(*_printed(_COST, arguments)) for _ in range(_TIMES)]
    return min(costs, key=lambda cost: cost.processor_s)


def _before_reading(arguments: list[str]) -> tuple[float, float]:
    loaded, seconds = zip(*(_printed(_BEFORE_READING, arguments) for _ in range(_TIMES)), strict=True)
    return max(loaded), min(seconds)


def _printed(code: str, arguments: list[str]) -> tuple[float, float]:
    done = subprocess.run([sys.executable, "-c", code, *arguments], text=True, capture_output=True, check=True)
    first, second = map(float, done.stdout.split()[-2:])
    return first, second
