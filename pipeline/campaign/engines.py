"""Where runs are replayed: in this process (`serial`), in processes of this machine, or on a Dask cluster.

All of them give `concurrent.futures` futures, so that the campaign loop is the same.
"""

from __future__ import annotations

from pipeline.campaign.outcome import Result
from pipeline.campaign.plan import RunJob


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
