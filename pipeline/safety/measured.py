"""What a campaign measured, each figure with how certain it is, against the safety budget."""

from __future__ import annotations

from collections.abc import Iterator

import dataframely as dy
import polars as pl

from pipeline.epochs.timeline import Uptime
from pipeline.figures.bounds import (
    clopper_pearson,
    hours_still_needed,
    hours_to_substantiate,
    poisson_rate,
    poisson_rate_upper,
)
from pipeline.figures.independent import independent_episodes
from pipeline.figures.levels import level_counts
from pipeline.safety.tally import columns_of, continuity_columns
from schemas.campaign import STANFORD, CampaignDetection, CampaignFigures
from schemas.config import SafetyConfig
from schemas.conform import conform, dtypes
from schemas.enums import TRUTH, RunStatus, RunVerdict

Row = dict[str, object]

_STATES = ("p0", "p1", "p2", "p3")
_ROUNDING = 1e-9
_SUMMED = (
    *("failures", "failures_within_budget", "failures_beyond_budget", "unsafe_accepted", "unproven_accepted"),
    *("outages", "trusted_losses"),
)


def _table(rows: list[Row], contract: type[dy.Schema]) -> pl.DataFrame:
    return conform(pl.DataFrame(rows, schema=dtypes(contract)), contract)


def measured_figures(runs: pl.DataFrame, hazards: pl.DataFrame, config: SafetyConfig) -> pl.DataFrame:
    """One row per solution over all runs: rates with exact two-sided 95 % bounds.

    Takes the `runs` and `hazards` tables of the campaign with their `run_id`. Rates and shares are of what a
    reference or balise reads tell: the odometer alone can show that a position was wrong, never that it was right.
    Against a THR every failure counts that is not shown to be within the budget.
    """
    done = runs.filter(pl.col("status") != RunStatus.FAILED)
    episodes = independent_episodes(hazards)
    parts = done.partition_by("solution", as_dict=True)
    rows = [
        {"solution": solution, "runs_failed": failed_runs(runs, solution)}
        | _figures(parts[(solution,)], episodes.filter(pl.col("solution") == solution), config.thr_vb_per_h)
        for (solution,) in sorted(parts)
    ]
    return _table(rows, CampaignFigures)


def failed_runs(runs: pl.DataFrame, solution: str) -> int:
    """How many runs failed for a solution, or before any solution was known."""
    concerned = pl.col("solution").is_in([solution, ""])
    return runs.filter(concerned & (pl.col("status") == RunStatus.FAILED))["run_id"].n_unique()


def _sums() -> Iterator[pl.Expr]:
    """What is added up over the runs of one solution; times in seconds."""
    evidence, evidence_s = pl.col("evidence"), pl.col("evidence_s").fill_null(0.0)
    truth = evidence.is_in(TRUTH).fill_null(value=False)
    judged = pl.col("false_alarm_rate_per_h").is_not_null()
    yield pl.col("duration_s").fill_null(0.0).sum()
    yield evidence_s.filter(evidence.is_not_null()).sum().alias("seen_s")
    yield evidence_s.filter(evidence.is_in(TRUTH)).sum().alias("truth_s")
    yield pl.col("judged_s").fill_null(0.0).filter(judged).sum()
    yield pl.col("false_alarms").filter(judged).sum()
    yield (pl.col("status") == RunStatus.PARTIAL).sum().alias("runs_partial")
    for verdict in RunVerdict:
        yield (pl.col("verdict") == verdict).sum().alias(f"runs_{verdict.value}")
    for name in ("unsafe_accepted", "accepted_judged", "failures_within_budget", "failures_beyond_budget"):
        yield pl.col(name).filter(truth).sum().name.suffix("_by_truth")
    yield pl.col(*_SUMMED, "balises_accepted", "trusted_s").sum()
    yield pl.col(f"stanford_{kind}" for kind in STANFORD).filter(evidence.is_in(TRUTH)).sum()
    for kind in STANFORD:  # null where no such run has a protection level
        counts = pl.col(f"stanford_hpl_{kind}").filter(evidence.is_in(TRUTH))
        yield pl.when(counts.count() > 0).then(counts.sum())


def _shares(runs: pl.DataFrame) -> Row:
    """Shares of the time in P0 to P3, all of the same time, and what is left: the state is not known.

    P0 and P1 need a truth, so that the time is that of the runs with one. What the odometer alone tells of the error is
    not good enough to call a position right. Without a truth P2 and P3 are those of all runs.
    """
    with_truth = runs.filter(pl.col("evidence").is_in(TRUTH) & (pl.col("held_s") > 0))
    judged = with_truth if with_truth.height else runs.filter(pl.col("held_s") > 0)
    whole_s = float(judged["held_s"].sum())
    if not whole_s:
        return {}
    spent = judged.select((pl.col(f"share_{state}").fill_null(0.0) * pl.col("held_s")).sum() for state in _STATES)
    shares: dict[str, float | None] = {state: min(1.0, spent[f"share_{state}"].item() / whole_s) for state in _STATES}
    if not with_truth.height:
        shares |= {"p0": None, "p1": None}
    left = 1.0 - sum(share for share in shares.values() if share is not None)
    shares["unknown"] = left if left > _ROUNDING else 0.0
    return {f"share_{state}": share for state, share in shares.items()}


def _figures(runs: pl.DataFrame, episodes: pl.DataFrame, thr_vb_per_h: float) -> Row:
    sums = runs.select(_sums()).row(0, named=True)
    hours, seen, truth, judged = (sums[f"{name}_s"] / 3600.0 for name in ("duration", "seen", "truth", "judged"))
    same = (*_SUMMED, "runs_partial", *(f"runs_{verdict.value}" for verdict in RunVerdict), "false_alarms")
    return {
        **{name: sums[name] for name in same},
        "runs": runs.height,
        "hours": hours,
        "hours_with_evidence": seen,
        "hours_with_truth": truth,
        **_detections(episodes, truth),
        **_against_budget(sums, truth, thr_vb_per_h),
        "hours_judged": judged,
        **columns_of("false_alarm_rate", poisson_rate(sums["false_alarms"], judged), "_per_h"),
        "accepted": sums["balises_accepted"],
        "accepted_judged": sums["accepted_judged_by_truth"],
        "unsafe_judged": sums["unsafe_accepted_by_truth"],
        **columns_of(
            "unsafe_share", clopper_pearson(sums["unsafe_accepted_by_truth"], sums["accepted_judged_by_truth"])
        ),
        **columns_of("outage_rate", poisson_rate(sums["outages"], hours), "_per_h"),
        **continuity_columns(Uptime(sums["trusted_s"], sums["trusted_losses"])),
        **_shares(runs),
        **{name: count for name, count in sums.items() if name.startswith("stanford_")},
    }


def _detections(episodes: pl.DataFrame, truth_h: float) -> Row:
    """Faults and missed detections; rate and share by a reference or balise reads."""
    judged = episodes.filter(pl.col("with_truth"))
    known = judged.filter("failed")
    missed = int(known["missed"].sum())
    return {
        "hazards": episodes.height,
        "hazards_judged": judged.height,
        **columns_of("hazard_rate", poisson_rate(judged.height, truth_h), "_per_h"),
        "missed": int(episodes["missed"].sum()),
        "missed_known": known.height,
        "missed_judged": missed,
        **columns_of("missed_share", clopper_pearson(missed, known.height)),
    }


def _against_budget(sums: Row, truth_h: float, thr_vb_per_h: float) -> Row:
    """Failures against the budget, and against the THR those that are not shown to be within it."""
    failures, within, by_truth, beyond = (
        int(str(sums[name]))
        for name in (
            *("failures", "failures_within_budget", "failures_within_budget_by_truth"),
            "failures_beyond_budget_by_truth",
        )
    )
    return {
        "failures_judged": by_truth + beyond,
        "beyond_budget_judged": beyond,
        **columns_of("beyond_budget_share", clopper_pearson(beyond, by_truth + beyond)),
        "beyond_budget_rate_upper_per_h": poisson_rate_upper(failures - within, truth_h),
        "thr_vb_per_h": thr_vb_per_h,
        "hours_needed": hours_to_substantiate(thr_vb_per_h, failures - within),
        "hours_still_needed": hours_still_needed(thr_vb_per_h, failures - within, truth_h),
    }


def detection_by_level(runs: pl.DataFrame, hazards: pl.DataFrame, config: SafetyConfig) -> pl.DataFrame:
    """Hazardous time of every failure, and T_D of the faults, against the allowed T_D of each level (TVB eq. 7).

    Eq. 7 limits how long a hazardous position may be in use, so the hazardous time is compared. The quantiles of T_D
    leave out faults that were not detected.
    """
    failures = failures_of(runs)
    episodes = independent_episodes(hazards)
    solutions = sorted({*failures["solution"].to_list(), *episodes["solution"].to_list()})
    rows = [
        row
        for name in solutions
        for row in _by_level(name, failures.filter(solution=name), episodes.filter(solution=name), config)
    ]
    return _table(rows, CampaignDetection)


def failures_of(runs: pl.DataFrame) -> pl.DataFrame:
    """One row per failure of all runs: `run_id, solution, by_truth, hazardous_s, hazardous_may_s`."""
    by_truth = pl.col("evidence").is_in(TRUTH).fill_null(value=False)
    listed = runs.filter(pl.col("failures") > 0).select(
        "run_id",
        "solution",
        by_truth=by_truth,
        hazardous_s="failure_hazardous_s",
        hazardous_may_s="failure_hazardous_may_s",
    )
    return listed.explode("hazardous_s", "hazardous_may_s")


def _by_level(solution: str, failures: pl.DataFrame, episodes: pl.DataFrame, config: SafetyConfig) -> list[Row]:
    same = {
        "solution": solution,
        "failures": failures.height,
        **_quantiles(failures["hazardous_s"], "hazardous"),
        "hazardous_may_max_s": failures["hazardous_may_s"].max(),
        "detected": episodes["time_to_detect_s"].count(),
        **_quantiles(episodes["time_to_detect_s"], "time_to_detect"),
    }
    return [same | _against(failures, level, config.allowed_time_to_detect_s(level)) for level in config.service_levels]


def _against(failures: pl.DataFrame, level: str, allowed_s: float) -> Row:
    whole, judged = (
        level_counts(part["hazardous_s"].to_list(), part["hazardous_may_s"].to_list(), allowed_s)
        for part in (failures, failures.filter("by_truth"))
    )
    return {
        "service_level": level,
        "allowed_s": allowed_s,
        "within": whole[0],
        "exceeded": whole[1],
        "failures_judged": sum(judged),
        "within_judged": judged[0],
        **columns_of("within_share", clopper_pearson(judged[0], sum(judged))),
    }


def _quantiles(values: pl.Series, name: str) -> Row:
    known = values.drop_nulls()
    return {
        f"{name}_median_s": known.median(),
        f"{name}_p95_s": known.quantile(0.95, interpolation="linear"),
        f"{name}_max_s": known.max(),
    }


def substantiation_table(config: SafetyConfig, events: tuple[int, ...] = (0, 1, 2, 5)) -> pl.DataFrame:
    """Hours [h] that show a rate at 95 %, by events seen, for THR_VB and the rate of each service level."""
    targets = {"THR_VB": config.thr_vb_per_h} | {
        f"signal in space, {level}": service.hazard_rate_per_h for level, service in config.service_levels.items()
    }
    rows = [
        (target, rate, count, hours_to_substantiate(rate, count), hours_to_substantiate(rate, count) / 8766.0)
        for target, rate in targets.items()
        for count in events
    ]
    return pl.DataFrame(rows, schema=["target", "rate_per_h", "events", "hours", "years"], orient="row")
