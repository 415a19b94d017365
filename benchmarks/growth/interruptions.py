"""Campaigns killed at random moments, each taken up again: all files equal to those of an undisturbed one.

Killed without warning are, in turn, the campaign itself, one of its workers, a worker of a Dask cluster, and the
cluster's scheduler: each a random time after a random number of runs was complete, so that slow machines and busy ones
see kills at the beginning, in the middle and while the campaign's own tables are written.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from benchmarks.results import Figure, stopwatch
from benchmarks.trials import write_campaign
from pipeline.results import store
from tests.campaign.cluster import ROOT, Cluster, kill_one, wait_for, workers_of

TRIALS = 50
STOP_S = 2.0
_SEED = 5
_CAMPAIGN_S = 300.0
_BETWEEN_RUNS_S = 0.3
_START_UP_S = 2.0


class Victim(StrEnum):
    """Who is killed."""

    PARENT = "parent"
    WORKER = "worker"
    DASK_WORKER = "Dask worker"
    SCHEDULER = "Dask scheduler"

    @property
    def on_cluster(self) -> bool:
        return self in (Victim.DASK_WORKER, Victim.SCHEDULER)


@dataclass(frozen=True)
class Kill:
    """One trial: when, whether somebody was hit before the campaign ended, and what it left."""

    victim: Victim
    after_runs: int
    hit: bool
    complete: int
    half_done: tuple[str, ...]
    different: tuple[str, ...]


@dataclass(frozen=True)
class Job:
    """The campaign that is disturbed."""

    logs: Path
    site: Path
    folder: Path

    def start(self, out: Path, scheduler: str | None = None, jobs: int = 2) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "cli", "replay", str(self.logs), "--site", str(self.site), "--out", str(out)]
        where = ["--jobs", str(jobs)] if scheduler is None else ["--scheduler", scheduler]
        return subprocess.Popen(
            [*command, *where, "--quiet"],
            cwd=ROOT,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def finish(self, out: Path) -> None:
        """Run to the end. Raises where it did not end well."""
        status = self.start(out).wait(timeout=_CAMPAIGN_S)
        if status:
            raise RuntimeError(f"the campaign into {out} ended with status {status}")

    @property
    def runs(self) -> int:
        return len(list(self.logs.iterdir()))


def measure(folder: Path) -> list[Figure]:
    """Fifty kills of four kinds, and how long Ctrl-C takes."""
    site, logs = write_campaign(folder, 12, minutes=3.0)
    job = Job(logs, site, folder)
    kills = disturb(job, list(Victim), TRIALS, _SEED)
    figures = []
    for victim in Victim:
        chosen = [kill for kill in kills if kill.victim is victim]
        figures += [
            Figure(f"kills of the {victim}", len(chosen), "trials"),
            Figure(f"kills of the {victim}: hit before the end", sum(kill.hit for kill in chosen), "trials"),
            Figure(f"kills of the {victim}: runs left half done", sum(len(k.half_done) for k in chosen), "files", 0),
            Figure(f"kills of the {victim}: other files", sum(len(k.different) for k in chosen), "files", 0),
        ]
    longest = max(interrupt_s(job, random.Random(_SEED + trial)) for trial in range(5))
    return [*figures, Figure("Ctrl-C to the end", longest, "s", STOP_S)]


def disturb(job: Job, victims: Sequence[Victim], trials: int, seed: int) -> list[Kill]:
    """Kill and take up again, the victims in turn; the moments follow from the seed."""
    chance = random.Random(seed)
    whole = job.folder / "undisturbed"
    shutil.rmtree(whole, ignore_errors=True)
    job.finish(whole)
    wanted = contents(whole)
    kills = []
    with _clusters(job, any(victim.on_cluster for victim in victims)) as clusters:
        for trial in range(trials):
            victim = victims[trial % len(victims)]
            cluster = next(clusters) if victim.on_cluster else None
            kills.append(_one(job, victim, cluster, chance, wanted))
    return kills


def _one(job: Job, victim: Victim, cluster: Cluster | None, chance: random.Random, wanted: dict[str, bytes]) -> Kill:
    out = job.folder / "killed"
    shutil.rmtree(out, ignore_errors=True)
    after_runs = chance.randint(0, job.runs)
    campaign = job.start(out, cluster.address if cluster else None)
    wait_for(lambda: campaign.poll() is not None or len(store.run_ids(out)) >= after_runs, _CAMPAIGN_S)
    # Without a run to wait for, any moment from the start of the process on.
    time.sleep(chance.uniform(0.0, _BETWEEN_RUNS_S if after_runs else _START_UP_S))
    hit = _kill(victim, campaign, cluster, chance)
    campaign.wait(timeout=_CAMPAIGN_S)
    complete = store.run_ids(out)
    left = contents(out)
    half_done = [name for name in wanted if _run_of(name) in complete and left.get(name) != wanted[name]]
    status = job.start(out).wait(timeout=_CAMPAIGN_S)
    found = contents(out)
    different = [f"exit status {status}"] if status else []
    different += [name for name in sorted({*found, *wanted}) if found.get(name) != wanted.get(name)]
    return Kill(victim, after_runs, hit, len(complete), tuple(half_done), tuple(different))


def _kill(victim: Victim, campaign: subprocess.Popen[bytes], cluster: Cluster | None, chance: random.Random) -> bool:
    if campaign.poll() is not None:
        return False
    if victim is Victim.PARENT:
        return kill_one([campaign.pid], chance)
    if cluster is None:
        wait_for(lambda: campaign.poll() is not None or bool(workers_of(campaign.pid)))
        return kill_one(workers_of(campaign.pid), chance)
    if victim is Victim.DASK_WORKER:
        return cluster.kill_worker(chance)
    cluster.kill_scheduler()
    return True


@contextmanager
def _clusters(job: Job, needed: bool) -> Iterator[Iterator[Cluster]]:
    """A cluster for each trial that wants one: the last one as long as its scheduler lives."""
    current = [Cluster(job.folder / "cluster", workers=2)] if needed else []

    def each() -> Iterator[Cluster]:
        while True:
            if current[0].scheduler.poll() is not None:
                current[0].stop()
                current[0] = Cluster(job.folder / "cluster", workers=2)
            current[0].wait_for_workers()
            yield current[0]

    try:
        yield each()
    finally:
        for cluster in current:
            cluster.stop()


def interrupt_s(job: Job, chance: random.Random) -> float:
    """From Ctrl-C in the middle of a campaign to its end [s]."""
    out = job.folder / "interrupted"
    shutil.rmtree(out, ignore_errors=True)
    campaign = job.start(out)
    time.sleep(chance.uniform(1.0, 3.0))
    with stopwatch() as watch:
        os.killpg(campaign.pid, signal.SIGINT)
        campaign.wait(timeout=_CAMPAIGN_S)
    return watch.seconds


def contents(out: Path) -> dict[str, bytes]:
    """Every file of a result but its log, which holds times, and its catalogue, which names inodes."""
    files = (path for path in sorted(out.rglob("*")) if path.is_file() and path.name != "replay.log")
    return {str(path.relative_to(out)): path.read_bytes() for path in files if path.parent.name != ".catalogue"}


def _run_of(name: str) -> str:
    """The run that a file belongs to; nothing for files of the whole campaign."""
    return next((part.removeprefix("run_id=") for part in Path(name).parts if part.startswith("run_id=")), "")
