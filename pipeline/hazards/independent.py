"""Hazard rows as independent events: what may be counted in a rate."""

from __future__ import annotations

import polars as pl

from schemas.enums import TRUTH


def missed_detection() -> pl.Expr:
    """A hazard with a failure that was not negated by `t_failure` + budget (DOMAIN section 5).

    Where no budget is known any delay of the negation is one too many.
    """
    budget_ns = (pl.col("budget_s").fill_null(0.0) * 1e9).round().cast(pl.Int64).cast(pl.Duration("ns"))
    late = pl.col("t_negated").is_null() | (pl.col("t_negated") > pl.col("t_failure") + budget_ns)
    return pl.col("t_failure").is_not_null() & late


def independent_episodes(hazards: pl.DataFrame) -> pl.DataFrame:
    """One row per fault: `run_id, solution, failed, missed, with_truth, time_to_detect_s, hazardous_s`.

    A fault may stand in several rows of `hazards` (one per class, and the jump back as a row
    `caused_by` the first); counted one by one they would make the bounds too narrow. Takes the
    hazards of many runs with their `run_id`. `hazardous_s` is null where a failure was never negated. Shares are of
    faults `with_truth` (reference or balise reads): the odometer alone mostly sees what was detected, because a virtual
    balise accepted in the wrong place hides the rest.
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
            time_to_detect_s=pl.col("time_to_detect_s").max(),
            # One row that was never negated makes the whole fault one that was never negated.
            hazardous_s=pl.when((failed & pl.col("hazardous_s").is_null()).any())
            .then(None)
            .otherwise(pl.col("hazardous_s").filter(failed).max()),
        )
        .sort("run_id", "solution", "begin")
    )
