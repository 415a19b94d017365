"""Runs in this very process, one after the other."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from types import FrameType

from pipeline.campaign.engines import Engine
from pipeline.campaign.interruption import StopRun
from pipeline.campaign.outcome import Failure, Result, overdue
from pipeline.campaign.plan import RunJob
from pipeline.campaign.worker import fail_run, replay_one


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
