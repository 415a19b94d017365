"""A stream with a gap of a century costs no more memory than its rows."""

from __future__ import annotations

import tracemalloc

import numpy as np
import polars as pl
import pytest

from datasets.random_trials import random_trial
from pipeline.studies.plausibility.fit import fit_run
from pipeline.studies.plausibility.records import Record
from schemas.arrays import Floats
from schemas.config import PlausibilityConfig, Vehicle
from schemas.conform import conform
from schemas.inputs import BaliseReads
from schemas.run import RunLog

_CENTURY = pl.duration(days=36_525)


def test_instants_leave_long_pauses_out() -> None:
    t_s: Floats = np.array([0.0, 1.0, 2.0, 3.0, 3e9, 3e9 + 1.0, 3e9 + 2.0])
    record = Record(t_s, t_s)
    assert record.instants(1.0).tolist() == [0.0, 1.0, 2.0, 3.0, 3e9, 3e9 + 1.0, 3e9 + 2.0]
    assert record.instants(2.0, begin_s=1.0, end_s=3e9).tolist() == [1.0, 3.0]


def late(run: RunLog, stream: str) -> RunLog:
    """The second half of a stream a century later."""
    frame = run.stream(stream)  # type: ignore[arg-type]
    assert frame is not None
    half = pl.int_range(pl.len()) >= frame.height // 2
    moved = pl.when(half).then(pl.col("t") + _CENTURY).otherwise(pl.col("t"))
    return run.with_streams(**{stream: frame.with_columns(moved)})


@pytest.mark.parametrize("stream", ["gnss", "odometer", "reference", "balise_reads"])
def test_a_gap_of_a_century_makes_no_large_array(stream: str) -> None:
    trial = random_trial(0)
    assert trial.site.balises is not None
    read = trial.run.gnss.gather_every(200).select("t", balise_id=pl.lit(trial.site.balises["balise_id"][0]))
    run = late(trial.run.with_streams(balise_reads=conform(read, BaliseReads)), stream)
    tracemalloc.start()
    fit_run(run, "primary", Vehicle(), PlausibilityConfig(), trial.site)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # A second a century is 3e9 instants; the run itself has some thousand rows.
    assert most < 200e6
