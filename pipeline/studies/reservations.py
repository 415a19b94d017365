"""What keeps figures over runs from being those of traffic: the sentences that safety, claim and line share."""

from __future__ import annotations

import polars as pl

from schemas.enums import TRUTH, RunStatus

_FAILED = pl.col("status").cast(pl.String) == RunStatus.FAILED.value


def failed_runs(runs: pl.DataFrame) -> list[str]:
    """Runs that failed, with all their solutions or with one alone."""
    number = runs["run_id"].n_unique()
    whole = runs.filter(_FAILED.all().over("run_id"))["run_id"].n_unique()
    alone = runs.filter(_FAILED & ~_FAILED.all().over("run_id")).group_by("solution").agg(pl.col("run_id").n_unique())
    return [f"{whole} of {number} runs failed and are left out of all figures."] * bool(whole) + [
        f"{solution}: {count} of {number} runs failed with this solution alone and are left out of its figures."
        for solution, count in alone.sort("solution").iter_rows()
    ]


def runs_without_truth(runs: pl.DataFrame, consequence: str) -> list[str]:
    """Runs that nothing but the odometer, or nothing at all, can judge."""
    blind = runs.filter(~pl.col("evidence").cast(pl.String).is_in(TRUTH).fill_null(value=False)).height
    reservation = f"{blind} of {runs.height} runs have neither a reference nor balise reads: {consequence}"
    return [reservation] if blind else []


def several_settings(runs: pl.DataFrame, consequence: str) -> list[str]:
    """Runs of different configurations or vehicle files in one result."""
    kinds = runs.filter(~_FAILED)["config_digest"].n_unique()
    return [f"The runs were replayed with {kinds} settings or vehicle files{consequence}"] if kinds > 1 else []
