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
from pipeline.hazards.independent import independent_episodes
from pipeline.safety.tally import columns_of, continuity_columns
from schemas.campaign import STANFORD, CampaignDetection, CampaignFigures
from schemas.config import SafetyConfig
from schemas.conform import conform, dtypes
from schemas.enums import TRUTH, RunStatus

Row = dict[str, object]

_STATES = ("p0", "p1", "p2", "p3")
_ROUNDING = 1e-9


def _table(rows: list[Row], contract: type[dy.Schema]) -> pl.DataFrame:
    return conform(pl.DataFrame(rows, schema=dtypes(contract)), contract)


def measured_figures(runs: pl.DataFrame, hazards: pl.DataFrame, config: SafetyConfig) -> pl.DataFrame:
    """One row per solution over all runs: rates with exact two-sided 95 % bounds.

    Takes the `runs` and `hazards` tables of the campaign with their `run_id`. Each fault counts once,
    per hour with any evidence; missed detections are judged by the budget in their own rows. A THR is
    substantiated by hours with a truth only (reference or balises): what the odometer alone lets see
    has to exceed its confidence first.
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
    judged = pl.col("false_alarm_rate_per_h").is_not_null()
    yield pl.col("duration_s").fill_null(0.0).sum()
    yield evidence_s.filter(evidence.is_not_null()).sum().alias("seen_s")
    yield evidence_s.filter(evidence.is_in(TRUTH)).sum().alias("truth_s")
    yield pl.col("judged_s").fill_null(0.0).filter(judged).sum()
    yield pl.col("false_alarms").filter(judged).sum()
    yield (pl.col("status") == RunStatus.PARTIAL).sum().alias("runs_partial")
    yield pl.col("unsafe_accepted").filter(evidence.is_in(TRUTH)).sum().alias("unsafe_judged")
    yield pl.col(
        "balises_accepted", "accepted_judged", "unsafe_accepted", "outages", "trusted_s", "trusted_losses"
    ).sum()
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
    failures, missed = int(episodes["failed"].sum()), int(episodes["missed"].sum())
    judged_failures = episodes.filter(pl.col("failed") & pl.col("with_truth"))
    missed_judged = int(judged_failures["missed"].sum())
    same = ("runs_partial", "accepted_judged", "unsafe_judged", "unsafe_accepted", "outages", "trusted_losses")
    return {
        **{name: sums[name] for name in (*same, "false_alarms")},
        "runs": runs.height,
        "hours": hours,
        "hours_with_evidence": seen,
        "hours_with_truth": truth,
        "hazards": episodes.height,
        **columns_of("hazard_rate", poisson_rate(episodes.height, seen), "_per_h"),
        "failures": failures,
        "missed": missed,
        "failures_judged": judged_failures.height,
        "missed_judged": missed_judged,
        **columns_of("missed_share", clopper_pearson(missed_judged, judged_failures.height)),
        "missed_rate_upper_per_h": poisson_rate_upper(missed, truth),
        "hours_judged": judged,
        **columns_of("false_alarm_rate", poisson_rate(sums["false_alarms"], judged), "_per_h"),
        "accepted": sums["balises_accepted"],
        **columns_of("unsafe_share", clopper_pearson(sums["unsafe_judged"], sums["accepted_judged"])),
        **columns_of("outage_rate", poisson_rate(sums["outages"], hours), "_per_h"),
        **continuity_columns(Uptime(sums["trusted_s"], sums["trusted_losses"])),
        **_shares(runs),
        **{name: count for name, count in sums.items() if name.startswith("stanford_")},
        "thr_vb_per_h": thr_vb_per_h,
        "hours_needed": hours_to_substantiate(thr_vb_per_h, missed),
        "hours_still_needed": hours_still_needed(thr_vb_per_h, missed, truth),
    }


def detection_by_level(hazards: pl.DataFrame, config: SafetyConfig) -> pl.DataFrame:
    """Measured T_D and hazardous time against the allowed T_D of every service level (TVB eq. 7).

    Eq. 7 limits how long a hazardous position may stand, so `within` compares the hazardous time;
    the quantiles leave out what was never negated or detected, which is counted beside them.
    """
    episodes = independent_episodes(hazards)
    parts = episodes.partition_by("solution", as_dict=True)
    rows = [row for (solution,) in sorted(parts) for row in _by_level(parts[(solution,)], str(solution), config)]
    return _table(rows, CampaignDetection)


def _by_level(episodes: pl.DataFrame, solution: str, config: SafetyConfig) -> list[Row]:
    hazardous_s = episodes["hazardous_s"].filter(episodes["failed"])
    same = {
        "solution": solution,
        "failures": hazardous_s.len(),
        "never_negated": hazardous_s.null_count(),
        **_quantiles(hazardous_s, "hazardous"),
        "detected": episodes["time_to_detect_s"].count(),
        **_quantiles(episodes["time_to_detect_s"], "time_to_detect"),
    }
    return [
        same | _against(episodes.filter("failed"), level, config.allowed_time_to_detect_s(level))
        for level in config.service_levels
    ]


def _against(failures: pl.DataFrame, level: str, allowed_s: float) -> Row:
    judged = failures.filter("with_truth")
    within, within_judged = (int((part["hazardous_s"] <= allowed_s).sum()) for part in (failures, judged))
    return {
        "service_level": level,
        "allowed_s": allowed_s,
        "within": within,
        "failures_judged": judged.height,
        "within_judged": within_judged,
        **columns_of("within_share", clopper_pearson(within_judged, judged.height)),
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
