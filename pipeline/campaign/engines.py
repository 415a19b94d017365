"""Where runs are replayed: in this process, in processes of this machine, or on a Dask cluster.

All of them give `concurrent.futures` futures, so that the campaign loop is the same.
"""

from __future__ import annotations

from typing import Protocol

from pipeline.campaign.cluster import DaskEngine
from pipeline.campaign.outcome import Result
from pipeline.campaign.plan import RunJob
from pipeline.campaign.processes import LocalEngine
from pipeline.campaign.serial import SerialEngine


class Engine(Protocol):
    """What the campaign loop needs to know of where runs are replayed."""

    in_process: bool

    def capacity(self) -> int:
        """How many runs may be under way at once."""

    def submit(self, job: RunJob) -> Result: ...

    def has_begun(self, result: Result) -> bool:
        """Whether the run is under way; a worker that is still starting does not use up the time limit."""

    def kill(self, result: Result) -> None:
        """End the run at once, with its worker; its future then holds an error or is cancelled."""

    def is_lost_worker(self, error: BaseException) -> bool:
        """Whether the error means that the worker died, not that the run failed."""

    def collected(self, result: Result) -> None:
        """The campaign has seen the result and is done with it."""

    def close(self) -> None:
        """End whatever is still under way, at once."""


def engine_for(jobs: int, runs: int, scheduler: str | None, limit_s: float) -> Engine:
    """The engine that suits: a cluster if one is named, else this machine."""
    if scheduler is not None:
        return DaskEngine(scheduler, limit_s)
    if runs == 1:
        return SerialEngine(limit_s)
    return LocalEngine(min(jobs, runs))
