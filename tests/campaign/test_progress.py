"""What a person sees of a campaign while it works, and what its log keeps."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import rich.console
from rich.console import Console

import cli
from pipeline.campaign import CampaignSummary, Plan, RunOutcome
from pipeline.show import campaign, progress
from pipeline.show.progress import BarWatch, JsonWatch, LineWatch, LogWatch, watches
from schemas.enums import RunStatus, RunVerdict
from tests.campaign.compare import plan_of
from tests.conftest import SmallTrial

OK = RunOutcome("a", RunStatus.OK, verdict=RunVerdict.SAFE, seconds=2.0)
BAD = RunOutcome("b", RunStatus.FAILED, "b.mcap: damaged")
OLD = RunOutcome("c", RunStatus.OK, verdict=RunVerdict.UNSAFE, skipped=True)


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


def test_counts_in_one_line(clock: Clock, plan: Plan) -> None:
    watch = LineWatch(io.StringIO())
    watch.begin(10, plan.out)
    for outcome in (OK, BAD, OLD):
        watch.finished(outcome)
    clock.now_s += 4.0
    line = watch.line([("quick", 1.0), ("slow", 90.0), ("slower", 120.0)])
    assert line == (
        "3/10 runs, 1 failed or partial, 1 skipped, 14 s left, 0.50 runs/s, "
        "longest now: slower (2 min 0 s), slow (1 min 30 s)"
    )


def test_no_rate_before_the_first_run(clock: Clock, plan: Plan) -> None:
    watch = LineWatch(io.StringIO())
    watch.begin(len(plan.jobs), plan.out)
    watch.finished(OLD)
    clock.now_s += 1.0
    assert watch.line() == "1/4 runs, 0 failed or partial, 1 skipped"


def test_lines_in_a_pipe(clock: Clock, plan: Plan) -> None:
    said = io.StringIO()
    watch = LineWatch(said)
    watch.begin(len(plan.jobs), plan.out)
    watch.finished(OK)
    watch.look([])
    assert said.getvalue() == ""
    watch.finished(BAD)
    clock.now_s += 5.0
    watch.look([("a", 5.0)])
    watch.look([("a", 5.0)])
    watch.end(CampaignSummary(4, (OK, BAD), 5.0))
    lines = said.getvalue().splitlines()
    assert lines[0] == "b: failed: b.mcap: damaged"
    assert [line.partition(",")[0] for line in lines[1:]] == ["2/4 runs", "2/4 runs"]
    assert "longest now: a" in lines[1]


def test_bar_on_a_terminal(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, width=160, color_system=None)
    monkeypatch.setattr(rich.console, "Console", lambda **_: screen)
    watch = BarWatch()
    watch.begin(len(plan.jobs), plan.out)
    watch.finished(OK)
    watch.finished(BAD)
    watch.end(CampaignSummary(4, (OK, BAD), 5.0))
    said = screen.file.getvalue()  # type: ignore[attr-defined]
    assert "b: failed: b.mcap: damaged" in said
    assert "2/4" in said
    assert "1 failed or partial" in said


def test_log_beside_the_results(plan: Plan) -> None:
    watch = LogWatch()
    Path(plan.out).mkdir(exist_ok=True)
    watch.begin(len(plan.jobs), plan.out)
    watch.finished(OK)
    watch.finished(RunOutcome("d", RunStatus.FAILED, "defect", trace="at s3://me:secret@store/x\n"))
    watch.end(CampaignSummary(4, (OK,), 5.0))
    lines = (Path(plan.out) / "replay.log").read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ ", line) for line in lines if line)
    assert lines[0].endswith("4 runs")
    assert "a: safe in 2" in lines[1]
    assert "secret" not in "".join(lines)
    assert "safe: 0 unsafe, 0 unproven, 1 safe, 0 failed; 1 of 4 runs" in lines[-1]


def test_the_verdict_is_the_first_word() -> None:
    summary = CampaignSummary(4, (OK, BAD, OLD), 5.0)
    assert campaign.summary_line(summary).startswith("unsafe: 1 unsafe, 0 unproven, 1 safe, 1 failed; 3 of 4 runs")
    assert campaign.outcome_line(OLD) == "c: skipped, unsafe"
    partial = RunOutcome("d", RunStatus.PARTIAL, "cut off", verdict=RunVerdict.UNPROVEN)
    assert campaign.outcome_line(partial) == "d: unproven, partial: cut off"
    rows = campaign.outcome_rows(summary)
    assert rows.columns[:3] == ["verdict", "run_id", "status"]
    assert rows["verdict"].to_list() == ["safe", "failed", "unsafe"]


@pytest.mark.parametrize(
    ("quiet", "terminal", "kinds"),
    [(True, True, [LogWatch]), (False, True, [BarWatch, LogWatch]), (False, False, [LineWatch, LogWatch])],
)
def test_who_watches(
    monkeypatch: pytest.MonkeyPatch, quiet: bool, terminal: bool, kinds: list[Callable[[], object]]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal)
    assert [type(watch) for watch in watches(quiet)] == kinds


def test_json_lines_for_programs(clock: Clock, plan: Plan) -> None:
    said = io.StringIO()
    watch = JsonWatch(said)
    watch.begin(len(plan.jobs), plan.out)
    watch.look([("a", 1.0)])
    clock.now_s += 5.0
    watch.look([("a", 5.0), ("b", 2.0), ("c", 3.0)])
    watch.lost("b", 1)
    watch.finished(OK)
    watch.finished(BAD)
    watch.end(CampaignSummary(4, (OK, BAD), 5.0))
    lines = [json.loads(line) for line in said.getvalue().splitlines()]
    assert [line["event"] for line in lines] == ["progress", "progress", "lost", "run", "run", "progress"]
    nothing = {"done": 0, "failed": 0, "skipped": 0, "total": 4, "rate_per_s": None, "left_s": None}
    assert lines[0] == {"event": "progress", **nothing, "slow": []}
    slow = [{"run_id": "a", "seconds": 5.0}, {"run_id": "c", "seconds": 3.0}]
    assert lines[1] == {"event": "progress", **nothing, "slow": slow}
    assert lines[2] == {"event": "lost", "run_id": "b", "attempt": 1}
    assert (lines[3]["run_id"], lines[3]["status"], lines[3]["error"]) == ("a", "ok", None)
    assert (lines[3]["done"], lines[3]["rate_per_s"], lines[3]["left_s"]) == (1, 0.2, 15.0)
    assert (lines[4]["status"], lines[4]["error"], lines[4]["failed"]) == ("failed", "b.mcap: damaged", 1)
    assert lines[5]["done"] == 2


@pytest.mark.parametrize("quiet", [False, True])
@pytest.mark.usefixtures("in_process")
def test_json_on_both_streams(
    small_trial: SmallTrial, tmp_path: Path, quiet: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    flags = ["--json", "--quiet"] if quiet else ["--json"]
    runs = map(str, small_trial.paths[:2])
    cli._run_guarded(["replay", *runs, "--site", str(small_trial.site), "--out", str(tmp_path), *flags], debug=False)
    said = capfd.readouterr()
    result = json.loads(said.out)
    assert [row["run_id"] for row in result["runs"]] == ["run0", "run1"]
    assert [row["attempts"] for row in result["runs"]] == [1, 1]
    lines = [json.loads(line) for line in said.err.splitlines()]
    assert sorted(line["run_id"] for line in lines if line["event"] == "run") == ([] if quiet else ["run0", "run1"])
    assert bool(lines) is not quiet


def test_each_remedy_stands_once_with_its_command_and_the_worst_run() -> None:
    runs = [
        replace(OK, run_id="b", log="logs/b.mcap", remedies=("route",), remedies_gain=(0.1,), moving_s=100.0),
        replace(OLD, run_id="a", log="logs/a.mcap", remedies=("vehicle_file", "route"), remedies_gain=(0.2, 0.15)),
    ]
    runs[1] = replace(runs[1], moving_s=300.0)
    lines = campaign.remedy_lines(
        CampaignSummary(2, tuple(runs), 1.0), site="line9", out="week", options=" --config c.toml"
    )
    assert lines == [
        "1 of 2 runs: calibrate the odometer on two or more other fault-free runs of this vehicle: "
        "`balise replay logs/a.mcap --site line9 --out week --config c.toml --calibrate 'OTHER_RUNS/*'`"
        "; would win back or prove up to 15% of the moving time",
        "2 of 2 runs: give the route that the train took: "
        "`balise replay logs/a.mcap --site line9 --out week --config c.toml --route ROUTES` "
        "(--write-route ROUTES writes what was found); would win back or prove up to 14% of the moving time",
    ]


def test_what_stands_beside_a_verdict_in_the_ending() -> None:
    once = {"balises_found": 28, "balises_passed": 31}
    figures = {**once, "balises_accepted": 28, "balises_on_path": 31, "availability": 0.964, "proof_margin_m": 11.26}
    safe = replace(OK, **figures, moving_s=900.0)
    twice = {"balises_found": 2, "balises_passed": 9, "balises_accepted": 4, "balises_on_path": 18}
    poor = replace(OLD, **twice, availability=0.0, moving_s=100.0, lost="100% alarms")
    rows = campaign.ending_rows(CampaignSummary(2, (safe, BAD), 1.0))
    columns = ("verdict", "accepted", "available", "margin")
    assert rows.select(columns).rows() == [("failed", "-", "-", "-"), ("safe", "28 of 31", "96%", "11.3 m")]
    poor_row = campaign.ending_rows(CampaignSummary(1, (poor,), 1.0)).row(0, named=True)
    assert (poor_row["accepted"], poor_row["margin"], poor_row["why"]) == (
        "2 of 9 (4 times in 18 passages)",
        "-",
        "lost to 100% alarms",
    )
    line = campaign.summary_line(CampaignSummary(3, (safe, poor, BAD), 1.0))
    accepted = "; 30 of 40 balises accepted (32 times in 49 passages), "
    assert f"{accepted}available for 87% of the moving time, proof margin 11.3 m; 3 of 3 runs" in line
    # What a safe verdict rests on by declaration alone stands beside it; other verdicts need no such words.
    declared = [replace(one, odometer_origin="wheel") for one in (safe, poor)]
    lines = [campaign.summary_line(CampaignSummary(1, (one,), 1.0)) for one in declared]
    assert ", provided that the odometer is a wheel, as declared; 1 of 1 runs" in lines[0]
    assert "provided" not in lines[1]
