"""Runs on an existing Dask cluster.

Dask's scheduler hands a task out again when its worker has died, as often as the cluster's own settings say, and also
counts deaths of workers where the task was only waiting. Whether a run is tried again is the campaign's to decide. So
each worker first leaves a mark at the scheduler; one that finds it there already gives the run back.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import threading
import time
from concurrent.futures import Future
from typing import Any

from pipeline.campaign.engines import Engine
from pipeline.campaign.outcome import Result
from pipeline.campaign.plan import RunJob
from pipeline.campaign.waits import WAITS
from pipeline.campaign.worker import replay_one
from pipeline.results.outcome import RunOutcome
from pipeline.storage.address import redacted
from schemas.errors import UsageError

_BEGUN = "balise-run-begun"


class LostWorkerError(Exception):
    """The worker that had begun the run is gone."""


class DaskEngine(Engine):
    """Workers of a Dask cluster that exists."""

    def __init__(self, scheduler: str, limit_s: float) -> None:
        self._client = _connect_client(scheduler)
        self._limit_s = limit_s
        self._threads = 0
        self._counted_s = -WAITS.count_every_s
        self._workers_last_s = self._heard_s = time.monotonic()
        self.name = redacted(scheduler)
        self._tasks: dict[Result, Any] = {}
        self._workers: dict[str, str] = {}
        self._client.subscribe_topic(_BEGUN, self._note_begin)

    def capacity(self) -> int:
        """Twice the cluster's threads, so that no worker waits for the next run."""
        if time.monotonic() - self._counted_s > WAITS.count_every_s:
            self._threads = self._count_threads()
            self._counted_s = time.monotonic()
            if self._threads:
                self._workers_last_s = self._counted_s
        return max(1, 2 * self._threads)

    def time_without_worker_s(self) -> float:
        """Time for which there has been no worker [s]."""
        return 0.0 if self._threads else time.monotonic() - self._workers_last_s

    def submit(self, job: RunJob) -> Result:
        """Hand a run to the cluster; the result is set when its task ends, however that was."""
        task = self._client.submit(replay_on_cluster, job, self._limit_s + WAITS.grace_s, pure=False)
        result: Result = Future()
        self._tasks[result] = task
        self._client.loop.add_callback(passed_on, self._client, task, result)
        return result

    def has_begun(self, result: Result) -> bool:
        """Whether a worker has begun the run; until then it waits for its turn."""
        key = self._tasks[result].key
        if key in self._workers or not result.done():
            return key in self._workers
        with contextlib.suppress(Exception):
            return bool(self._ask_scheduler(self._client.scheduler.event_is_set, name=key))
        return True

    def kill(self, result: Result) -> None:
        """End the worker that has the run, through its nanny, without waiting for that."""
        task = self._tasks[result]
        threading.Thread(target=self._end_worker, args=(task, self._workers.get(task.key, "")), daemon=True).start()

    def is_lost_worker(self, error: BaseException) -> bool:
        """Whether an error means that the worker died."""
        from distributed.scheduler import KilledWorker

        return isinstance(error, LostWorkerError | KilledWorker)

    def forget_result(self, result: Result) -> None:
        """Forget a task whose result has been taken."""
        key = self._tasks.pop(result).key
        self._workers.pop(key, None)
        if self._client.status == "running":
            with contextlib.suppress(Exception):
                self._ask_scheduler(self._client.scheduler.event_clear, name=key)

    def close(self) -> None:
        """Leave the cluster; its workers stay."""
        with contextlib.suppress(Exception):
            self._client.close(timeout=1)

    def _note_begin(self, event: tuple[float, dict[str, str]]) -> None:
        """A worker has begun a run, of this campaign or of another one on the same cluster."""
        self._workers[event[1]["key"]] = event[1]["worker"]

    def _end_worker(self, task: Any, worker: str) -> None:
        """End the worker of a run, begin it anew, and give up the run."""
        with contextlib.suppress(Exception):
            self._client.sync(
                self._client.scheduler.restart_workers,
                workers=[worker],
                timeout=WAITS.kill_s,
                wait_for_workers=False,
                on_error="return",
                stimulus_id=_BEGUN,
            )
        # It would be handed out again.
        task.cancel()

    def _ask_scheduler(self, question: Any, **arguments: str) -> Any:
        """Ask the scheduler, which must answer within a time."""
        return self._client.sync(question, callback_timeout=WAITS.scheduler_answer_s, **arguments)

    def _count_threads(self) -> int:
        """Threads of all workers; where the scheduler is silent, but not for ever, those that there were."""
        try:
            if self._client.status != "running":
                raise ConnectionError
            threads: int = sum(self._ask_scheduler(self._client.scheduler.ncores).values())
        except Exception as error:
            unanswered_s = time.monotonic() - self._heard_s
            if isinstance(error, TimeoutError) and unanswered_s < WAITS.lonely_s:
                return self._threads
            raise lost_scheduler_error(self.name) from error
        self._heard_s = time.monotonic()
        return threads


async def passed_on(client: Any, task: Any, result: Result) -> None:
    """Tell the campaign how a task ended, whatever way that was.

    Where a worker dies after the end of its run and before the outcome has left it, Dask lets the task begin again, and
    it ends with `LostWorkerError`. Dask's own executor (`Client.get_executor`) never tells of such an end.
    """
    try:
        (outcome,) = await client.gather([task], asynchronous=True)
    except BaseException as error:
        result.set_exception(error)
    else:
        result.set_result(outcome)


def replay_on_cluster(job: RunJob, limit_s: float) -> RunOutcome:
    """What a worker does: the run, unless another worker had begun it and was lost.

    The campaign ends the workers of runs that take too long. Where it cannot, because it is gone itself or has no way
    to, the worker ends itself after `limit_s`.
    """
    timer = threading.Timer(limit_s, os._exit, args=(1,))
    timer.daemon = True
    timer.start()
    try:
        _announce_task()
        return replay_one(job)
    finally:
        timer.cancel()


def _announce_task() -> None:
    """Leave the mark of this task at the scheduler, and tell the campaign where it is."""
    from distributed import get_worker
    from distributed.utils import sync

    worker = get_worker()
    key = worker.get_current_task()
    if sync(worker.loop, worker.scheduler.event_is_set, name=key):
        raise LostWorkerError
    sync(worker.loop, worker.scheduler.event_set, name=key)
    worker.log_event(_BEGUN, {"key": key, "worker": worker.address})


def lost_scheduler_error(scheduler: str) -> UsageError:
    """The error for a scheduler that does not answer any more."""
    return UsageError(
        "the Dask scheduler does not answer",
        place=redacted(scheduler),
        remedy="Start it again and repeat the command: complete runs are skipped.",
    )


def _connect_client(scheduler: str) -> Any:
    """A client of the cluster. Somebody must answer first: a client that finds nobody takes 20 s more to close."""
    try:
        from distributed import Client
    except ImportError:
        raise UsageError("--scheduler needs Dask", remedy="Install `balise[cluster]`.") from None
    _silence_dask()
    try:
        asyncio.run(_answered(scheduler))
        return Client(scheduler, timeout=WAITS.scheduler_s, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError):
        raise lost_scheduler_error(scheduler) from None


async def _answered(scheduler: str) -> None:
    from distributed import Security
    from distributed.comm.core import connect

    arguments = Security().get_connection_args("client")  # type: ignore[no-untyped-call]
    comm = await connect(scheduler, timeout=WAITS.scheduler_s, **arguments)  # type: ignore[no-untyped-call]
    await comm.close()


def _silence_dask() -> None:
    """Dask logs tracebacks of lost connections; the campaign says in one message what was lost."""
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] in ("distributed", "tornado"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
