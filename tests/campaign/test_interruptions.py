"""What happens to campaigns on real machines: signals, sudden death, full and read-only disks."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import cli
from benchmarks.growth import interruptions
from benchmarks.growth.interruptions import Job, Victim, disturb
from pipeline import storage
from pipeline.campaign import Interrupted, make_plan, run_campaign
from pipeline.campaign.lock import hold_output
from pipeline.campaign.worker import replay_one
from pipeline.results import store
from pipeline.storage.address import Address
from schemas.enums import RunStatus
from schemas.errors import OutputError
from tests.campaign.compare import ROOT, campaign_bytes, command, endless, plan_of, result_bytes, start, wait_for
from tests.conftest import SmallTrial


@contextlib.contextmanager
def tmpfs(folder: Path, options: str) -> Iterator[Path]:
    """A small file system of its own; needs the right to mount one."""
    folder.mkdir()
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True, check=False
    )
    if mount.returncode:
        pytest.skip("this user may not mount a file system")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize(
    ("signum", "status", "jobs", "stuck"),
    [(signal.SIGINT, 130, "2", "never"), (signal.SIGTERM, 143, "1", "run2_never")],
)
def test_stop_on_request(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, signum: int, status: int, jobs: str, stuck: str
) -> None:
    """Runs are replayed in the order of their names: one worker of two, or the only one, never ends with its run."""
    endless(tmp_path / f"{stuck}.mcap")
    out = tmp_path / "out"
    process = start(command(small_trial, out, "--jobs", jobs, runs=[tmp_path / f"{stuck}.mcap", *small_trial.paths]))
    wait_for(lambda: len(store.run_ids(out)) >= 2)
    os.killpg(process.pid, signum) if signum == signal.SIGINT else process.send_signal(signum)
    # The run in work never ends by itself; how soon the campaign ends is measured by `make bench`.
    stdout, stderr = process.communicate(timeout=300)
    assert process.returncode == status, stderr
    assert "of 5 runs" in stdout
    assert "interrupted" in stderr
    assert "Traceback" not in stderr
    done = set(store.run_ids(out))
    assert 2 <= len(done) <= 4
    whole = result_bytes(undisturbed)
    assert all(whole[name] == data for name, data in result_bytes(out).items())
    assert run_campaign(plan_of(small_trial, out)).count_skipped == len(done)
    assert result_bytes(out) == whole
    assert campaign_bytes(out) == campaign_bytes(undisturbed)


def test_progress_that_nobody_reads(small_trial: SmallTrial, tmp_path: Path) -> None:
    """`2>&1 | head -1` and `nohup` do not end a campaign."""
    process = subprocess.Popen(
        ["nohup", *command(small_trial, tmp_path, "--jobs", "1", "--json", runs=small_trial.paths[:2])],
        cwd=ROOT,
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    assert process.stderr is not None
    process.stderr.readline()
    process.stderr.close()
    process.send_signal(signal.SIGHUP)
    assert process.wait(timeout=300) == 0
    assert len(store.run_ids(tmp_path)) == 2


@pytest.fixture
def _heard() -> Iterator[None]:
    """Signals come through, also where the tests are told to ignore them: by `nohup`, or by `&` in a script."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    before = {signum: signal.signal(signum, handler) for signum, handler in usual.items()}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.mark.usefixtures("_heard")
@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_stop_on_request_at_the_very_end(
    small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signum: int
) -> None:
    """While the campaign's own tables are written: the runs are complete, and the summary says so."""

    def slow(*_: object) -> None:
        os.kill(os.getpid(), signum)
        time.sleep(300.0)

    plan = plan_of(small_trial, tmp_path, small_trial.paths[:1])
    with monkeypatch.context() as patched:
        patched.setattr("pipeline.campaign.run.write_campaign", slow)
        with pytest.raises(Interrupted) as caught:
            run_campaign(plan)
    assert caught.value.signum == signum
    assert caught.value.summary is not None
    assert caught.value.summary.count(RunStatus.OK) == 1
    assert not (tmp_path / "campaign").exists()
    assert run_campaign(plan).count_skipped == 1
    assert (tmp_path / "campaign/runs.parquet").exists()


def test_trials_see_what_is_wrong(small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kills of `make bench`: a result that is not what an undisturbed campaign gives does not pass for one."""
    shutil.copytree(small_trial.paths[0], tmp_path / "logs/run0")
    monkeypatch.setattr(interruptions, "_kill", lambda *_: _spoil(tmp_path / "killed"))

    def done_here(job: Job, out: Path, *_: object) -> subprocess.Popen[bytes]:
        run_campaign(make_plan([str(job.logs)], job.site, out))
        return subprocess.Popen(["true"])

    monkeypatch.setattr(Job, "start", done_here)
    (kill,) = disturb(Job(tmp_path / "logs", small_trial.site, tmp_path), [Victim.PARENT], trials=1, seed=7)
    assert kill.different == ("stray.parquet",)


def _spoil(out: Path) -> bool:
    out.mkdir(exist_ok=True)
    (out / "stray.parquet").touch()
    return True


def test_a_campaign_that_has_ended_writes_no_more(small_trial: SmallTrial, tmp_path: Path) -> None:
    """The worker of a lost cluster may be at it still when the next campaign has begun, or is over."""
    plan = plan_of(small_trial, tmp_path, small_trial.paths[:1])
    run_campaign(plan)
    before = result_bytes(tmp_path)
    orphan = replace(plan.jobs[0], campaign="lost")
    with pytest.raises(OutputError, match="no longer held by this campaign"):
        replay_one(orphan)
    with hold_output(tmp_path), pytest.raises(OutputError, match="no longer held by this campaign"):
        replay_one(orphan)
    assert result_bytes(tmp_path) == before


def test_swept_files_are_written_again(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another campaign cleans up between the writing of the files and their naming."""
    commit, sweeps = storage.commit, iter([True])

    def swept(staged: list[tuple[Address, Address]]) -> None:
        if next(sweeps, False):
            store.sweep(tmp_path)
        commit(staged)

    plan = plan_of(small_trial, tmp_path, small_trial.paths[:1])
    monkeypatch.setattr(storage, "commit", swept)
    replay_one(plan.jobs[0])
    wanted = {name: data for name, data in result_bytes(undisturbed).items() if "run0" in name}
    assert result_bytes(tmp_path) == wanted


def test_one_campaign_at_a_time_and_orphaned_workers_go(
    small_trial: SmallTrial, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    endless(tmp_path / "never.mcap")
    out = tmp_path / "out"
    process = start(command(small_trial, out, "--jobs", "2", runs=[tmp_path / "never.mcap", *small_trial.paths]))
    try:
        wait_for(lambda: bool(store.run_ids(out)))
        workers = children_of(process.pid)
        assert of_this_process(command(small_trial, out)) == 2, "a second campaign writes into the same output"
        assert "another campaign is writing here" in capfd.readouterr().err
    finally:
        process.kill()
        process.communicate(timeout=300)
    assert workers, "the campaign had no workers"
    wait_for(lambda: not any(alive(pid) for pid in workers), why="workers live on without their campaign")


def children_of(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(child) for child in listed.split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def of_this_process(arguments: list[str]) -> int:
    """Exit status of a command line that does not need a process of its own."""
    return cli._run_guarded(arguments[3:], debug=False)


@pytest.mark.usefixtures("in_process")
def test_full_disk(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with tmpfs(tmp_path / "disk", "size=192k") as disk:
        out = disk / "out"
        assert of_this_process(command(small_trial, out, "--jobs", "1")) == 2
        said = capfd.readouterr().err
        assert "No space left on device" in said
        assert "Traceback" not in said
        complete = store.run_ids(out)
        assert len(complete) < 4
        whole = result_bytes(undisturbed)
        assert all(whole[name] == data for name, data in result_bytes(out).items() if ".tmp" not in name)
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        assert run_campaign(plan_of(small_trial, out)).count_skipped == len(complete)
        assert result_bytes(out) == whole


def test_read_only_output(small_trial: SmallTrial, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with tmpfs(tmp_path / "disk", "ro,size=1m") as disk:
        assert of_this_process(command(small_trial, disk / "out")) == 2
    assert "cannot be written: Read-only file system" in capfd.readouterr().err


def test_output_that_nobody_reads_changes_no_status(small_trial: SmallTrial, tmp_path: Path) -> None:
    """`replay ... 2>&1 | head -1`: the status is that of the runs."""
    words = command(small_trial, tmp_path, "--jobs", "1", runs=small_trial.paths[:1])
    process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    assert process.stdout is not None
    process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=300) == 0
    assert len(store.run_ids(tmp_path)) == 1
