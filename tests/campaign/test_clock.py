"""A clock that is wrong and runs backwards, and files from the future: nothing depends on either."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

import cli
from tests.campaign.compare import ROOT, campaign_bytes, command, result_bytes
from tests.conftest import SmallTrial

_YEAR_S = 365.25 * 86400.0
_2100_S = 4_102_444_800

# Python imports a module of this name when it starts, also in the workers.
_WRONG_CLOCK = """
import datetime, itertools, os, time

real, steps = time.time, itertools.count()
shift_s = float(os.environ["CLOCK_SHIFT_S"])
time.time = lambda: real() + shift_s - 60.0 * next(steps)
time.time_ns = lambda: int(time.time() * 1e9)


class AnyTime(type(datetime.datetime)):
    def __instancecheck__(cls, value):
        return isinstance(value, right)


class Wrong(datetime.datetime, metaclass=AnyTime):
    @classmethod
    def now(cls, tz=None):
        return right.fromtimestamp(time.time(), tz)


right, datetime.datetime = datetime.datetime, Wrong
"""


def replay(trial: SmallTrial, out: Path, shift_years: float, runs: list[Path], clock: Path) -> str:
    """A campaign in processes whose clock is off and goes back a minute each time somebody looks."""
    (clock / "sitecustomize.py").write_text(_WRONG_CLOCK)
    ended = subprocess.run(
        command(trial, out, "--jobs", "1", runs=runs),
        cwd=ROOT,
        text=True,
        capture_output=True,
        timeout=300,
        check=False,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(clock), str(ROOT)]),
            "CLOCK_SHIFT_S": str(shift_years * _YEAR_S),
            # More than the tests themselves have: the number of threads decides nothing either.
            "POLARS_MAX_THREADS": "4",
        },
    )
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def from_the_future(*folders: Path) -> None:
    for folder in folders:
        for path in [folder, *folder.rglob("*")]:
            os.utime(path, (_2100_S, _2100_S))


def test_wrong_clock_and_files_from_the_future(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    trial = SmallTrial(tmp_path / "site", tmp_path / "runs")
    shutil.copytree(small_trial.site, trial.site)
    shutil.copytree(small_trial.runs, trial.runs)
    out, clock = tmp_path / "out", tmp_path / "clock"
    clock.mkdir()
    replay(trial, out, 10.0, trial.paths[:1], clock)
    unfinished = out / "runs/run_id=run0/.runs.parquet.0123456789ab.tmp"
    unfinished.write_bytes(b"half of it")
    (out / ".lock").write_text("a campaign that was killed")
    from_the_future(trial.site, trial.runs, out)
    said = replay(trial, out, -20.0, trial.paths, clock)
    assert "(1 of them complete before)" in said
    assert not unfinished.exists()
    assert result_bytes(out) == result_bytes(undisturbed)
    assert campaign_bytes(out) == campaign_bytes(undisturbed)
    assert cli._run_guarded(command(trial, out)[3:], debug=False) == 0
    assert "(4 of them complete before)" in capfd.readouterr().out
    times = [line.split("T")[0] for line in (out / "replay.log").read_text().splitlines()]
    assert times[0] > times[-1] > min(times), "the clocks were not wrong"
