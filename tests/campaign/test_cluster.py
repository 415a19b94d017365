"""The same campaign on a Dask cluster."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Never

import pytest

from pipeline.campaign import RunOutcome, run_campaign
from pipeline.campaign.cluster import lost_scheduler_error, replay_on_cluster
from pipeline.campaign.outcome import lost_text, overdue_text
from pipeline.campaign.plan import RunJob
from pipeline.campaign.waits import WAITS
from pipeline.results import store
from schemas.enums import RunStatus
from schemas.errors import UsageError
from tests.campaign.cluster import Cluster
from tests.campaign.compare import ROOT, Hurried, by_run, endless, plan_of, result_bytes, wait_for
from tests.campaign.compare import command as replay_command
from tests.campaign.test_local import Spy
from tests.conftest import SmallTrial

_BEGUN_S = 0.5
# None of it passes: the clock is put forward.
_LIMIT_S = 3600.0


@pytest.fixture(scope="module")
def clusters(tmp_path_factory: pytest.TempPathFactory) -> Iterator[list[Cluster]]:
    """Holds the cluster that is up, if any: its parts take seconds of processor time to start."""
    up: list[Cluster] = []
    yield up
    for cluster in up:
        cluster.stop()


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scheduler on a busy machine answers late; one that takes too long would count as lost."""
    monkeypatch.setattr(WAITS, "scheduler_s", 120.0)
    monkeypatch.setattr(WAITS, "scheduler_answer_s", 120.0)


@pytest.fixture
def cluster(clusters: list[Cluster], tmp_path_factory: pytest.TempPathFactory) -> Cluster:
    """A whole cluster: what the test before has killed is started again."""
    if clusters and clusters[0].scheduler.poll() is not None:
        clusters.pop().stop()
    if not clusters:
        clusters.append(Cluster(tmp_path_factory.mktemp("cluster")))
    clusters[0].wait_for_workers()
    return clusters[0]


@pytest.mark.parametrize(("failures", "dying"), [(0, ("unlucky",)), (7, ("deadly", "unlucky"))])
def test_whatever_becomes_of_other_runs_the_bytes_are_the_same(
    small_trial: SmallTrial, undisturbed: Path, cluster: Cluster, tmp_path: Path, failures: int, dying: tuple[str, ...]
) -> None:
    """A damaged run fails, a deadly one costs two workers, one that dies once is replayed.

    Dask itself would hand a task out again as often as it allows failures.
    """
    allow(failures, cluster)
    (tmp_path / "bad.mcap").write_bytes(b"not a log")
    for name in dying:
        endless(tmp_path / f"{name}.mcap")
    deaths: dict[str, list[int]] = {name: [] for name in dying}

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

    named = [*(tmp_path / f"{name}.mcap" for name in (*dying, "bad")), *small_trial.paths]
    spy = Spy(kill)
    plan = plan_of(small_trial, tmp_path / "out", named)
    outcomes = by_run(run_campaign(plan, scheduler=cluster.address, watches=[spy]))
    assert {run_id: len(pids) for run_id, pids in deaths.items()} == {
        name: 2 if name == "deadly" else 1 for name in dying
    }
    if "deadly" in dying:
        assert outcomes["deadly"].error == lost_text(2)
        assert store.completed_runs(tmp_path / "out")["deadly"]["redo"] == "yes"
    assert outcomes["unlucky"].attempts == 2
    assert outcomes["bad"].status is RunStatus.FAILED
    assert sorted(spy.losses) == [(name, 1) for name in dying]
    assert [outcomes[f"run{number}"].attempts for number in range(4)] == [1] * 4
    mine = {name: data for name, data in result_bytes(tmp_path / "out").items() if "run_id=run" in name}
    assert mine == result_bytes(undisturbed)


def allow(failures: int, cluster: Cluster) -> None:
    """Set how often the scheduler itself hands out a task whose worker died."""
    from distributed import Client  # takes seconds to load, in each of the test processes

    with Client(cluster.address, timeout=WAITS.scheduler_s, set_as_default=False) as client:
        client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", failures))


def test_scheduler_that_is_not_there(small_trial: SmallTrial, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WAITS, "scheduler_s", 1.0)
    with pytest.raises(UsageError, match="Dask scheduler does not answer"):
        run_campaign(plan_of(small_trial, tmp_path), scheduler="tcp://127.0.0.1:9")
    assert str(lost_scheduler_error("tls://KEY:sec/ret@host:9")).startswith("tls://host:9: the Dask scheduler")


class Parcel(RunOutcome):
    """An outcome that takes its worker with it when it is sent."""

    def __reduce__(self) -> Never:
        os._exit(1)


def replayed_and_lost(job: RunJob, limit_s: float) -> RunOutcome:
    outcome, first = replay_on_cluster(job, limit_s), Path(job.out, "first")
    if first.exists():
        return outcome
    first.touch()
    return Parcel(**vars(outcome))


def test_worker_that_dies_with_the_outcome_of_its_run(
    small_trial: SmallTrial, undisturbed: Path, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run is complete then, but nobody was told; Dask alone would begin it again, and never say how that ended."""
    monkeypatch.setattr("pipeline.campaign.cluster.replay_on_cluster", replayed_and_lost)
    spy = Spy(lambda *_: None)
    plan = plan_of(small_trial, tmp_path, small_trial.paths[:1])
    outcome = by_run(run_campaign(plan, scheduler=cluster.address, watches=[spy]))["run0"]
    assert (outcome.status, outcome.attempts, spy.losses) == (RunStatus.OK, 2, [("run0", 1)])
    mine = {name: data for name, data in result_bytes(undisturbed).items() if "run_id=run0" in name}
    assert result_bytes(tmp_path) == mine


def test_scheduler_that_stands_still(
    small_trial: SmallTrial, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It keeps its connections and says nothing: the campaign looks on, and gives it up after the same patience."""
    monkeypatch.setattr(WAITS, "lonely_s", 20.0)
    monkeypatch.setattr(WAITS, "scheduler_answer_s", 0.5)
    clock, looks = Hurried(monkeypatch, "cluster"), list[str]()

    def stop(run_id: str, _: float) -> None:
        os.kill(cluster.scheduler.pid, signal.SIGSTOP)
        looks.append(run_id)
        clock.hurry(2.0)

    try:
        with pytest.raises(UsageError, match="Dask scheduler does not answer"):
            run_campaign(plan_of(small_trial, tmp_path / "out"), scheduler=cluster.address, watches=[Spy(stop)])
    finally:
        os.kill(cluster.scheduler.pid, signal.SIGCONT)
    assert len(looks) > 3


def replace_by_copy(place: Path, log: Path) -> None:
    """What was a pipe that nobody writes to becomes something else: the next worker gets on with it."""
    place.unlink()
    place.symlink_to(log, target_is_directory=True)


@pytest.mark.parametrize("stopped", [False, True])
def test_hanging_worker_is_given_up(
    small_trial: SmallTrial, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stopped: bool
) -> None:
    """Also one that cannot end itself, since the whole process stands still."""
    endless(tmp_path / "hanging.mcap")
    workers: list[int] = []
    clock = Hurried(monkeypatch, "run")

    def stop(run_id: str, age_s: float) -> None:
        if run_id == "hanging" and age_s > _BEGUN_S and not workers:
            workers.extend(cluster.worker_pids)
            if stopped:
                os.kill(workers[0], signal.SIGSTOP)
            clock.hurry(_LIMIT_S)

    plan = plan_of(small_trial, tmp_path / "out", [tmp_path / "hanging.mcap", *small_trial.paths[:2]])
    outcomes = by_run(run_campaign(plan, scheduler=cluster.address, time_limit_s=_LIMIT_S, watches=[Spy(stop)]))
    assert outcomes["hanging"].error == overdue_text(_LIMIT_S)
    assert outcomes["hanging"].attempts == 1
    assert [outcomes[f"run{number}"].status for number in range(2)] == [RunStatus.OK] * 2


# Last come the tests that leave less of the cluster behind: starting one takes seconds of processor time.


def test_cluster_that_lost_its_workers(
    small_trial: SmallTrial, cluster: Cluster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Said within seconds, with what is done and what to do; given up after the patience."""
    monkeypatch.setattr(WAITS, "lonely_s", 20.0)
    clock = Hurried(monkeypatch, "cluster")
    cluster.kill_workers()
    spy = Spy(lambda *_: clock.hurry(2.0))
    with pytest.raises(UsageError, match=r"has had no worker for 20 s; 0 of 4 runs are done. Start workers"):
        run_campaign(plan_of(small_trial, tmp_path / "out"), scheduler=cluster.address, watches=[spy])
    assert [
        f"{cluster.address} has no worker left; 0 of 4 runs are done. Start workers" in note for note in spy.notes
    ] == [True]


@pytest.mark.usefixtures("in_process")
def test_killed_worker_and_scheduler(
    small_trial: SmallTrial, undisturbed: Path, cluster: Cluster, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    first = subprocess.Popen(
        replay_command(small_trial, out, "--scheduler", cluster.address), cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    wait_for(lambda: any((out / "runs").glob("*/runs.parquet")))
    cluster.kill_workers()
    cluster.kill_scheduler()
    _, said = first.communicate(timeout=300)
    assert "Traceback" not in said
    assert first.returncode in (0, 2)
    assert run_campaign(plan_of(small_trial, out)).count(RunStatus.OK) == 4
    assert result_bytes(out) == result_bytes(undisturbed)
