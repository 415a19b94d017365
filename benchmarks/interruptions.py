"""Fifty campaigns killed at random moments, each taken up again: tables equal to an undisturbed one."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.results import Figure
from benchmarks.trials import write_campaign
from schemas.tables import TABLES

TRIALS = 50
STOP_S = 2.0


def measure(folder: Path) -> list[Figure]:
    """Kills of parent and workers in turn, and how long Ctrl-C takes."""
    site, logs = write_campaign(folder, 12, minutes=3.0)
    whole = folder / "undisturbed"
    _replay(logs, site, whole).wait()
    wanted = _tables(whole)
    chance = random.Random(5)
    different = 0
    for trial in range(TRIALS):
        out = folder / "killed"
        shutil.rmtree(out, ignore_errors=True)
        campaign = _replay(logs, site, out)
        time.sleep(chance.uniform(0.2, 6.0))
        _kill(campaign, worker=trial % 2 == 1, chance=chance)
        campaign.wait()
        _replay(logs, site, out).wait()
        different += _tables(out) != wanted
    return [
        Figure("campaigns killed and taken up again", TRIALS, "trials"),
        Figure("of these with other tables", different, "trials", 0),
        Figure("Ctrl-C to the end", _interrupt_s(logs, site, folder / "interrupted", chance), "s", STOP_S),
    ]


def _replay(logs: Path, site: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "cli", "replay", str(logs), "--site", str(site), "--out", str(out)]
    return subprocess.Popen([*command, "--jobs", "2", "--quiet"], start_new_session=True)


def _kill(campaign: subprocess.Popen[bytes], worker: bool, chance: random.Random) -> None:
    """The parent, or one of its children, without warning."""
    listed = Path(f"/proc/{campaign.pid}/task/{campaign.pid}/children")
    try:
        children = [int(pid) for pid in listed.read_text().split() if _is_worker(pid)]
        os.kill(chance.choice(children) if worker and children else campaign.pid, signal.SIGKILL)
    except (FileNotFoundError, ProcessLookupError):
        return


def _is_worker(pid: str) -> bool:
    """Python's tracker of semaphores is a child too, but none that does the work."""
    return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()


def _interrupt_s(logs: Path, site: Path, out: Path, chance: random.Random) -> float:
    """Longest of five interruptions [s]."""
    longest = 0.0
    for _ in range(5):
        shutil.rmtree(out, ignore_errors=True)
        campaign = _replay(logs, site, out)
        time.sleep(chance.uniform(3.0, 6.0))
        begun = time.perf_counter()
        os.killpg(campaign.pid, signal.SIGINT)
        campaign.wait()
        longest = max(longest, time.perf_counter() - begun)
    return longest


def _tables(out: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(out)): path.read_bytes()
        for table in (*TABLES, "campaign")
        for path in sorted((out / table).rglob("*.parquet"))
    }
