"""Results as bytes, for tests that hold two campaigns against each other."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from pipeline.campaign import CampaignSummary, Plan, RunOutcome, make_plan
from schemas.tables import TABLES
from tests.conftest import SmallTrial

ROOT = Path(__file__).parents[2]


def endless(log: Path) -> None:
    """A log that takes hours to read: nothing but a hole of a terabyte, which takes no room."""
    log.touch()
    os.truncate(log, 2**40)


def result_bytes(out: Path) -> dict[str, bytes]:
    """Every table of a result by its place; neither log nor configuration."""
    return {
        str(path.relative_to(out)): path.read_bytes()
        for table in TABLES
        for path in sorted((out / table).rglob("*"))
        if path.is_file()
    }


def campaign_bytes(out: Path) -> dict[str, bytes]:
    """The tables over all runs."""
    return {path.name: path.read_bytes() for path in sorted((out / "campaign").iterdir())}


def plan_of(trial: SmallTrial, out: Path | str, runs: Sequence[Path] | None = None) -> Plan:
    named = [str(path) for path in runs] if runs is not None else [str(trial.runs)]
    return make_plan(named, trial.site, out)


def command(trial: SmallTrial, out: Path | str, *arguments: str, runs: Sequence[Path] | None = None) -> list[str]:
    named = [str(path) for path in runs] if runs is not None else [str(trial.runs)]
    return [
        *(sys.executable, "-m", "cli", "replay", *named),
        *("--site", str(trial.site), "--out", str(out), *arguments),
    ]


def start(arguments: Sequence[str]) -> subprocess.Popen[str]:
    """A campaign in a process group of its own, as a terminal starts it: also where the tests ignore signals."""
    inherited = {signum: signal.signal(signum, signal.SIG_DFL) for signum in (signal.SIGHUP, signal.SIGINT)}
    try:
        return subprocess.Popen(
            arguments,
            cwd=ROOT,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "NO_COLOR": "1"},
        )
    finally:
        for signum, handler in inherited.items():
            signal.signal(signum, handler)


def run(arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, cwd=ROOT, text=True, capture_output=True, timeout=300, check=False)


def wait_for(condition: Callable[[], bool], limit_s: float = 240.0, why: str = "waited in vain") -> None:
    """Wait until something is so; a test that waits in vain fails."""
    until = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < until, why
        time.sleep(0.02)


class Hurried:
    """The clock of a campaign, which a test puts forward: what never ends has had its time at once, on any machine."""

    def __init__(self, patch: pytest.MonkeyPatch, *modules: str) -> None:
        self._ahead_s = 0.0
        for module in modules:
            patch.setattr(f"pipeline.campaign.{module}.time", self)

    def monotonic(self) -> float:
        return time.monotonic() + self._ahead_s

    def hurry(self, by_s: float) -> None:
        self._ahead_s += by_s


def by_run(summary: CampaignSummary) -> dict[str, RunOutcome]:
    return {outcome.run_id: outcome for outcome in summary.outcomes}
