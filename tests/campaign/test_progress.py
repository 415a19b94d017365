"""What a person sees of a campaign while it works, and what its log keeps."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from pipeline.campaign import Plan, RunOutcome, Summary, progress
from pipeline.campaign.progress import BarWatch, LineWatch, LogWatch, Tally, watches
from schemas.enums import RunStatus
from tests.campaign.compare import plan_of
from tests.conftest import SmallTrial

OK = RunOutcome("a", RunStatus.OK, seconds=2.0)
BAD = RunOutcome("b", RunStatus.FAILED, "b.mcap: damaged")
OLD = RunOutcome("c", RunStatus.OK, skipped=True)


class Clock:
    """Seconds that pass when told to."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


@pytest.fixture
def plan(small_trial: SmallTrial, tmp_path: Path) -> Plan:
    return plan_of(small_trial, tmp_path)


def test_tally_in_one_line(clock: Clock) -> None:
    tally = Tally(10)
    for outcome in (OK, BAD, OLD):
        tally.add(outcome)
    clock.now_s += 4.0
    line = tally.line([("quick", 1.0), ("slow", 90.0), ("slower", 120.0)])
    assert line == (
        "3/10 runs, 1 failed or partial, 1 skipped, 0.50 runs/s, 14 s left, "
        "longest now: slower (2 min 0 s), slow (1 min 30 s)"
    )


def test_no_rate_before_the_first_run(clock: Clock) -> None:
    tally = Tally(2)
    tally.add(OLD)
    clock.now_s += 1.0
    assert tally.line() == "1/2 runs, 0 failed or partial, 1 skipped"


def test_lines_in_a_pipe(clock: Clock, plan: Plan) -> None:
    said = io.StringIO()
    watch = LineWatch(said)
    watch.begin(plan)
    watch.finished(OK)
    watch.look([])
    assert said.getvalue() == ""
    watch.finished(BAD)
    clock.now_s += 5.0
    watch.look([("a", 5.0)])
    watch.look([("a", 5.0)])
    watch.end(Summary(4, (OK, BAD), 5.0))
    lines = said.getvalue().splitlines()
    assert lines[0] == "b: failed: b.mcap: damaged"
    assert [line.partition(",")[0] for line in lines[1:]] == ["2/4 runs", "2/4 runs"]
    assert "longest now: a" in lines[1]


def test_bar_on_a_terminal(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, width=160, color_system=None)
    monkeypatch.setattr(progress, "Console", lambda **_: screen)
    watch = BarWatch()
    watch.begin(plan)
    watch.finished(OK)
    watch.finished(BAD)
    watch.end(Summary(4, (OK, BAD), 5.0))
    said = screen.file.getvalue()  # type: ignore[attr-defined]
    assert "b: failed: b.mcap: damaged" in said
    assert "2/4" in said
    assert "1 failed or partial" in said


def test_log_beside_the_results(plan: Plan) -> None:
    watch = LogWatch()
    Path(plan.out).mkdir(exist_ok=True)
    watch.begin(plan)
    watch.finished(OK)
    watch.finished(RunOutcome("d", RunStatus.FAILED, "defect", defect=True, trace="at s3://me:secret@store/x\n"))
    watch.end(Summary(4, (OK,), 5.0))
    lines = (Path(plan.out) / "replay.log").read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ ", line) for line in lines if line)
    assert lines[0].endswith("4 runs")
    assert "a: ok in 2" in lines[1]
    assert "secret" not in "".join(lines)
    assert "1 of 4 runs" in lines[-1]


@pytest.mark.parametrize(
    ("quiet", "terminal", "kinds"),
    [(True, True, [LogWatch]), (False, True, [BarWatch, LogWatch]), (False, False, [LineWatch, LogWatch])],
)
def test_who_watches(
    monkeypatch: pytest.MonkeyPatch, quiet: bool, terminal: bool, kinds: list[Callable[[], object]]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal)
    assert [type(watch) for watch in watches(quiet)] == kinds
