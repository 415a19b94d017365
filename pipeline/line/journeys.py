"""Runs that are the same journey, so that none is counted twice."""

from __future__ import annotations

import polars as pl

from schemas.enums import RunVerdict


def distinct(runs: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """Rows of `runs` by run and solution without further recordings or replays of one journey, and a remark on them.

    Runs of one solution that begin and end at the same nanoseconds are one journey: one log under two names, or in
    two formats. The one with the worst verdict stays.
    """
    order = (
        pl.col("verdict")
        .cast(pl.String)
        .replace_strict({RunVerdict.UNSAFE.value: 0, RunVerdict.UNPROVEN.value: 1}, default=2)
    )
    kept = runs.sort("solution", order, "run_id").filter(
        pl.struct("solution", "t_start", "t_end").is_first_distinct() | pl.col("t_start").is_null()
    )
    if kept.height == runs.height:
        return runs, []
    left = runs.height - kept.height
    return kept.sort("run_id", "solution"), [
        f"{left} runs begin and end with another one: counted once, as one journey."
    ]
