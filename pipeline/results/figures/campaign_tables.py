"""What a campaign's runs say together: per run, per balise, and how accurate balises were found.

All functions take tables of many runs with their `run_id`, and give the same result in any order of rows.
"""

from __future__ import annotations

import polars as pl

from pipeline.stages.epochs.clock import reaction_or_period_s
from pipeline.stages.run_row.bounds import (
    CONFIDENCE,
    Estimator,
    clopper_pearson,
    independent_episodes,
    poisson_rate,
    with_estimates,
)
from pipeline.stages.run_row.run_figures import (
    DECISIVE,
    acceptance_conditions,
    error_spread,
    is_accepted,
    is_passage,
    level_rows,
    outcome_conditions,
)
from schemas.campaign import CampaignAccuracy, CampaignBalises, CampaignLevels, campaign_runs_schema
from schemas.config import Configuration
from schemas.conform import conform, dtypes
from schemas.enums import TRUTH, BaliseKind, FailureMode, LinkingError


def undetected_spread() -> dict[str, pl.Expr]:
    """Expressions for the larger undetected error of both directions at one balise, and how far before one may lie."""
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
    """Expressions for the shortest spacing over the runs of one solution, and the share of runs that keep it.

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


# How a table is cut: it stands in the names of its rows, and no figure of a run depends on it.
SPEED_BAND_KMH = 40.0

RUN = ["run_id", "solution"]


RATES: tuple[Estimator, ...] = (
    ("hazard_rate", "_per_h", poisson_rate, "truth_faults", "truth_h"),
    ("missed_share", "", clopper_pearson, "truth_missed", "truth_failed"),
    ("beyond_budget_share", "", clopper_pearson, "truth_beyond", "truth_budget"),
    ("unsafe_share", "", clopper_pearson, "truth_unsafe", "truth_accepted"),
    ("outage_rate", "_per_h", poisson_rate, "outages", "hours"),
)
"""Rates and shares of runs and of solutions: of what is known by a reference or balise reads, but for outages."""


def counted_runs(runs: pl.DataFrame, hazards: pl.DataFrame) -> pl.DataFrame:
    """`runs` rows with `missed`, `hours` and, as `truth_*`, what a reference or balise reads tell of them.

    The odometer alone can show that a position was wrong, never that it was right.
    """
    faults = _faults_per_run(hazards)
    by_truth = pl.col("evidence").is_in(TRUTH).fill_null(value=False)
    counts = {
        "truth_unsafe": pl.col("unsafe_accepted"),
        "truth_accepted": pl.col("accepted_judged"),
        "truth_within": pl.col("failures_within_budget"),
        "truth_beyond": pl.col("failures_beyond_budget"),
        "truth_h": pl.col("in_use_judged_s").fill_null(0.0) / 3600.0,
        "truth_held_s": pl.col("held_s").fill_null(0.0),
    }
    return (
        runs.drop("faults")
        .join(faults, on=RUN, how="left", maintain_order="left")
        .with_columns(pl.col(faults.drop(RUN).columns).fill_null(0), hours=pl.col("duration_s").fill_null(0.0) / 3600.0)
        .with_columns(pl.when(by_truth).then(value).otherwise(0).alias(name) for name, value in counts.items())
        .with_columns(truth_budget=pl.col("truth_within") + pl.col("truth_beyond"))
    )


def campaign_runs(runs: pl.DataFrame, hazards: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """Every `runs` row with rates, exact bounds and the verdict per service level (CONTRACT section 3)."""
    table = with_estimates(counted_runs(runs, hazards), *RATES)
    levels = campaign_levels(runs, config)
    for level in config.safety.service_levels:
        named = {f"allowed_{level}_s": "allowed_s"}
        named |= {f"{part}_{level}": part for part in ("within", "exceeded", "verdict")}
        table = table.join(levels.filter(service_level=level).select(*RUN, **named), on=RUN, how="left")
    return conform(table.sort(RUN), campaign_runs_schema(config.safety.service_levels))


def campaign_levels(runs: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """One row per run, solution and service level: would the run have kept this level's allowed T_D (TVB eq. 7)?

    With the reaction time of the configuration (none: one epoch) the period of the epochs is the least that any fault
    takes.
    """
    period_s = 1.0 / pl.col("gnss_rate_hz")
    needed = runs.select(
        *(*RUN, "evidence", "failures", "hazardous_max_s", *DECISIVE),
        hazardous_may_max_s=pl.col("failure_hazardous_may_s").list.max(),
        receiver_needs_s=period_s + reaction_or_period_s(period_s, config),
    )
    rows = [run | level for run in needed.iter_rows(named=True) for level in level_rows(run, config)]
    quick = pl.col("receiver_needs_s") <= pl.col("allowed_s")
    kinds = {name: kind for name, kind in dtypes(CampaignLevels).items() if name != "receiver_quick_enough"}
    table = pl.DataFrame(rows, schema=kinds).with_columns(receiver_quick_enough=quick)
    return conform(table.sort(RUN, maintain_order=True), CampaignLevels)


def _faults_per_run(hazards: pl.DataFrame) -> pl.DataFrame:
    """Number of faults of each run, and how many were missed."""
    missed = pl.col("missed")
    truth = pl.col("with_truth")
    counts = {
        "faults": pl.len(),
        "missed": missed.sum(),
        "truth_faults": truth.sum(),
        "truth_failed": (missed.is_not_null() & truth).sum(),
        "truth_missed": (truth & missed).sum(),
    }
    return independent_episodes(hazards).group_by(RUN).agg(**{k: v.cast(pl.Int64) for k, v in counts.items()})


def with_truth(passages: pl.DataFrame, runs: pl.DataFrame) -> pl.DataFrame:
    """Passages with `truth`: their run was judged by a reference or balise reads.

    The odometer alone can show that a position was wrong, never that it was right: shares leave it out.
    """
    true = runs.filter(pl.col("evidence").is_in(TRUTH)).select(*RUN, truth=pl.lit(value=True))
    joined = passages.join(true, on=RUN, how="left", maintain_order="left")
    return joined.with_columns(pl.col("truth").fill_null(value=False))


def _location_error_spread() -> dict[str, pl.Expr]:
    """Expressions for the spread of the location errors [m] of acceptances."""
    error = pl.col("location_error_m").filter(is_accepted())
    return {**error_spread(error, "location_error", "count"), "location_error_sigma_m": error.std()}


def _count_conditions() -> dict[str, pl.Expr]:
    """Conditions on passages (`with_truth`): in how many rows each holds."""
    mode = pl.col("failure_mode")
    passage = is_passage()
    judged = acceptance_conditions()
    counts = {
        **outcome_conditions(),
        **judged,
        "passages": passage,
        "accepted_passages": is_accepted() & passage,
        "deletions": (mode == FailureMode.DELETION) & passage,
        "insertions": mode == FailureMode.INSERTION,
        "linking_errors": pl.col("linking_error") != LinkingError.NONE,
        "accepted_judged": judged["accepted_judged"] & pl.col("truth"),
        "unsafe_judged": judged["unsafe_accepted"] & pl.col("truth"),
        "suspect_after_the_fact": pl.col("suspect_after_the_fact"),
    }
    return {name: condition.sum().cast(pl.Int64) for name, condition in counts.items()}


def campaign_balises(passages: pl.DataFrame) -> pl.DataFrame:
    """How often each balise was accepted, lost or accepted unsafely, per solution, with exact bounds.

    Deletions and acceptances are shares of the trains that passed; unsafe acceptances are shares of
    the acceptances that a truth judged. `passages`: `with_truth`.
    """
    table = (
        _sort_by_run(passages)
        .group_by("solution", "balise_id", "kind", maintain_order=True)
        .agg(
            pl.col("netelement_id", "measure_m").first(),
            runs=pl.col("run_id").n_unique().cast(pl.Int64),
            **_count_conditions(),
            **_location_error_spread(),
            **undetected_spread(),
        )
        .pipe(
            with_estimates,
            ("accepted_share", "", clopper_pearson, "accepted_passages", "passages"),
            ("deletion_rate", "", clopper_pearson, "deletions", "passages"),
            ("unsafe_rate", "", clopper_pearson, "unsafe_judged", "accepted_judged"),
        )
    )
    return conform(table.sort("solution", "kind", "balise_id"), CampaignBalises)


def _sort_by_run(passages: pl.DataFrame) -> pl.DataFrame:
    """Rows by run, in each run as they stand: sums of floats then do not depend on the order of runs."""
    return passages.sort("run_id", maintain_order=True)


def campaign_accuracy(passages: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """Location error of accepted VBs over all, by net element and by speed, against Q_LOCACC and the CI limit.

    Each acceptance whose error is known to 5 m is held against the location accuracy of its own balise. Bands of
    40 km/h from 0.
    """
    known = (pl.col("kind") == BaliseKind.VIRTUAL) & is_accepted() & pl.col("location_error_m").is_not_null()
    values = ("solution", "status", "location_error_m", "location_accuracy_m")
    groups = {"all": pl.lit(""), "netelement_id": pl.col("netelement_id"), "speed_band_kmh": _speed_band()}
    grouped = (
        _sort_by_run(passages)
        .filter(known)
        .select(*values, **groups)
        .unpivot(list(groups), index=values, variable_name="grouped_by", value_name="group")
    )
    return conform(_accuracy_by_group(grouped, config), CampaignAccuracy)


def _speed_band() -> pl.Expr:
    """Band of speed that a row lies in."""
    low = (pl.col("speed_mps") * 3.6 / SPEED_BAND_KMH).floor().cast(pl.Int64) * int(SPEED_BAND_KMH)
    band = pl.format(
        "{}-{}", low.cast(pl.String).str.zfill(3), (low + int(SPEED_BAND_KMH)).cast(pl.String).str.zfill(3)
    )
    return band.fill_null("unknown")


def _accuracy_by_group(offers: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """Location errors of groups of balises, against the accuracy they state."""
    keys = ["grouped_by", "solution", "group"]
    size = pl.col("location_error_m").abs()
    own_m = pl.col("location_accuracy_m")
    limit_m = config.lds.ci_limit_m
    counted = (
        offers.group_by(keys, maintain_order=True)
        .agg(
            **_location_error_spread(),
            location_error_median_m=pl.col("location_error_m").median(),
            location_accuracy_m=own_m.min(),
            location_accuracy_max_m=own_m.max(),
            within_location_accuracy=(size <= own_m).sum().cast(pl.Int64),
            within_ci_limit=(size <= limit_m).sum().cast(pl.Int64),
        )
        .with_columns(ci_limit_m=pl.lit(limit_m))
    )
    return with_estimates(
        counted.sort(keys),
        ("within_location_accuracy_share", "", clopper_pearson, "within_location_accuracy", "location_error_count"),
        ("within_ci_limit_share", "", clopper_pearson, "within_ci_limit", "location_error_count"),
    )
