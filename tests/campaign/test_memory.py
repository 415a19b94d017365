"""A run that needs more memory than its worker may take fails alone: real workers, killed as the kernel kills them."""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import polars as pl
import pytest

from pipeline.campaign import CampaignSummary, RunOutcome, run_campaign
from pipeline.campaign.outcome import NO_MEMORY, failure_of, lost_text
from pipeline.storage.parquet import parquet_bytes
from schemas.enums import RunStatus
from tests.campaign.compare import plan_of
from tests.conftest import SmallTrial

if sys.platform != "linux":
    pytest.skip("reads /proc", allow_module_level=True)

_ROWS = 3_000_000
_LARGE_MB = 450.0  # a worker with a usual run stays far below


class MemoryKiller:
    """Kills a worker that has become large. A limit of addresses would not do: allocators then retry for ever."""

    def begin(self, runs: int, out: str) -> None: ...

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        for worker in multiprocessing.active_children():
            # A worker may end between the list and the look at it.
            with contextlib.suppress(FileNotFoundError, ProcessLookupError):
                status = Path(f"/proc/{worker.pid}/status").read_text(encoding="ascii")
                resident = status.partition("VmRSS:")[2].split()
                if worker.pid is not None and resident and int(resident[0]) / 1024 > _LARGE_MB:
                    os.kill(worker.pid, signal.SIGKILL)

    def lost(self, run_id: str, attempt: int) -> None: ...

    def noted(self, text: str) -> None: ...

    def finished(self, outcome: RunOutcome) -> None: ...

    def end(self, summary: CampaignSummary) -> None: ...


@pytest.mark.usefixtures("forked_workers")
def test_a_run_without_memory_fails_and_the_campaign_goes_on(tmp_path: Path, small_trial: SmallTrial) -> None:
    gnss = pl.read_parquet(small_trial.paths[0] / "gnss.parquet").head(1)
    steps = pl.duration(milliseconds=1) * pl.int_range(_ROWS, dtype=pl.Int64)
    large = tmp_path / "large"
    large.mkdir()
    (large / "gnss.parquet").write_bytes(parquet_bytes(gnss[[0] * _ROWS].with_columns(pl.col("t") + steps)))
    plan = plan_of(small_trial, tmp_path / "out", [large, *small_trial.paths])
    summary = run_campaign(plan, jobs=2, watches=[MemoryKiller()])
    outcomes = {outcome.run_id: outcome for outcome in summary.outcomes}
    failed = outcomes.pop("large")
    assert failed.status is RunStatus.FAILED
    assert failed.error == lost_text(2)
    assert {outcome.status for outcome in outcomes.values()} == {RunStatus.OK}
    assert len(outcomes) == len(small_trial.paths)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ImportError("libscipy_openblas.so: failed to map segment from shared object"),
    ],
)
def test_want_of_memory_is_no_defect_and_is_tried_again(error: Exception) -> None:
    failure = failure_of(error, lasting=True)
    assert (failure.error, failure.lasting) == (NO_MEMORY, False)
    assert failure_of(ImportError("no such module"), lasting=True).error.startswith("defect of the program")
