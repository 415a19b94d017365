"""What a campaign measured per solution, each figure with how certain it is, against the safety budget."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import polars as pl

from pipeline.results.figures.campaign_tables import (
    RATES,
    campaign_accuracy,
    campaign_balises,
    campaign_levels,
    campaign_runs,
    counted_runs,
    spacing_of_runs,
    with_truth,
)
from pipeline.results.figures.map_errors import map_places
from pipeline.stages.run_row.bounds import (
    DETECTION_TIMES,
    Estimator,
    clopper_pearson,
    continuity_estimate,
    hours_still_needed,
    hours_to_substantiate,
    independent_episodes,
    mtbf_estimate,
    poisson_rate,
    poisson_rate_upper,
    with_estimates,
    without_repeated_runs,
)
from schemas.campaign import STANFORD, CampaignDetection, CampaignFigures
from schemas.config import Configuration, SafetyConfig
from schemas.conform import conform, dtypes
from schemas.enums import TRUTH, RunStatus, RunVerdict

_STATES = ("p0", "p1", "p2", "p3")
_ROUNDING = 1e-9
_ESTIMATES: tuple[Estimator, ...] = (
    *RATES,
    ("false_alarm_rate", "_per_h", poisson_rate, "false_alarms", "hours_judged"),
    ("mtbf", "_h", mtbf_estimate, "trusted_losses", "trusted_h"),
    ("continuity_15s", "", continuity_estimate, "trusted_losses", "trusted_h"),
)
_NAMES = {
    "hazards": "faults",
    "hazards_judged": "truth_faults",
    "hours_with_truth": "truth_h",
    "missed_known": "truth_failed",
    "missed_judged": "truth_missed",
    "failures_judged": "truth_budget",
    "beyond_budget_judged": "truth_beyond",
    "accepted": "balises_accepted",
    "accepted_judged": "truth_accepted",
    "unsafe_judged": "truth_unsafe",
}
"""Sums of columns that `counted_runs` calls otherwise."""
_SUMMED = (
    *("missed", "failures", "failures_within_budget", "failures_beyond_budget", "unsafe_accepted"),
    *("unproven_accepted", "outages", "trusted_losses"),
)


def measured_figures(runs: pl.DataFrame, hazards: pl.DataFrame, config: SafetyConfig) -> pl.DataFrame:
    """One row per solution over all runs: rates with exact two-sided 95 % bounds.

    Takes the `runs` and `hazards` tables of the campaign with their `run_id`. Against a THR every failure counts that
    is not shown to be within the budget.
    """
    done = counted_runs(runs, hazards).filter(pl.col("status") != RunStatus.FAILED)
    sums = (
        done.sort("run_id")
        .group_by("solution")
        .agg(**_sum_expressions(), **_share_expressions(), **spacing_of_runs())
        .sort("solution")
    )
    thr = config.thr_vb_per_h
    against_thr: dict[str, Sequence[float | None]] = {
        "runs_failed": [failed_runs(runs, name) for name in sums["solution"]],
        "beyond_budget_rate_upper_per_h": _figure_of_open_cases(sums, poisson_rate_upper),
        "hours_needed": _figure_of_open_cases(sums, lambda failures, _: hours_to_substantiate(thr, failures)),
        "hours_still_needed": _figure_of_open_cases(
            sums, lambda failures, hours: hours_still_needed(thr, failures, hours)
        ),
    }
    kinds = dtypes(CampaignFigures)
    columns = [pl.Series(name, values, kinds[name]) for name, values in against_thr.items()]
    table = with_estimates(sums, *_ESTIMATES).with_columns(columns, thr_vb_per_h=pl.lit(thr))
    return conform(table.with_columns(**{name: pl.col(sum_of) for name, sum_of in _NAMES.items()}), CampaignFigures)


def failed_runs(runs: pl.DataFrame, solution: str) -> int:
    """How many runs failed for a solution, or before any solution was known."""
    concerned = pl.col("solution").is_in([solution, ""])
    return runs.filter(concerned & (pl.col("status") == RunStatus.FAILED))["run_id"].n_unique()


def _figure_of_open_cases(sums: pl.DataFrame, figure: Callable[[int, float], float | None]) -> list[float | None]:
    """A figure of the failures not shown to be within the budget, and the hours judged by a truth."""
    columns = ("failures", "failures_within_budget", "truth_h")
    return [figure(failures - within, hours) for failures, within, hours in sums.select(columns).iter_rows()]


def _sum_expressions() -> dict[str, pl.Expr]:
    """Expressions for what is added up over the runs of one solution."""
    evidence = pl.col("evidence")
    judged = pl.col("false_alarm_rate_per_h").is_not_null()
    truth = evidence.is_in(TRUTH)
    sums = {name: pl.col(name).sum() for name in (*_SUMMED, *_NAMES.values())}
    sums |= {
        "runs": pl.len(),
        "runs_partial": (pl.col("status") == RunStatus.PARTIAL).sum(),
        "hours": pl.col("duration_s").sum() / 3600.0,
        "hours_with_evidence": pl.col("evidence_s").filter(evidence.is_not_null()).sum() / 3600.0,
        "truth_h": pl.col("in_use_judged_s").filter(truth).sum() / 3600.0,
        "hours_negated": pl.col("negated_s").sum() / 3600.0,
        "hours_unjudged": (pl.col("in_use_s") - pl.col("in_use_judged_s")).sum() / 3600.0,
        "hours_judged": pl.col("judged_s").filter(judged).sum() / 3600.0,
        "false_alarms": pl.col("false_alarms").filter(judged).sum(),
        "trusted_h": pl.col("trusted_s").sum() / 3600.0,
    }
    sums |= {f"runs_{verdict.value}": (pl.col("verdict") == verdict).sum() for verdict in RunVerdict}
    for kind in STANFORD:  # those of the protection level are null where no such run has one
        sums[f"stanford_{kind}"] = pl.col(f"stanford_{kind}").filter(truth).sum()
        counts = pl.col(f"stanford_hpl_{kind}").filter(truth)
        sums[f"stanford_hpl_{kind}"] = pl.when(counts.count() > 0).then(counts.sum())
    return sums


def _share_expressions() -> dict[str, pl.Expr]:
    """Expressions for shares of the time in P0 to P3, all of the same time, and of time in no known state.

    P0 and P1 need a truth, so that the time is that of the runs with one. What the odometer alone tells of the error is
    not good enough.
    """
    held = pl.col("held_s").fill_null(0.0)
    truth = pl.col("truth_held_s") > 0.0
    counted = truth | ~truth.any()
    whole = held.filter(counted).sum()
    shares: dict[str, pl.Expr] = {}
    for state in _STATES:
        spent = (pl.col(f"share_{state}").fill_null(0.0) * held).filter(counted).sum()
        known = (whole > 0.0) & truth.any() if state in ("p0", "p1") else whole > 0.0
        shares[f"share_{state}"] = pl.when(known).then((spent / whole).clip(upper_bound=1.0))
    left = 1.0 - pl.sum_horizontal(share.fill_null(0.0) for share in shares.values())
    unknown = pl.when(whole > 0.0).then(pl.when(left > _ROUNDING).then(left).otherwise(0.0))
    return shares | {"share_unknown": unknown}


def detection_by_level(runs: pl.DataFrame, hazards: pl.DataFrame, levels: pl.DataFrame) -> pl.DataFrame:
    """Hazardous time of every failure, and T_D of the faults, against the allowed T_D of each level (TVB eq. 7).

    Eq. 7 limits how long a hazardous position may be in use, so the hazardous time is compared. The quantiles of T_D
    and of both bounds of T_dsf leave out faults that were not detected. `levels`: of the same runs (`campaign_levels`).
    """
    spent = pl.col("hazardous_s")
    may = pl.col("hazardous_may_s")
    of_failures = (
        failures_table(runs)
        .group_by("solution")
        .agg(failures=pl.len(), hazardous_may_max_s=may.max(), **_quantile_expressions(spent, "hazardous"))
    )
    times = {
        key: value for name in DETECTION_TIMES for key, value in _quantile_expressions(pl.col(name), name[:-2]).items()
    }
    detected = pl.col("time_to_detect_s").count()
    of_episodes = independent_episodes(hazards).group_by("solution").agg(detected=detected, **times)
    measured = of_failures.join(of_episodes, on="solution", how="full", coalesce=True).sort("solution")
    within = pl.col("within")
    exceeded = pl.col("exceeded")
    by_truth = pl.col("evidence").is_in(TRUTH)
    counts = {
        "within": within.sum(),
        "exceeded": exceeded.sum(),
        "failures_judged": (within + exceeded).filter(by_truth).sum(),
        "within_judged": within.filter(by_truth).sum(),
    }
    keys = ["solution", "service_level", "allowed_s"]
    counted = levels.group_by(keys, maintain_order=True).agg(**counts)
    table = measured.join(counted, on="solution", how="left", maintain_order="left_right")
    table = table.with_columns(pl.col("failures", "detected").fill_null(0).cast(pl.Int64))
    share: Estimator = ("within_share", "", clopper_pearson, "within_judged", "failures_judged")
    return conform(with_estimates(table, share), CampaignDetection)


def failures_table(runs: pl.DataFrame) -> pl.DataFrame:
    """One row per failure of all runs: `run_id, solution, hazardous_s, hazardous_may_s`."""
    columns = {"hazardous_s": "failure_hazardous_s", "hazardous_may_s": "failure_hazardous_may_s"}
    return runs.filter(pl.col("failures") > 0).select("run_id", "solution", **columns).explode(*columns)


def _quantile_expressions(values: pl.Expr, name: str) -> dict[str, pl.Expr]:
    """Expressions for median, 95th percentile and largest of some times [s]."""
    return {
        f"{name}_median_s": values.median(),
        f"{name}_p95_s": values.quantile(0.95, interpolation="linear"),
        f"{name}_max_s": values.max(),
    }


def derived_tables(
    runs: pl.DataFrame, hazards: pl.DataFrame, passages: pl.DataFrame, alarms: pl.DataFrame, config: Configuration
) -> dict[str, pl.DataFrame]:
    """Tables by the name of their file, as in `schemas.campaign`; from rows of all runs, in any order.

    What has bounds over runs counts no recording twice.
    """
    once = without_repeated_runs(runs)
    of_once = hazards.join(once, on=["run_id", "solution"], how="semi")
    passed = with_truth(passages.join(once, on=["run_id", "solution"], how="semi"), once)
    levels = campaign_levels(runs, config)
    return {
        "runs": campaign_runs(runs, hazards, config),
        "balises": campaign_balises(passed),
        "accuracy": campaign_accuracy(passed, config),
        "figures": measured_figures(once, of_once, config.safety),
        "detection": detection_by_level(once, of_once, levels.join(once, on=["run_id", "solution"], how="semi")),
        "levels": levels,
        "map": map_places(alarms, config.hazards.map_reach_m),
    }
