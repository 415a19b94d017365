"""Where runs are replayed: in this process, in processes of this machine, or on a Dask cluster (`cluster`).

All of them give `concurrent.futures` futures, so that the campaign loop is the same.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

from pipeline.campaign.interruption import StopRun, handle_signals
from pipeline.campaign.outcome import NO_MEMORY, Result, RunFailure, overdue_text
from pipeline.campaign.plan import RunJob, keep_site, kept_sites
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
    start_limit_s = math.inf
    """For how long a worker may start before it is given up [s]."""

    def capacity(self) -> int:
        """How many runs may be under way at once."""
        return 1

    def submit(self, job: RunJob) -> Result:
        """Hand over a run; the result is set when it ends."""
        raise NotImplementedError

    def has_begun(self, result: Result) -> bool:
        """Whether the run is under way; a worker that is still starting does not use up the time limit."""
        return True

    def kill(self, result: Result) -> None:
        """End the run at once, with its worker; its future then holds an error or is cancelled."""

    def is_lost_worker(self, error: BaseException) -> bool:
        """Whether the error means that the worker died, not that the run failed."""
        return False

    def time_without_worker_s(self) -> float:
        """Time for which there has been no worker to hand runs to [s]."""
        return 0.0

    def forget_result(self, result: Result) -> None:
        """Forget a run whose result the campaign has taken."""

    def close(self) -> None:
        """End whatever is still under way, at once."""


class SerialEngine(Engine):
    """This very process: for a single run, without the seconds that a worker takes to start."""

    in_process = True

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s

    def submit(self, job: RunJob) -> Result:
        """Replay a run here and now, within the time limit."""
        result: Result = Future()
        try:
            with _time_limit(self._limit_s):
                result.set_result(replay_one(job))
        except _Overdue:
            result.set_result(fail_run(job, RunFailure(overdue_text(self._limit_s), lasting=False)))
        except Exception as error:
            result.set_exception(error)
        return result


class _Overdue(StopRun):
    """The run has had its time."""


@contextlib.contextmanager
def _time_limit(limit_s: float) -> Iterator[None]:
    """End what runs within this context once it takes too long."""

    def end_run(signum: int, frame: FrameType | None) -> None:
        """End the run: its time is over."""
        raise _Overdue

    with handle_signals([signal.SIGALRM], end_run) as heard:
        if heard:
            signal.setitimer(signal.ITIMER_REAL, limit_s)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0.0)


class LocalEngine(Engine):
    """Processes of this machine, each in an executor of its own, so that the loss of one touches no other."""

    def __init__(self, jobs: int) -> None:
        # What is handed over at the start of a process goes through a pipe that nobody reads once the process is dead,
        # and a start with more than the pipe takes would wait for ever: the site goes through a file.
        self._folder = TemporaryDirectory(prefix="balise-")
        ground = Path(self._folder.name) / "ground"
        ground.write_bytes(pickle.dumps(kept_sites()))
        self._idle = [_WorkerSlot(ground) for _ in range(jobs)]
        self._busy: dict[Result, _WorkerSlot] = {}
        self.start_limit_s = WAITS.start_s

    def capacity(self) -> int:
        """Number of worker processes."""
        return len(self._idle) + len(self._busy)

    def submit(self, job: RunJob) -> Result:
        """Hand a run to an idle worker."""
        result = self._idle[-1].submit(job)
        self._busy[result] = self._idle.pop()
        return result

    def has_begun(self, result: Result) -> bool:
        """Whether the worker of a run has started up."""
        return self._busy[result].is_ready

    def kill(self, result: Result) -> None:
        """End the worker of a run that takes too long."""
        self._busy[result].kill()

    def is_lost_worker(self, error: BaseException) -> bool:
        """Whether an error means that the worker died."""
        return isinstance(error, BrokenExecutor)

    def forget_result(self, result: Result) -> None:
        """Make the worker of a run idle again."""
        slot = self._busy.pop(result)
        if _was_without_memory(result):
            slot.kill()  # what it still holds would be lacking to the next run
        self._idle.append(slot)

    def close(self) -> None:
        """End all workers."""
        for slot in (*self._idle, *self._busy.values()):
            slot.kill()
        self._folder.cleanup()


def _was_without_memory(result: Result) -> bool:
    """Whether a run ended because memory ran out."""
    return not result.cancelled() and result.exception() is None and result.result().error == NO_MEMORY


class _WorkerSlot:
    """One worker process, started when first needed and again after it was lost."""

    def __init__(self, ground: Path) -> None:
        self._ground = ground
        self._executor: ProcessPoolExecutor | None = None
        self._process: SpawnProcess | None = None
        self._answer: Future[int] | None = None
        self._runs = 0

    def submit(self, job: RunJob) -> Result:
        """Hand a run to the process, which is begun anew after so many runs or where it died."""
        self._runs += 1
        if self._runs > WAITS.runs_per_process:
            self.kill()
        with contextlib.suppress(BrokenExecutor):
            return self._running_executor().submit(replay_one, job)
        # It died while it was idle: that costs no run.
        self.kill()
        try:
            return self._running_executor().submit(replay_one, job)
        except BrokenExecutor as error:
            lost: Result = Future()
            lost.set_exception(error)
            return lost

    @property
    def is_ready(self) -> bool:
        """Whether the process has started and answered."""
        return self._answer is not None and self._answer.done() and self._answer.exception() is None

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

    def _running_executor(self) -> ProcessPoolExecutor:
        """The executor of the worker's process, begun anew if that process is gone."""
        if self._process is not None and not self._process.is_alive():
            self.kill()
        if self._executor is None:
            context = _KnownProcesses()
            self._executor = ProcessPoolExecutor(
                1, mp_context=context, initializer=_initialise_worker, initargs=(self._ground,)
            )
            # Deaf to Ctrl-C from its start on: that is the parent's to answer, who hears it once the start is over.
            with single_threaded_children(), _delay_signal(signal.SIGINT):
                self._answer = self._executor.submit(os.getpid)
            self._process = context.made[-1]
        return self._executor


class _KnownProcesses(SpawnContext):
    """Keeps the processes that it makes: one that dies at once is no longer listed among the living."""

    def __init__(self) -> None:
        self.made: list[SpawnProcess] = []

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]  # noqa: N802
        """Begin a process, and remember it, so that it can be ended."""
        self.made.append(SpawnProcess(*args, **kwargs))
        return self.made[-1]


@contextlib.contextmanager
def _delay_signal(signum: int) -> Iterator[None]:
    """The signal reaches this thread after the block; processes that it starts never hear it."""
    if not hasattr(signal, "pthread_sigmask"):
        with handle_signals([signum], signal.SIG_IGN):
            yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signum])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _initialise_worker(ground: Path) -> None:
    """Runs first in a worker: leave Ctrl-C to the parent, go when the parent goes, keep the sites of the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sites: list[tuple[Site, SiteConfig]] = pickle.loads(ground.read_bytes())
    for site, config in sites:
        keep_site(site, config)


def _end_with_parent() -> None:
    """End a worker process when its parent ends."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
