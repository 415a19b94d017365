"""What a campaign's runs say together: per run, per balise, and how accurate balises were found.

All functions take tables of many runs with their `run_id`, and give the same result in any order of rows.
"""

from __future__ import annotations

from collections.abc import Callable

import polars as pl

from pipeline.figures.bounds import Estimate, clopper_pearson, poisson_rate
from pipeline.figures.run_figures import is_passage
from pipeline.hazards.independent import independent_episodes
from schemas.campaign import CampaignAccuracy, CampaignBalises, CampaignLevels, campaign_runs_schema
from schemas.config import Configuration, SafetyConfig
from schemas.conform import conform
from schemas.enums import TRUTH, BaliseKind, FailureMode, LinkingError, PassageStatus, RunStatus, ThrVerdict

SPEED_BAND_KMH = 40.0

_RUN = ["run_id", "solution"]


def campaign_runs(runs: pl.DataFrame, hazards: pl.DataFrame, safety: SafetyConfig) -> pl.DataFrame:
    """Every `runs` row with rates, exact bounds and the verdict per service level (CONTRACT section 3)."""
    known_h = pl.col("evidence_s").fill_null(0.0) / 3600.0
    counted = ("faults", "failures", "missed", *(f"within_{level}" for level in safety.service_levels))
    joined = (
        runs.drop("failures")
        .join(_faults_per_run(hazards, safety), on=_RUN, how="left", maintain_order="left")
        .with_columns(
            pl.col(counted).fill_null(0),
            hours=pl.col("duration_s").fill_null(0.0) / 3600.0,
            unsafe_judged=pl.when(pl.col("accepted_judged") > 0).then(pl.col("unsafe_accepted")).otherwise(0),
            hours_seen=pl.when(pl.col("evidence").is_not_null()).then(known_h).otherwise(0.0),
        )
    )
    table = _with_estimates(
        joined,
        ("hazard_rate", "_per_h", poisson_rate, "faults", "hours_seen"),
        ("missed_share", "", clopper_pearson, "missed", "failures"),
        ("unsafe_share", "", clopper_pearson, "unsafe_judged", "accepted_judged"),
        ("outage_rate", "_per_h", poisson_rate, "outages", "hours"),
    )
    levels = [(level, safety.allowed_time_to_detect_s(level)) for level in safety.service_levels]
    table = table.with_columns(column for level, allowed_s in levels for column in _verdict(level, allowed_s))
    return conform(table.sort(_RUN), campaign_runs_schema(safety.service_levels))


def campaign_levels(
    wide: pl.DataFrame, hazards: pl.DataFrame, safety: SafetyConfig, reaction_s: float | None = None
) -> pl.DataFrame:
    """One row per run, solution and service level: would the run have kept this level's allowed T_D (TVB eq. 7)?

    The columns of `wide`, as `campaign_runs` made it, for each level, one below the other. `reaction_s` as in the
    configuration: the time that negation takes, none for one epoch; with the period of the epochs it is the least that
    any fault takes.
    """
    period_s = 1.0 / pl.col("gnss_rate_hz")
    needed_s = period_s + (period_s if reaction_s is None else reaction_s)
    parts = [
        wide.select(
            *_RUN,
            "evidence",
            "failures",
            service_level=pl.lit(level),
            allowed_s=f"allowed_{level}_s",
            within=f"within_{level}",
            verdict=f"verdict_{level}",
            receiver_needs_s=needed_s,
            receiver_quick_enough=needed_s <= safety.allowed_time_to_detect_s(level),
        )
        for level in safety.service_levels
    ]
    longest = independent_episodes(hazards).filter("failed").group_by(_RUN)
    known = longest.agg(
        hazardous_max_s=pl.col("hazardous_s").max(), never_negated=pl.col("hazardous_s").null_count().cast(pl.Int64)
    )
    table = pl.concat(parts) if parts else CampaignLevels.create_empty().drop("hazardous_max_s", "never_negated")
    joined = table.join(known, on=_RUN, how="left", maintain_order="left")
    return conform(
        joined.with_columns(pl.col("never_negated").fill_null(0)).sort(_RUN, maintain_order=True), CampaignLevels
    )


def _faults_per_run(hazards: pl.DataFrame, safety: SafetyConfig) -> pl.DataFrame:
    failed = pl.col("failed")
    within = {
        f"within_{level}": (failed & (pl.col("hazardous_s") <= safety.allowed_time_to_detect_s(level))).sum()
        for level in safety.service_levels
    }
    counts = {"faults": pl.len(), "failures": failed.sum(), "missed": pl.col("missed").sum(), **within}
    return independent_episodes(hazards).group_by(_RUN).agg(**{k: v.cast(pl.Int64) for k, v in counts.items()})


def _verdict(level: str, allowed_s: float) -> list[pl.Expr]:
    blind = pl.col("evidence").is_null() | (pl.col("status") == RunStatus.FAILED)
    kept = pl.col(f"within_{level}") == pl.col("failures")
    verdict = (
        pl.when(pl.col("failures") > 0)
        .then(pl.when(kept).then(pl.lit(ThrVerdict.KEPT.value)).otherwise(pl.lit(ThrVerdict.EXCEEDED.value)))
        .when(blind)
        .then(pl.lit(ThrVerdict.UNKNOWN.value))
        .otherwise(pl.lit(ThrVerdict.NO_FAILURE.value))
    )
    return [pl.lit(allowed_s).alias(f"allowed_{level}_s"), verdict.alias(f"verdict_{level}")]


Estimator = tuple[str, str, Callable[[int, float], Estimate] | Callable[[int, int], Estimate], str, str]


def _with_estimates(frame: pl.DataFrame, *estimates: Estimator) -> pl.DataFrame:
    """Columns `name, name_low, name_high` from events and what they are held against, row by row."""
    series = []
    for name, ending, estimate, events, against in estimates:
        found = list(map(estimate, frame[events].to_list(), frame[against].to_list()))
        for part, values in (
            ("", [item.value for item in found]),
            ("_low", [item.low for item in found]),
            ("_high", [item.high for item in found]),
        ):
            series.append(pl.Series(f"{name}{part}{ending}", values, dtype=pl.Float64))
    return frame.with_columns(series)


def with_judgement(passages: pl.DataFrame, runs: pl.DataFrame) -> pl.DataFrame:
    """Passages with `judged`: an acceptance whose location error a reference or balise reads tell.

    By the odometer alone a position that is wrong from the start looks right at every balise.
    """
    true = runs.filter(pl.col("evidence").is_in(TRUTH)).select(*_RUN, truth=pl.lit(value=True))
    known = (pl.col("status") == PassageStatus.ACCEPTED) & pl.col("location_error_m").is_not_null()
    joined = passages.join(true, on=_RUN, how="left", maintain_order="left")
    return joined.with_columns(judged=known & pl.col("truth").fill_null(value=False)).drop("truth")


def _spread(name: str = "location_error") -> dict[str, pl.Expr]:
    """Mean, sigma, 95 % and largest of the location errors [m] of judged acceptances."""
    error = pl.col("location_error_m").filter(pl.col("judged"))
    return {
        f"{name}_mean_m": error.mean(),
        f"{name}_sigma_m": error.std(),
        f"{name}_p95_m": error.abs().quantile(0.95, interpolation="linear"),
        f"{name}_max_m": error.abs().max(),
    }


def _counts(failure_limit_m: float) -> dict[str, pl.Expr]:
    status, mode, error = pl.col("status"), pl.col("failure_mode"), pl.col("location_error_m")
    accepted, passage = status == PassageStatus.ACCEPTED, is_passage()
    counts = {
        "passages": passage,
        "accepted": accepted,
        "accepted_passages": accepted & passage,
        "rejected": status.cast(pl.String).str.starts_with("rejected_"),
        "missed": status == PassageStatus.MISSED,
        "not_available": status == PassageStatus.NOT_AVAILABLE,
        "deletions": (mode == FailureMode.DELETION) & passage,
        "insertions": mode == FailureMode.INSERTION,
        "linking_errors": pl.col("linking_error") != LinkingError.NONE,
        "accepted_judged": pl.col("judged"),
        "unsafe_judged": pl.col("judged") & (error.abs() > failure_limit_m),
        "unsafe_accepted": accepted & (error.abs() > failure_limit_m),
        "suspect_after_the_fact": pl.col("suspect_after_the_fact"),
    }
    return {name: condition.sum().cast(pl.Int64) for name, condition in counts.items()}


def campaign_balises(passages: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """Per balise and solution: how often accepted, lost or accepted unsafely, with exact bounds.

    Deletions and acceptances are shares of the trains that passed; unsafe acceptances are shares of
    the acceptances that a truth judged (`with_judgement`).
    """
    table = (
        _in_order(passages)
        .group_by("solution", "balise_id", "kind", maintain_order=True)
        .agg(
            pl.col("netelement_id", "measure_m").first(),
            runs=pl.col("run_id").n_unique().cast(pl.Int64),
            **_counts(config.hazards.failure_limit_m),
            **_spread(),
        )
        .pipe(
            _with_estimates,
            ("accepted_share", "", clopper_pearson, "accepted_passages", "passages"),
            ("deletion_rate", "", clopper_pearson, "deletions", "passages"),
            ("unsafe_rate", "", clopper_pearson, "unsafe_judged", "accepted_judged"),
        )
    )
    return conform(table.sort("solution", "kind", "balise_id"), CampaignBalises)


def _in_order(passages: pl.DataFrame) -> pl.DataFrame:
    """Rows by run, in each run as they stand: sums of floats then do not depend on the order of runs."""
    return passages.sort("run_id", maintain_order=True)


def campaign_accuracy(passages: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """Location error of accepted VBs over all, by net element and by speed, against Q_LOCACC and the CI limit.

    Each judged acceptance (`with_judgement`) is held against the location accuracy of its own balise. Bands of 40 km/h
    from 0.
    """
    accepted = _in_order(passages).filter((pl.col("kind") == BaliseKind.VIRTUAL) & pl.col("judged"))
    values = ("solution", "judged", "location_error_m", "location_accuracy_m")
    groups = {"all": pl.lit(""), "netelement_id": pl.col("netelement_id"), "speed_band_kmh": _speed_band()}
    grouped = accepted.select(*values, **groups).unpivot(
        list(groups), index=values, variable_name="grouped_by", value_name="group"
    )
    return conform(_accuracy(grouped, config), CampaignAccuracy)


def _speed_band() -> pl.Expr:
    low = (pl.col("speed_mps") * 3.6 / SPEED_BAND_KMH).floor().cast(pl.Int64) * int(SPEED_BAND_KMH)
    band = pl.format(
        "{}-{}", low.cast(pl.String).str.zfill(3), (low + int(SPEED_BAND_KMH)).cast(pl.String).str.zfill(3)
    )
    return band.fill_null("unknown")


def _accuracy(accepted: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    keys = ["grouped_by", "solution", "group"]
    size, own_m, limit_m = pl.col("location_error_m").abs(), pl.col("location_accuracy_m"), config.lds.ci_limit_m
    counted = (
        accepted.group_by(keys, maintain_order=True)
        .agg(
            accepted_judged=pl.len().cast(pl.Int64),
            **_spread(),
            location_error_median_m=pl.col("location_error_m").median(),
            location_accuracy_m=own_m.min(),
            location_accuracy_max_m=own_m.max(),
            within_location_accuracy=(size <= own_m).sum().cast(pl.Int64),
            within_ci_limit=(size <= limit_m).sum().cast(pl.Int64),
        )
        .with_columns(ci_limit_m=pl.lit(limit_m))
    )
    return _with_estimates(
        counted.sort(keys),
        ("within_location_accuracy_share", "", clopper_pearson, "within_location_accuracy", "accepted_judged"),
        ("within_ci_limit_share", "", clopper_pearson, "within_ci_limit", "accepted_judged"),
    )
