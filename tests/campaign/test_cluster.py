"""The same campaign on a Dask cluster."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.campaign import run_campaign
from schemas.enums import RunStatus
from schemas.errors import UsageError
from tests.campaign.compare import ROOT, by_run, plan_of, result_bytes, run, wait_for
from tests.campaign.compare import command as replay_command
from tests.campaign.test_local import undisturbed
from tests.conftest import SmallTrial

__all__ = ["undisturbed"]


class Cluster:
    """A scheduler and one worker, in processes of their own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "scheduler.json"
        common = ["--scheduler-file", str(self.file)]
        self.scheduler = _dask("scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1", *common)
        wait_for(lambda: self.file.exists() and self.file.read_text().rstrip().endswith("}"))
        self.worker = self.start_worker()

    def start_worker(self) -> subprocess.Popen[bytes]:
        arguments = ("--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder))
        return _dask("worker", "--scheduler-file", str(self.file), *arguments)

    @property
    def address(self) -> str:
        import json

        return str(json.loads(self.file.read_text())["address"])

    def stop(self) -> None:
        for process in (self.worker, self.scheduler):
            process.terminate()
            process.wait(timeout=30)


def _dask(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "dask", *arguments],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT), "POLARS_MAX_THREADS": "1"},
    )


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    (tmp_path / "cluster").mkdir()
    cluster = Cluster(tmp_path / "cluster")
    yield cluster
    cluster.stop()


def test_same_bytes_on_a_cluster(small_trial: SmallTrial, undisturbed: Path, cluster: Cluster, tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"not a log")
    plan = plan_of(small_trial, tmp_path / "out", [tmp_path / "bad.mcap", *small_trial.paths])
    outcomes = by_run(run_campaign(plan, scheduler=cluster.address))
    assert outcomes.pop("bad").status is RunStatus.FAILED
    assert {outcome.status for outcome in outcomes.values()} == {RunStatus.OK}
    tables = {name: data for name, data in result_bytes(tmp_path / "out").items() if "=bad" not in name}
    assert tables == result_bytes(undisturbed)


def test_killed_worker_and_scheduler(
    small_trial: SmallTrial, undisturbed: Path, cluster: Cluster, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    first = subprocess.Popen(
        replay_command(small_trial, out, "--scheduler", cluster.address), cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: any((out / "runs").glob("*/runs.parquet")))
    cluster.worker.kill()
    cluster.worker.wait()
    cluster.worker = cluster.start_worker()
    cluster.scheduler.kill()
    _, said = first.communicate(timeout=90)
    assert "Traceback" not in said
    assert first.returncode in (0, 2)
    again = run(replay_command(small_trial, out, "--jobs", "2"))
    assert again.returncode == 0, again.stderr
    assert result_bytes(out) == result_bytes(undisturbed)


def test_scheduler_that_is_not_there(small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.campaign.cluster._CONNECT_S", 1.0)
    with pytest.raises(UsageError, match="Dask scheduler does not answer"):
        run_campaign(plan_of(small_trial, tmp_path), scheduler="tcp://127.0.0.1:9")


def test_cluster_that_lost_its_workers(
    small_trial: SmallTrial, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipeline.campaign.cluster._PATIENCE_S", 0.5)
    monkeypatch.setattr("pipeline.campaign.cluster._COUNT_EVERY_S", 0.2)
    cluster.worker.kill()
    cluster.worker.wait()
    with pytest.raises(UsageError, match="has had no worker"):
        run_campaign(plan_of(small_trial, tmp_path / "out"), scheduler=cluster.address)
