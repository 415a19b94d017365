"""Where runs are replayed: in this process, in processes of this machine (`processes`), or on a cluster (`cluster`).

All of them give `concurrent.futures` futures, so that the campaign loop is the same.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from types import FrameType

from pipeline.campaign.interruption import StopRun
from pipeline.campaign.outcome import Failure, Result, overdue
from pipeline.campaign.plan import RunJob
from pipeline.campaign.worker import fail_run, replay_one


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
            result.set_result(fail_run(job, Failure(overdue(self._limit_s), lasting=False)))
        except Exception as error:
            result.set_exception(error)
        return result


class _Overdue(StopRun):
    """The run has had its time."""


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
