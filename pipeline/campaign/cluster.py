"""Runs on an existing Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import time
from typing import Any

from pipeline.campaign.outcome import Result
from pipeline.campaign.plan import RunJob
from pipeline.campaign.worker import replay_within
from schemas.errors import UsageError

_CONNECT_S = 10.0
_COUNT_EVERY_S = 2.0
_PATIENCE_S = 300.0


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
