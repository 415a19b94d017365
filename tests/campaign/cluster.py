"""A Dask cluster of this machine whose parts can be killed one by one."""

from __future__ import annotations

import contextlib
import json
import os
import random
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
# Each of the processes takes seconds of processor time to start: minutes on a machine that is busy otherwise.
_START_S = 240.0
_SURROUNDINGS = {
    "PYTHONPATH": str(ROOT),
    "POLARS_MAX_THREADS": "1",
    "DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver",
}


class Cluster:
    """A scheduler, and workers under a nanny that starts them again; each a process of its own.

    `settings` are Dask's own, as environment variables (`DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES`).
    """

    def __init__(self, folder: Path, workers: int = 1, settings: Mapping[str, str] | None = None) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._workers, self._settings = folder, workers, dict(settings or {})
        self.scheduler = self._start_scheduler()
        self.nanny = self.start_workers()
        self.wait_for_workers()

    @property
    def address(self) -> str:
        return str(json.loads(self._file.read_text())["address"])

    def start_workers(self) -> subprocess.Popen[bytes]:
        arguments = ("--nworkers", str(self._workers), "--nthreads", "1", "--no-dashboard")
        place = ("--scheduler-file", str(self._file), "--local-directory", str(self._folder))
        return self._dask("worker", *place, *arguments)

    def wait_for_workers(self) -> None:
        """Until all workers have joined, and their nanny knows it: of one that dies before, it starts no other."""
        if self.nanny.poll() is not None:
            self.nanny = self.start_workers()
        from distributed import Client  # takes seconds to load

        with Client(self.address, timeout=_START_S, set_as_default=False) as client:  # type: ignore[no-untyped-call]
            client.wait_for_workers(self._workers, timeout=_START_S)
            wait_for(lambda: set(client.run(_state, nanny=True).values()) == {"running"})

    def kill_worker(self, chance: random.Random) -> bool:
        """One worker without warning; the nanny lives. Whether there was one."""
        return kill_one(self.worker_pids, chance)

    @property
    def worker_pids(self) -> list[int]:
        return workers_of(self.nanny.pid)

    def kill_workers(self) -> None:
        """All workers and their nanny, without warning."""
        for pid in [self.nanny.pid, *self.worker_pids]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.nanny.wait()

    def kill_scheduler(self) -> None:
        self.scheduler.kill()
        self.scheduler.wait()

    def stop(self) -> None:
        for process in (self.nanny, self.scheduler):
            process.terminate()
            try:
                process.wait(timeout=30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _start_scheduler(self) -> subprocess.Popen[bytes]:
        self._file = self._folder / f"scheduler-{secrets.token_hex(4)}.json"
        scheduler = self._dask(
            *("scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1"),
            *("--scheduler-file", str(self._file)),
        )
        wait_for(lambda: self._file.exists() and self._file.read_text().rstrip().endswith("}"))
        return scheduler

    def _dask(self, *arguments: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "tests.campaign.nanny" if arguments[0] == "worker" else "dask", *arguments],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **_SURROUNDINGS, **self._settings},
        )


def _state(dask_worker: Any) -> str:
    """Of a nanny, as Dask hands it to what runs there."""
    return str(dask_worker.status.name)


def workers_of(pid: int) -> list[int]:
    """Worker processes of a process: spawned, or forked by its server; the tracker of semaphores does no work."""
    spawned = [child for child in _children(pid) if b"spawn_main" in _command(child)]
    servers = [child for child in _children(pid) if b"multiprocessing.forkserver" in _command(child)]
    return sorted([*spawned, *(worker for server in servers for worker in _children(server))])


def _children(pid: int) -> list[int]:
    found: list[str] = []
    for thread in Path(f"/proc/{pid}/task").glob("*"):
        # Each thread has the children that it started itself.
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            found += (thread / "children").read_text().split()
    return [int(child) for child in found]


def _command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""


def kill_one(pids: list[int], chance: random.Random) -> bool:
    """SIGKILL to one of the processes; false where there is none, or it ended by itself."""
    if not pids:
        return False
    try:
        os.kill(chance.choice(pids), signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def wait_for(condition: Callable[[], bool], limit_s: float = _START_S) -> None:
    """Wait until something is so; `TimeoutError` where that is in vain."""
    until = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > until:
            raise TimeoutError("waited in vain")
        time.sleep(0.02)
