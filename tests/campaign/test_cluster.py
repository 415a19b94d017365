"""The same campaign on a Dask cluster."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.cluster import Cluster
from pipeline.campaign import run_campaign
from pipeline.campaign.outcome import lost, overdue
from pipeline.results import store
from schemas.enums import RunStatus
from schemas.errors import UsageError
from tests.campaign.compare import ROOT, by_run, plan_of, result_bytes, run, wait_for
from tests.campaign.compare import command as replay_command
from tests.campaign.test_local import Spy, undisturbed
from tests.conftest import SmallTrial

__all__ = ["undisturbed"]

_BEGUN_S = 0.5


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
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
    cluster.kill_workers()
    cluster.nanny = cluster.start_workers()
    cluster.kill_scheduler()
    _, said = first.communicate(timeout=300)
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
    """Said within seconds, with what is done and what to do; given up after the patience."""
    monkeypatch.setattr("pipeline.campaign.loop._PATIENCE_S", 6.5)
    cluster.kill_workers()
    spy = Spy(lambda *_: None)
    with pytest.raises(UsageError, match=r"has had no worker for 6.5 s; 0 of 4 runs are done. Start workers"):
        run_campaign(plan_of(small_trial, tmp_path / "out"), scheduler=cluster.address, watches=[spy])
    assert [
        f"{cluster.address} has no worker left; 0 of 4 runs are done. Start workers" in note for note in spy.notes
    ] == [True]


@contextlib.contextmanager
def cluster_that_allows(failures: int, folder: Path) -> Iterator[Cluster]:
    """One worker; Dask itself would hand a task out again as often as it allows failures."""
    cluster = Cluster(folder, settings={"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": str(failures)})
    try:
        yield cluster
    finally:
        cluster.stop()


@pytest.mark.parametrize("failures", [0, 7])
def test_retries_are_the_campaigns_own(
    small_trial: SmallTrial, undisturbed: Path, tmp_path: Path, failures: int
) -> None:
    """A deadly run costs two workers, and a run that dies once is replayed, whatever Dask's own settings say."""
    for name in ("deadly", "unlucky"):
        os.mkfifo(tmp_path / f"{name}.mcap")
    deaths: dict[str, list[int]] = {"deadly": [], "unlucky": []}

    with cluster_that_allows(failures, tmp_path / "cluster") as cluster:

        def kill(run_id: str, age_s: float) -> None:
            if run_id not in deaths or age_s < _BEGUN_S or (run_id == "unlucky" and deaths[run_id]):
                return
            if len(deaths[run_id]) > [lost for lost, _ in spy.losses].count(run_id):
                return
            pids = cluster.worker_pids
            deaths[run_id].append(pids[0])
            if run_id == "unlucky":
                replace_by_copy(tmp_path / "unlucky.mcap", small_trial.paths[0])
            os.kill(pids[0], signal.SIGKILL)

        named = [tmp_path / "deadly.mcap", tmp_path / "unlucky.mcap", *small_trial.paths[:2]]
        spy = Spy(kill)
        outcomes = by_run(
            run_campaign(plan_of(small_trial, tmp_path / "out", named), scheduler=cluster.address, watches=[spy])
        )
    assert {run_id: len(pids) for run_id, pids in deaths.items()} == {"deadly": 2, "unlucky": 1}
    assert outcomes["deadly"].error == lost(2)
    assert store.completed_runs(tmp_path / "out")["deadly"]["redo"] == "yes"
    assert outcomes["unlucky"].attempts == 2
    assert sorted(spy.losses) == [("deadly", 1), ("unlucky", 1)]
    assert [outcomes[f"run{number}"].attempts for number in range(2)] == [1] * 2
    mine = {name: data for name, data in result_bytes(tmp_path / "out").items() if "run_id=run" in name}
    assert mine == {name: data for name, data in result_bytes(undisturbed).items() if name in mine}


def replace_by_copy(place: Path, log: Path) -> None:
    """What was a pipe that nobody writes to becomes something else: the next worker gets on with it."""
    place.unlink()
    place.symlink_to(log, target_is_directory=True)


@pytest.mark.parametrize("stopped", [False, True])
def test_hanging_worker_is_given_up(small_trial: SmallTrial, cluster: Cluster, tmp_path: Path, stopped: bool) -> None:
    """Also one that cannot end itself, since the whole process stands still."""
    os.mkfifo(tmp_path / "hanging.mcap")
    seen: list[int] = []

    def stop(run_id: str, age_s: float) -> None:
        if stopped and run_id == "hanging" and age_s > _BEGUN_S and not seen:
            seen.extend(cluster.worker_pids)
            os.kill(seen[0], signal.SIGSTOP)

    plan = plan_of(small_trial, tmp_path / "out", [tmp_path / "hanging.mcap", *small_trial.paths[:2]])
    outcomes = by_run(run_campaign(plan, scheduler=cluster.address, time_limit_s=10.0, watches=[Spy(stop)]))
    assert outcomes["hanging"].error == overdue(10.0)
    assert outcomes["hanging"].attempts == 1
    assert [outcomes[f"run{number}"].status for number in range(2)] == [RunStatus.OK] * 2
