"""Runs and hazard rows as independent events: what may be counted in a rate."""

from __future__ import annotations

import polars as pl

from schemas.enums import TRUTH

DETECTION_TIMES = ("time_to_detect_s", "time_since_failure_s", "time_since_failure_may_s")


def without_copies(runs: pl.DataFrame) -> pl.DataFrame:
    """Rows of `runs` with every recording once, that of the worst verdict: a log under two names has one content.

    The content alone (`input_digest`) is not known of runs that came from no file.
    """
    content = pl.struct("solution", "input_digest", "t_start", "t_end", "epochs", "distance_m")
    worst = ("unsafe", "unproven", "safe")
    order = pl.col("verdict").cast(pl.String).replace_strict(worst, range(3), default=3)
    return runs.sort("solution", order, "run_id").filter(content.is_first_distinct() | pl.col("input_digest").is_null())


def missed_detection() -> pl.Expr:
    """No monitor failed within the budget of the failure (DIAG's Pmd; DOMAIN section 5.3); null without a failure.

    Missed for certain counts from `t_failure`, found for certain from `t_failure_may`; between them null.
    """
    budget = (pl.col("budget_s") * 1e9).round().cast(pl.Int64).cast(pl.Duration("ns"))

    def late(since: str) -> pl.Expr:
        undetected = pl.col("t_detected").is_null() | (pl.col("t_detected") > pl.col(since) + budget)
        return pl.col(since).is_not_null() & undetected

    in_time = pl.col("t_failure_may").is_not_null() & ~late("t_failure_may")
    return pl.when(late("t_failure")).then(True).when(in_time).then(False)


def since_when_at_most() -> pl.Expr:
    """The earliest begin of a failure that the evidence leaves; null where it is silent for one that failed."""
    silent = pl.col("t_failure").is_not_null() & pl.col("t_failure_may").is_null()
    return pl.when(~silent.any()).then(pl.col("t_failure_may").min())


def independent_episodes(hazards: pl.DataFrame) -> pl.DataFrame:
    """One row per fault: `solution, begin, t_failure, t_failure_may, t_end, budget_s, failed, missed, with_truth,
    detected`, `DETECTION_TIMES`, and `run_id` where the hazards have one.

    A fault may stand in several rows of `hazards` (one per class, and the jump back as a row `caused_by` the first);
    counted one by one they would make the bounds too narrow. Shares are of faults `with_truth` (reference or balise
    reads): the odometer alone mostly sees what was detected.
    """
    failed = pl.col("t_failure").is_not_null()
    t_end = pl.col("t_end")
    keys = [*(name for name in ("run_id", "solution") if name in hazards.columns), "begin"]
    rows = hazards.filter(pl.col("caused_by").is_null())
    rows = rows.with_columns(begin=pl.coalesce("t_onset", "t_hazard"), missed=missed_detection())
    episodes = rows.group_by(keys).agg(
        t_failure=pl.col("t_failure").min(),
        t_failure_may=since_when_at_most(),
        t_end=pl.when(t_end.null_count() == 0).then(t_end.max()),
        budget_s=pl.col("budget_s").first(),
        failed=failed.any(),
        missed=pl.when(failed.any()).then(pl.col("missed").filter(failed).any(ignore_nulls=False)),
        with_truth=pl.col("evidence").is_in(TRUTH).all(),
        detected=pl.col("detected").any(),
        **{name: pl.col(name).max() for name in DETECTION_TIMES},
    )
    return episodes.sort(keys)
