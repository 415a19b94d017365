"""Counts of the `runs` table that nobody could make: zero there, and not known to people."""

from __future__ import annotations

import polars as pl

from schemas.campaign import STANFORD
from schemas.enums import Hazard, RunStatus

HAZARD_COUNTS = tuple(kind.counted_as for kind in Hazard)
"""Rows of the hazard table by class."""

JUDGED_COUNTS = (
    *("unsafe_accepted", *HAZARD_COUNTS, "hazards_detected", "hazards_within_budget", "faults", "missed_detections"),
    *("failures", "failures_within_budget", "failures_beyond_budget"),
    *(f"stanford_{kind}" for kind in STANFORD),
)
"""Counts that need evidence: a run without any has none, which is not the same as having found nothing."""


def known_counts(runs: pl.DataFrame) -> pl.DataFrame:
    """Rows of `runs` with null for counts that mean nothing: all of a failed run, the judged ones without evidence.

    Columns as in `runs`, or some of them with `status` and `evidence`.
    """
    failed = pl.col("status") == RunStatus.FAILED
    blind = pl.col("evidence").is_null()
    counts = [name for name, dtype in runs.schema.items() if dtype == pl.Int64]
    return runs.with_columns(
        pl.when(failed | blind if name in JUDGED_COUNTS else failed).then(None).otherwise(pl.col(name)).alias(name)
        for name in counts
    )
