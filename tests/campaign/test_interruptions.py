"""What happens to campaigns on real machines: signals, sudden death, full and read-only disks."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline import store
from tests.campaign.compare import campaign_bytes, command, result_bytes, run, start, wait_for
from tests.campaign.test_local import undisturbed
from tests.conftest import SmallTrial

__all__ = ["undisturbed"]


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


@pytest.mark.parametrize(("signum", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_stop_on_request(small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, signum: int, status: int) -> None:
    os.mkfifo(tmp_path / "never.mcap")
    out = tmp_path / "out"
    process = start(command(small_trial, out, "--jobs", "2", runs=[tmp_path / "never.mcap", *small_trial.paths]))
    wait_for(lambda: len(store.run_ids(out)) >= 2)
    os.killpg(process.pid, signum) if signum == signal.SIGINT else process.send_signal(signum)
    stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == status, stderr
    assert "of 5 runs" in stdout
    assert "interrupted" in stderr
    assert "Traceback" not in stderr
    done = set(store.run_ids(out))
    assert 2 <= len(done) <= 4
    whole = result_bytes(undisturbed)
    assert all(whole[name] == data for name, data in result_bytes(out).items())
    again = run(command(small_trial, out, "--jobs", "2"))
    assert again.returncode == 0, again.stderr
    assert result_bytes(out) == whole
    assert campaign_bytes(out) == campaign_bytes(undisturbed)


def test_sudden_death_of_the_parent(small_trial: SmallTrial, undisturbed: Path, tmp_path: Path) -> None:
    chance = random.Random(7)
    for trial in range(2):
        process = start(command(small_trial, tmp_path, "--jobs", "2", "--force"))
        time.sleep(chance.uniform(0.5, 4.0))
        process.kill()
        process.communicate(timeout=30)
        again = run(command(small_trial, tmp_path, "--jobs", "2"))
        assert again.returncode == 0, (trial, again.stderr)
        assert result_bytes(tmp_path) == result_bytes(undisturbed), trial


def test_orphaned_workers_go(small_trial: SmallTrial, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "never.mcap")
    process = start(
        command(small_trial, tmp_path / "out", "--jobs", "2", runs=[tmp_path / "never.mcap", *small_trial.paths])
    )
    wait_for(lambda: bool(store.run_ids(tmp_path / "out")))
    workers = children_of(process.pid)
    assert workers
    process.kill()
    process.communicate(timeout=30)
    wait_for(lambda: not any(alive(pid) for pid in workers))


def children_of(pid: int) -> list[int]:
    listed = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(child) for child in listed.split()]


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_two_campaigns_on_one_output(small_trial: SmallTrial, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "never.mcap")
    out = tmp_path / "out"
    process = start(command(small_trial, out, "--jobs", "2", runs=[tmp_path / "never.mcap", *small_trial.paths]))
    try:
        wait_for(lambda: bool(store.run_ids(out)))
        second = run(command(small_trial, out))
        assert second.returncode == 2
        assert "another campaign is writing here" in second.stderr
    finally:
        process.kill()
        process.communicate(timeout=30)


def test_full_disk(small_trial: SmallTrial, undisturbed: Path, tmp_path: Path) -> None:
    with tmpfs(tmp_path / "disk", "size=192k") as disk:
        out = disk / "out"
        full = run(command(small_trial, out, "--jobs", "2"))
        assert full.returncode == 2
        assert "No space left on device" in full.stderr
        assert "Traceback" not in full.stderr
        complete = store.run_ids(out)
        assert len(complete) < 4
        whole = result_bytes(undisturbed)
        assert all(whole[name] == data for name, data in result_bytes(out).items() if ".tmp" not in name)
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        again = run(command(small_trial, out, "--jobs", "2"))
        assert again.returncode == 0, again.stderr
        assert f"{len(complete)} of them complete before" in again.stdout or not complete
        assert result_bytes(out) == whole


def test_read_only_output(small_trial: SmallTrial, tmp_path: Path) -> None:
    with tmpfs(tmp_path / "disk", "ro,size=1m") as disk:
        refused = run(command(small_trial, disk / "out"))
    assert refused.returncode == 2
    assert "cannot be written: Read-only file system" in refused.stderr
