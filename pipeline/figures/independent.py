"""Hazard rows as independent events: what may be counted in a rate."""

from __future__ import annotations

import polars as pl

from schemas.enums import TRUTH


def missed_detection() -> pl.Expr:
    """No monitor failed by `t_failure` + budget (DIAG's Pmd; DOMAIN section 5.3); null without a failure."""
    budget = (pl.col("budget_s") * 1e9).round().cast(pl.Int64).cast(pl.Duration("ns"))
    late = pl.col("t_detected").is_null() | (pl.col("t_detected") > pl.col("t_failure") + budget)
    return pl.when(pl.col("t_failure").is_not_null()).then(late)


def independent_episodes(hazards: pl.DataFrame) -> pl.DataFrame:
    """One row per fault: `run_id, solution, failed, missed, with_truth, detected, time_to_detect_s`.

    A fault may stand in several rows of `hazards` (one per class, and the jump back as a row `caused_by` the first);
    counted one by one they would make the bounds too narrow. Takes the hazards of many runs with their `run_id`.
    Shares are of faults `with_truth` (reference or balise reads): the odometer alone mostly sees what was detected.
    """
    failed = pl.col("t_failure").is_not_null()
    return (
        hazards.filter(pl.col("caused_by").is_null())
        .with_columns(begin=pl.coalesce("t_onset", "t_hazard"), missed=missed_detection())
        .group_by("run_id", "solution", "begin")
        .agg(
            failed=failed.any(),
            missed=pl.col("missed").any(),
            with_truth=pl.col("evidence").is_in(TRUTH).all(),
            detected=pl.col("detected").any(),
            time_to_detect_s=pl.col("time_to_detect_s").max(),
        )
        .sort("run_id", "solution", "begin")
    )
