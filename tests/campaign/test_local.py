"""Campaigns on this machine: the same tables however they are done, and nothing done twice."""

from __future__ import annotations

import importlib
import multiprocessing
import os
import re
import shutil
import signal
from collections.abc import Callable, Sequence
from multiprocessing.context import SpawnProcess
from pathlib import Path

import polars as pl
import pytest

from datasets.mcap_log import write_mcap
from pipeline import storage
from pipeline.campaign import CampaignSummary, RunOutcome, make_plan, recorded_log, run_campaign
from pipeline.campaign.outcome import lost_text, never_begun_text
from pipeline.campaign.plan import _kept_sites
from pipeline.campaign.waits import WAITS
from pipeline.read.ingest import read_run
from pipeline.results import store
from pipeline.show.progress import LogWatch
from schemas.config import Configuration, IngestConfig, LdsConfig, SiteConfig
from schemas.enums import RunStatus
from schemas.errors import OutputError, UsageError
from schemas.run import RunLog, Site
from tests.campaign.compare import Hurried, by_run, campaign_bytes, endless, plan_of, result_bytes
from tests.conftest import SmallTrial

BEGUN_S = 0.1
"""Between two looks (0.2 s): until a worker has begun the run, its age begins anew at each."""


class Spy:
    """A watch that acts on the workers."""

    def __init__(self, act: Callable[[str, float], None]) -> None:
        self.act = act
        self.ended: list[RunOutcome] = []
        self.losses: list[tuple[str, int]] = []
        self.notes: list[str] = []

    def begin(self, runs: int, out: str) -> None:
        self.ended.clear()

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        for run_id, age_s in under_way:
            self.act(run_id, age_s)

    def lost(self, run_id: str, attempt: int) -> None:
        self.losses.append((run_id, attempt))

    def noted(self, text: str) -> None:
        self.notes.append(text)

    def finished(self, outcome: RunOutcome) -> None:
        self.ended.append(outcome)

    def end(self, summary: CampaignSummary) -> None:
        assert len(self.ended) == len(summary.outcomes)


def one_run(trial: SmallTrial, folder: Path) -> Path:
    """A copy of one run that a test may change."""
    return Path(shutil.copytree(trial.paths[0], folder / trial.paths[0].name))


def test_any_number_of_jobs_gives_the_same_bytes(small_trial: SmallTrial, undisturbed: Path, tmp_path: Path) -> None:
    summary = run_campaign(plan_of(small_trial, tmp_path / "two", small_trial.paths[::-1]), jobs=2)
    assert [outcome.status for outcome in summary.outcomes] == [RunStatus.OK] * 4
    assert result_bytes(tmp_path / "two") == result_bytes(undisturbed)
    assert len(result_bytes(undisturbed)) == 4 * 5
    assert campaign_bytes(tmp_path / "two") == campaign_bytes(undisturbed)


def test_campaign_tables_stand_for_all_complete_runs(small_trial: SmallTrial, undisturbed: Path) -> None:
    runs = pl.read_parquet(undisturbed / "campaign/runs.parquet")
    assert runs["run_id"].to_list() == ["run0", "run1", "run2", "run3"]
    passages = store.read_table(undisturbed, "passages").collect()
    balises = pl.read_parquet(undisturbed / "campaign/balises.parquet")
    assert balises["accepted"].sum() == passages.filter(pl.col("status") == "accepted").height
    assert set(balises["balise_id"]) == set(passages["balise_id"])


def test_a_log_is_known_by_what_its_files_hold(small_trial: SmallTrial, tmp_path: Path) -> None:
    """However its digest was come by: of its own before the log was read, while it was read, or after that failed."""
    good, damaged, folder = tmp_path / "good.mcap", tmp_path / "damaged.mcap", small_trial.paths[0]
    with good.open("wb") as stream:
        write_mcap(read_run(folder, IngestConfig()), stream)
    damaged.write_bytes(b"\x89MCAP0\r\n cut")
    for path in (good, damaged, folder):
        plan = plan_of(small_trial, tmp_path / "out", [path])
        run_campaign(plan, force=True)
        known = store.completed_runs(tmp_path / "out")[path.stem]["files_digest"]
        assert known == storage.digest_of_files(storage.file_digests(path))
        assert run_campaign(plan).count_skipped == 1


@pytest.mark.usefixtures("in_process")
def test_failed_runs_do_not_stop_the_others(small_trial: SmallTrial, undisturbed: Path, tmp_path: Path) -> None:
    damaged = [tmp_path / f"damaged{number}.mcap" for number in range(3)]
    for path in damaged:
        path.write_bytes(b"\x89MCAP0\r\n cut")
    out = tmp_path / "out"
    summary = run_campaign(plan_of(small_trial, out, [*damaged, *small_trial.paths]))
    assert summary.count(RunStatus.OK) == 4
    outcomes = by_run(summary)
    for path in damaged:
        assert outcomes[path.stem].status is RunStatus.FAILED
        assert str(path) in (outcomes[path.stem].error or "")
    row = store.read_table(out, "runs", "damaged0").collect().row(0, named=True)
    assert row["status"] == "failed"
    assert row["error"].startswith("damaged0.mcap: ")
    kept = {name: data for name, data in result_bytes(out).items() if "damaged" not in name}
    assert kept == result_bytes(undisturbed)


def test_complete_runs_are_skipped(small_trial: SmallTrial, tmp_path: Path) -> None:
    run, out = one_run(small_trial, tmp_path), tmp_path / "out"
    first = run_campaign(plan_of(small_trial, out, [run]))
    again = run_campaign(plan_of(small_trial, out, [run]))
    forced = run_campaign(plan_of(small_trial, out, [run]), force=True)
    assert [summary.count_skipped for summary in (first, again, forced)] == [0, 1, 0]
    assert [summary.count(RunStatus.OK) for summary in (first, again, forced)] == [1, 1, 1]


def test_skipped_failures_are_still_failures(small_trial: SmallTrial, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"not a log")
    plan = plan_of(small_trial, tmp_path / "out", [tmp_path / "bad.mcap"])
    run_campaign(plan)
    again = by_run(run_campaign(plan))["bad"]
    assert (again.status, again.skipped) == (RunStatus.FAILED, True)
    assert again.error


def test_what_changed_is_replayed_again(small_trial: SmallTrial, tmp_path: Path) -> None:
    run, site, out = one_run(small_trial, tmp_path), tmp_path / "site", tmp_path / "out"
    shutil.copytree(small_trial.site, site)

    def skipped(config: Configuration | None = None) -> int:
        return run_campaign(make_plan([str(run)], site, out, config)).count_skipped

    assert skipped() == 0
    stat = (run / "odometer.parquet").stat()
    shutil.copy(small_trial.paths[1] / "odometer.parquet", run / "odometer.parquet")
    os.utime(run / "odometer.parquet", ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert [skipped(), skipped()] == [0, 1]
    other = Configuration(lds=LdsConfig(ci_limit_m=13.0))
    assert [skipped(other), skipped(other)] == [0, 1]
    assert (out / "runs/run_id=run0/runs.parquet").exists()
    (site / "balises.parquet").unlink()
    assert [skipped(), skipped()] == [0, 1]


def test_clock_and_file_times_decide_nothing(
    small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out = one_run(small_trial, tmp_path), tmp_path / "out"
    ticks = iter(range(2_000_000_000, 0, -1))
    monkeypatch.setattr("time.time", lambda: float(next(ticks)))
    assert run_campaign(plan_of(small_trial, out, [run])).count(RunStatus.OK) == 1
    os.utime(run / "gnss.parquet", (0, 0))
    assert run_campaign(plan_of(small_trial, out, [run])).count_skipped == 1


def test_log_that_changes_while_it_is_read(
    small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out = one_run(small_trial, tmp_path), tmp_path / "out"

    def read_and_append(path: Path, config: IngestConfig) -> RunLog:
        log = read_run(path, config)
        with (run / "gnss.parquet").open("ab") as file:
            file.write(b"more")
        return log

    with monkeypatch.context() as patched:
        patched.setattr(recorded_log, "read_run", read_and_append)
        changed = by_run(run_campaign(plan_of(small_trial, out, [run])))["run0"]
    assert changed.status is RunStatus.FAILED
    assert "changed while it was read" in (changed.error or "")
    shutil.copy(small_trial.paths[0] / "gnss.parquet", run / "gnss.parquet")
    again = by_run(run_campaign(plan_of(small_trial, out, [run])))["run0"]
    assert (again.status, again.skipped) == (RunStatus.OK, False)


def test_a_panic_fails_its_run_only(small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Libraries written in Rust raise what is no `Exception`; decoding, it is the log's fault, later our own."""
    panics: dict[str, BaseException] = {
        "run1": pl.exceptions.PanicException("range end index 7 out of range"),
        "run2": BaseExceptionGroup("of many", [GeneratorExit()]),
    }

    def read(path: Path, config: IngestConfig) -> RunLog:
        if path.name in panics:
            raise panics[path.name]
        return read_run(path, config)

    monkeypatch.setattr(recorded_log, "read_run", read)
    plans = [plan_of(small_trial, tmp_path, [path]) for path in small_trial.paths[:3]]
    outcomes = [run_campaign(plan).outcomes[0] for plan in plans]
    assert [outcome.status for outcome in outcomes] == [RunStatus.OK, RunStatus.FAILED, RunStatus.FAILED]
    assert [outcome.is_defect for outcome in outcomes] == [False, False, True]
    assert re.search("run1: cannot be decoded, it is damaged: range end", outcomes[1].error or "")
    assert store.run_ids(tmp_path) == ["run0", "run1", "run2"]


def test_our_own_defect_is_told_apart(small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    plan = plan_of(small_trial, tmp_path, small_trial.paths[:1])
    with monkeypatch.context() as patched:
        patched.setattr(importlib.import_module("pipeline.one_run"), "replay", broken)
        outcome = by_run(run_campaign(plan))["run0"]
    assert outcome.is_defect
    assert "ZeroDivisionError" in (outcome.trace or "")
    assert by_run(run_campaign(plan))["run0"].status is RunStatus.OK


@pytest.mark.usefixtures("forked_workers")
def test_killed_worker_is_tried_once_more(small_trial: SmallTrial, undisturbed: Path, tmp_path: Path) -> None:
    killed: list[int] = []

    def kill_first(run_id: str, age_s: float) -> None:
        if age_s > BEGUN_S and not killed:
            killed.extend(child.pid or 0 for child in multiprocessing.active_children()[:1])
            for pid in killed:
                os.kill(pid, signal.SIGKILL)

    spy = Spy(kill_first)
    summary = run_campaign(plan_of(small_trial, tmp_path), jobs=1, watches=[spy, LogWatch()])
    assert killed
    ((unlucky, attempt),) = spy.losses
    assert attempt == 1
    assert {outcome.run_id: outcome.attempts for outcome in summary.outcomes if outcome.attempts > 1} == {unlucky: 2}
    log = (tmp_path / "replay.log").read_text()
    assert f" {unlucky}: its worker died at attempt 1; tried again\n" in log
    assert re.search(f" {unlucky}: unproven in .* \\(attempt 2\\)\n", log)
    assert summary.count(RunStatus.OK) == 4
    assert result_bytes(tmp_path) == result_bytes(undisturbed)


@pytest.mark.parametrize(("signum", "strikes"), [(signal.SIGKILL, 3), (signal.SIGSTOP, 1)])
def test_a_worker_that_dies_or_stays_while_it_starts_costs_no_attempt(
    small_trial: SmallTrial,
    undisturbed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    signum: int,
    strikes: int,
) -> None:
    """Also where the site is larger than a pipe: nobody waits for a dead process to read it. Workers that stay (a disk
    that does not answer) are given up."""
    begin = SpawnProcess.start
    struck: list[int] = []

    def start(process: SpawnProcess) -> None:
        begin(process)
        if len(struck) < strikes and process.pid:
            os.kill(process.pid, signum)
            struck.append(process.pid)

    plan = plan_of(small_trial, tmp_path)
    monkeypatch.setattr(SpawnProcess, "start", start)
    large = Site(pl.DataFrame({"x": range(10**5)}), pl.DataFrame(), None)
    monkeypatch.setattr("pipeline.campaign.plan._kept_sites", {**_kept_sites, ("other", SiteConfig()): large})
    if signum == signal.SIGSTOP:
        monkeypatch.setattr(WAITS, "start_s", 8.0)
    summary = run_campaign(plan, jobs=1)
    assert len(struck) == strikes
    assert [outcome.attempts for outcome in summary.outcomes] == [1] * 4
    assert result_bytes(tmp_path) == result_bytes(undisturbed)


def test_workers_that_never_start_fail_their_runs(
    small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = SpawnProcess.start

    def start(process: SpawnProcess) -> None:
        begin(process)
        os.kill(process.pid or 0, signal.SIGKILL)

    plan = plan_of(small_trial, tmp_path, small_trial.paths[:2])
    monkeypatch.setattr(SpawnProcess, "start", start)
    summary = run_campaign(plan, jobs=2)
    assert [outcome.error for outcome in summary.outcomes] == [never_begun_text(WAITS.starts)] * 2
    assert run_campaign(plan).count(RunStatus.FAILED) == 2


@pytest.mark.usefixtures("forked_workers")
def test_run_whose_worker_always_dies_is_reported(small_trial: SmallTrial, tmp_path: Path) -> None:
    endless(tmp_path / "deadly.mcap")
    deaths: set[int] = set()

    def kill_it(run_id: str, age_s: float) -> None:
        if run_id == "deadly" and age_s > BEGUN_S:
            for child in multiprocessing.active_children():
                deaths.add(child.pid or 0)
                child.kill()

    plan = plan_of(small_trial, tmp_path / "out", [tmp_path / "deadly.mcap", *small_trial.paths[:1]])
    summary = by_run(run_campaign(plan, jobs=1, watches=[Spy(kill_it)]))
    assert summary["deadly"].status is RunStatus.FAILED
    assert summary["deadly"].error == lost_text(2)
    assert summary["run0"].status is RunStatus.OK
    assert len(deaths) >= 2
    assert store.completed_runs(tmp_path / "out")["deadly"]["redo"] == "yes"


@pytest.mark.usefixtures("forked_workers")
def test_hanging_run_is_given_up(small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endless(tmp_path / "hanging.mcap")
    clock = Hurried(monkeypatch, "run")

    def hurry(run_id: str, age_s: float) -> None:
        if run_id == "hanging" and age_s > 0.0 and len(spy.ended) == 2:
            clock.hurry(3600.0)

    plan = plan_of(small_trial, tmp_path / "out", [tmp_path / "hanging.mcap", *small_trial.paths[:2]])
    spy = Spy(hurry)
    summary = by_run(run_campaign(plan, jobs=2, time_limit_s=3600.0, watches=[spy]))
    assert summary["hanging"].status is RunStatus.FAILED
    assert "time limit of 3600 s" in (summary["hanging"].error or "")
    assert [summary[f"run{number}"].status for number in range(2)] == [RunStatus.OK] * 2


def test_single_run_is_given_up_too(tmp_path: Path, small_trial: SmallTrial) -> None:
    endless(tmp_path / "hanging.mcap")
    plan = plan_of(small_trial, tmp_path / "out", [tmp_path / "hanging.mcap"])
    outcome = by_run(run_campaign(plan, time_limit_s=0.5))["hanging"]
    assert (outcome.status, outcome.is_defect) == (RunStatus.FAILED, False)
    assert "time limit of 0.5 s" in (outcome.error or "")


def test_output_held_by_another_campaign(small_trial: SmallTrial, tmp_path: Path) -> None:
    from pipeline.campaign.lock import hold_output

    plan = plan_of(small_trial, tmp_path, small_trial.paths[:1])
    with hold_output(tmp_path), pytest.raises(OutputError, match="another campaign is writing here"):
        run_campaign(plan)
    assert run_campaign(plan).count(RunStatus.OK) == 1


def test_changed_software_is_refused(small_trial: SmallTrial, tmp_path: Path) -> None:
    from dataclasses import replace

    plan = plan_of(small_trial, tmp_path, small_trial.paths[:1])
    other = replace(plan, jobs=tuple(replace(job, software_digest="other") for job in plan.jobs))
    with pytest.raises(UsageError, match="another version of the program"):
        run_campaign(other)
