"""Where runs are replayed: in this process, in processes of this machine, or on a Dask cluster (`cluster`).

All of them give `concurrent.futures` futures, so that the campaign loop is the same.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.process
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from types import FrameType

from pipeline.campaign.ground import held, hold
from pipeline.campaign.interruption import StopRun, answered
from pipeline.campaign.outcome import NO_MEMORY, Result, RunFailure, overdue
from pipeline.campaign.plan import RunJob
from pipeline.campaign.waits import WAITS
from pipeline.campaign.worker import fail_run, replay_one
from pipeline.results.workers import single_threaded_children
from schemas.config import SiteConfig
from schemas.run import Site

# Without it (Windows) nothing could end a run in this process that takes too long.
HAS_ALARM = hasattr(signal, "SIGALRM")


class Engine:
    """What the campaign loop needs to know of where runs are replayed."""

    in_process = False
    name = "this machine"

    def capacity(self) -> int:
        """How many runs may be under way at once."""
        return 1

    def submit(self, job: RunJob) -> Result:
        raise NotImplementedError

    def has_begun(self, result: Result) -> bool:
        """Whether the run is under way; a worker that is still starting does not use up the time limit."""
        return True

    def kill(self, result: Result) -> None:
        """End the run at once, with its worker; its future then holds an error or is cancelled."""

    def is_lost_worker(self, error: BaseException) -> bool:
        """Whether the error means that the worker died, not that the run failed."""
        return False

    def lonely_s(self) -> float:
        """For how long there has been no worker to hand runs to [s]."""
        return 0.0

    def collected(self, result: Result) -> None:
        """The campaign has seen the result and is done with it."""

    def close(self) -> None:
        """End whatever is still under way, at once."""


class SerialEngine(Engine):
    """This very process: for a single run, without the seconds that a worker takes to start."""

    in_process = True

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s

    def submit(self, job: RunJob) -> Result:
        result: Result = Future()
        try:
            with _alarm(self._limit_s):
                result.set_result(replay_one(job))
        except _Overdue:
            result.set_result(fail_run(job, RunFailure(overdue(self._limit_s), lasting=False)))
        except Exception as error:
            result.set_exception(error)
        return result


class _Overdue(StopRun):
    """The run has had its time."""


@contextlib.contextmanager
def _alarm(limit_s: float) -> Iterator[None]:

    def ring(signum: int, frame: FrameType | None) -> None:
        raise _Overdue

    with answered([signal.SIGALRM], ring) as heard:
        if heard:
            signal.setitimer(signal.ITIMER_REAL, limit_s)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)


class LocalEngine(Engine):
    """Processes of this machine, each in an executor of its own, so that the loss of one touches no other."""

    def __init__(self, jobs: int) -> None:
        self._idle = [_WorkerSlot() for _ in range(jobs)]
        self._busy: dict[Result, _WorkerSlot] = {}

    def capacity(self) -> int:
        return len(self._idle) + len(self._busy)

    def submit(self, job: RunJob) -> Result:
        result = self._idle[-1].submit(job)
        self._busy[result] = self._idle.pop()
        return result

    def has_begun(self, result: Result) -> bool:
        return self._busy[result].is_ready

    def kill(self, result: Result) -> None:
        self._busy[result].kill()

    def is_lost_worker(self, error: BaseException) -> bool:
        return isinstance(error, BrokenExecutor)

    def collected(self, result: Result) -> None:
        slot = self._busy.pop(result)
        if _was_without_memory(result):
            slot.kill()  # what it still holds would be lacking to the next run
        self._idle.append(slot)

    def close(self) -> None:
        for slot in (*self._idle, *self._busy.values()):
            slot.kill()


def _was_without_memory(result: Result) -> bool:
    return not result.cancelled() and result.exception() is None and result.result().error == NO_MEMORY


class _WorkerSlot:
    """One worker process, started when first needed and again after it was lost."""

    def __init__(self) -> None:
        self._executor: ProcessPoolExecutor | None = None
        self._process: multiprocessing.process.BaseProcess | None = None
        self._answer: Future[int] | None = None
        self._runs = 0

    def submit(self, job: RunJob) -> Result:
        self._runs += 1
        if self._runs > WAITS.runs_per_process:
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
        self._executor = None
        self._process = None
        self._answer = None
        self._runs = 0

    def _started(self) -> ProcessPoolExecutor:
        if self._process is not None and not self._process.is_alive():
            self.kill()
        if self._executor is None:
            context = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(1, mp_context=context, initializer=_begin_worker, initargs=(held(),))
            before = set(multiprocessing.active_children())
            # Deaf to Ctrl-C from its start on: that is the parent's to answer.
            with single_threaded_children(), answered([signal.SIGINT], signal.SIG_IGN):
                self._answer = self._executor.submit(os.getpid)
            (self._process,) = set(multiprocessing.active_children()) - before
        return self._executor


def _begin_worker(sites: list[tuple[Site, SiteConfig]]) -> None:
    """Runs first in a worker: leave Ctrl-C to the parent, go when the parent goes, hold what the parent has read."""
    for site, config in sites:
        hold(site, config)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_go_with_parent, daemon=True).start()


def _go_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
