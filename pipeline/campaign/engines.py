"""Where runs are replayed: in this process, in processes of this machine, or on a Dask cluster.

All of them give `concurrent.futures` futures, so that the campaign loop is the same.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import multiprocessing.process
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from types import FrameType
from typing import Any, Protocol

from pipeline.campaign.plan import RunJob
from pipeline.campaign.worker import RunOutcome, fail_run, overdue, replay_one, replay_within
from schemas.errors import UsageError

Result = Future[RunOutcome]

# One thread each: several runs at once use the cores better than several threads in one run.
_SINGLE_THREADED = {
    "POLARS_MAX_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "RAYON_NUM_THREADS": "1",
}
_RUNS_PER_PROCESS = 200
_CONNECT_S = 10.0
_COUNT_EVERY_S = 2.0
_PATIENCE_S = 300.0


class Engine(Protocol):
    """What the campaign loop needs to know of where runs are replayed."""

    in_process: bool
    retries_itself: bool

    def capacity(self) -> int:
        """How many runs may be under way at once."""

    def submit(self, job: RunJob) -> Result: ...

    def has_begun(self, result: Result) -> bool:
        """Whether the run is under way; a worker that is still starting does not use up the time limit."""

    def kill(self, result: Result) -> None:
        """End the run at once; its future then holds a `BrokenExecutor`."""

    def is_lost_worker(self, error: BaseException) -> bool:
        """Whether the error means that the worker died, not that the run failed."""

    def close(self) -> None:
        """End whatever is still under way, at once."""


class SerialEngine:
    """This very process: for a single run, without the seconds that a worker takes to start."""

    in_process = True
    retries_itself = True

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s

    def capacity(self) -> int:
        return 1

    def submit(self, job: RunJob) -> Result:
        result: Result = Future()
        try:
            with _alarm(self._limit_s):
                result.set_result(replay_one(job))
        except _Overdue:
            result.set_result(fail_run(job, overdue(self._limit_s)))
        except Exception as error:
            result.set_exception(error)
        return result

    def has_begun(self, result: Result) -> bool:
        return True

    def kill(self, result: Result) -> None:
        return None

    def is_lost_worker(self, error: BaseException) -> bool:
        return False

    def close(self) -> None:
        return None


class _Overdue(BaseException):
    """Not an `Exception`, so that nothing on the way takes it for a failure of its own."""


@contextlib.contextmanager
def _alarm(limit_s: float) -> Iterator[None]:
    """Raise `_Overdue` after a time; only the main thread can be told."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ring(signum: int, frame: FrameType | None) -> None:
        raise _Overdue

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


class LocalEngine:
    """Processes of this machine, each in an executor of its own, so that the loss of one touches no other."""

    in_process = False
    retries_itself = False

    def __init__(self, jobs: int) -> None:
        self._slots = [_Slot() for _ in range(jobs)]
        self._busy: dict[Result, _Slot] = {}

    def capacity(self) -> int:
        return len(self._slots)

    def submit(self, job: RunJob) -> Result:
        self._busy = {result: slot for result, slot in self._busy.items() if not result.done()}
        taken = set(map(id, self._busy.values()))
        slot = next(slot for slot in self._slots if id(slot) not in taken)
        result = slot.submit(job)
        self._busy[result] = slot
        return result

    def has_begun(self, result: Result) -> bool:
        return self._busy[result].is_ready

    def kill(self, result: Result) -> None:
        self._busy[result].kill()

    def is_lost_worker(self, error: BaseException) -> bool:
        return isinstance(error, BrokenExecutor)

    def close(self) -> None:
        for slot in self._slots:
            slot.kill()


class _Slot:
    """One worker process, started when first needed and again after it was lost."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None
        self._process: multiprocessing.process.BaseProcess | None = None
        self._answer: Future[int] | None = None
        self._runs = 0

    def submit(self, job: RunJob) -> Result:
        self._runs += 1
        if self._runs > _RUNS_PER_PROCESS:
            self.kill()
        try:
            return self._started().submit(replay_one, job)
        except BrokenExecutor:
            # It died while it was idle: that costs no run.
            self.kill()
            return self._started().submit(replay_one, job)

    @property
    def is_ready(self) -> bool:
        """Whether the process has started and answered."""
        return self._answer is not None and self._answer.done()

    def kill(self) -> None:
        """End the process, also one that is still starting."""
        if self._executor is None or self._process is None:
            return
        self._process.kill()
        self._executor.shutdown(wait=True, cancel_futures=True)
        self._executor, self._process, self._answer, self._runs = None, None, None, 0

    def _started(self) -> ProcessPoolExecutor:
        if self._process is not None and not self._process.is_alive():
            self.kill()
        if self._executor is None:
            context = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(1, mp_context=context, initializer=_begin_worker)
            before = set(multiprocessing.active_children())
            with _as_workers_start():
                self._answer = self._executor.submit(os.getpid)
            (self._process,) = set(multiprocessing.active_children()) - before
        return self._executor


@contextlib.contextmanager
def _as_workers_start() -> Iterator[None]:
    """What a worker inherits: one thread per library, and deafness to Ctrl-C, which is the parent's to answer."""
    before = {name: os.environ.get(name) for name in _SINGLE_THREADED}
    main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if main else None
    os.environ.update(_SINGLE_THREADED)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if main:
            signal.signal(signal.SIGINT, handler)


def _begin_worker() -> None:
    """Runs first in a worker: leave Ctrl-C to the parent, and go when the parent goes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_go_with_parent, daemon=True).start()


def _go_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class DaskEngine:
    """An existing Dask cluster; Dask's scheduler tries a run elsewhere when a worker dies."""

    in_process = False
    retries_itself = True

    def __init__(self, scheduler: str, limit_s: float) -> None:
        self._client = _connect(scheduler)
        self._executor = self._client.get_executor(pure=False)
        self._limit_s = limit_s
        self._threads = 0
        self._counted = -_COUNT_EVERY_S
        self._seen_s = time.monotonic()
        self._scheduler = scheduler

    def capacity(self) -> int:
        """Twice the cluster's threads, so that no worker waits for the next run.

        Raises `UsageError` where no worker has been there for minutes: nobody would notice in the night.
        """
        if time.monotonic() - self._counted > _COUNT_EVERY_S:
            self._threads = sum(self._ask().values())
            self._counted = time.monotonic()
            if self._threads:
                self._seen_s = self._counted
            elif self._counted - self._seen_s > _PATIENCE_S:
                raise UsageError(
                    f"has had no worker for {_PATIENCE_S:g} s",
                    place=self._scheduler,
                    remedy="Start workers and repeat the command: complete runs are skipped.",
                )
        return max(1, 2 * self._threads)

    def submit(self, job: RunJob) -> Result:
        result: Result = self._executor.submit(replay_within, job, self._limit_s)
        return result

    def has_begun(self, result: Result) -> bool:
        return True

    def kill(self, result: Result) -> None:
        """The worker ends itself at the limit (`replay_within`)."""

    def is_lost_worker(self, error: BaseException) -> bool:
        from distributed.scheduler import KilledWorker

        return isinstance(error, KilledWorker)

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self._executor.shutdown(wait=False)
        with contextlib.suppress(Exception):
            self._client.close(timeout=1)

    def _ask(self) -> dict[str, int]:
        try:
            if self._client.status != "running":
                raise OSError("connection lost")
            threads: dict[str, int] = self._client.nthreads()
        except Exception as error:
            raise lost_scheduler(self._scheduler) from error
        return threads


def lost_scheduler(scheduler: str) -> UsageError:
    """The error of a cluster that does not answer."""
    return UsageError(
        "the Dask scheduler does not answer",
        place=scheduler,
        remedy="Start it again and repeat the command: complete runs are skipped.",
    )


def _connect(scheduler: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise UsageError("--scheduler needs Dask", remedy="Install `balise[cluster]`.") from None
    _hush()
    try:
        return Client(scheduler, timeout=_CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError):
        raise lost_scheduler(scheduler) from None


def _hush() -> None:
    """Dask logs tracebacks of lost connections; the campaign says in one message what was lost."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)


def engine_for(jobs: int, runs: int, scheduler: str | None, limit_s: float) -> Engine:
    """The engine that suits: a cluster if one is named, else this machine."""
    if scheduler is not None:
        return DaskEngine(scheduler, limit_s)
    if runs == 1:
        return SerialEngine(limit_s)
    return LocalEngine(min(jobs, runs))
