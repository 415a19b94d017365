"""Errors that nobody would have noticed, over the runs of a campaign (DOMAIN section 5.6)."""

from __future__ import annotations

import polars as pl

from pipeline.stages.run_row.bounds import CONFIDENCE


def undetected_spread() -> dict[str, pl.Expr]:
    """The larger of both directions over the passages of one balise; how far before a physical one may lie."""
    larger = pl.max_horizontal("undetected_ahead_m", "undetected_behind_m")
    before = pl.col("physical_before_m")
    return {
        "undetected_count": larger.count().cast(pl.Int64),
        "undetected_median_m": larger.median(),
        "undetected_p95_m": larger.quantile(0.95, interpolation="higher"),
        "undetected_max_m": larger.max(),
        "physical_before_count": before.count().cast(pl.Int64),
        "physical_before_median_m": before.median(),
        "physical_before_p05_m": before.quantile(0.05, interpolation="lower"),
        "physical_before_min_m": before.min(),
    }


def spacing_of_runs() -> dict[str, pl.Expr]:
    """The shortest spacing over the runs of one solution, and the share of runs that keep it, from below.

    None of n runs fell short of their own shortest: with 95 % confidence, one-sided as of claims (DOMAIN section 6), a
    share of 0.05^(1/n) does not (Clopper and Pearson, n of n).
    """
    runs = pl.col("physical_spacing_starts").count()
    share = pl.when(runs > 0).then(pl.lit(1.0 - CONFIDENCE).pow(1.0 / runs))
    return {
        "undetected_max_m": pl.col("undetected_max_m").max(),
        "physical_spacing_runs": runs.cast(pl.Int64),
        "physical_spacing_m": pl.col("physical_spacing_m").min(),
        "physical_spacing_median_m": pl.col("physical_spacing_m").median(),
        "physical_spacing_share_low": share,
    }
