"""What a campaign measured, each figure with how certain it is, against the safety budget."""

from __future__ import annotations

import dataframely as dy
import polars as pl

from pipeline.hazards.independent import independent_episodes
from pipeline.safety.tally import columns_of, continuity_columns
from pipeline.statistics import (
    clopper_pearson,
    hours_still_needed,
    hours_to_substantiate,
    poisson_rate,
    poisson_rate_upper,
)
from pipeline.timeline import Uptime
from schemas.campaign import STANFORD, CampaignDetection, CampaignFigures
from schemas.config import SafetyConfig
from schemas.conform import conform
from schemas.enums import Evidence, RunStatus

Row = dict[str, object]

TRUTH = [Evidence.REFERENCE.value, Evidence.BALISE.value]


def _table(rows: list[Row], contract: type[dy.Schema]) -> pl.DataFrame:
    dtypes = {name: column.dtype for name, column in contract.columns().items()}
    return conform(pl.DataFrame(rows, schema=dtypes), contract)


def measured_figures(runs: pl.DataFrame, hazards: pl.DataFrame, config: SafetyConfig) -> pl.DataFrame:
    """One row per solution over all runs: rates with exact two-sided 95 % bounds.

    Takes the `runs` and `hazards` tables of the campaign with their `run_id`. Each fault counts once,
    per hour with any evidence; missed detections are judged by the budget in their own rows. A THR is
    substantiated by hours with a truth only (reference or balises): what the odometer alone lets see
    has to exceed its confidence first.
    """
    failed = runs.filter(pl.col("status") == RunStatus.FAILED).height
    done = runs.filter(pl.col("status") != RunStatus.FAILED)
    episodes = independent_episodes(hazards)
    rows = [
        {"solution": solution, "runs_failed": failed}
        | _figures(part, episodes.filter(pl.col("solution") == solution), config.thr_vb_per_h)
        for (solution,), part in sorted(done.group_by("solution"), key=lambda item: str(item[0][0]))
    ]
    return _table(rows, CampaignFigures)


def _hours(runs: pl.DataFrame, column: str = "duration_s") -> float:
    return float(runs[column].fill_null(0.0).sum()) / 3600.0


def _shares(runs: pl.DataFrame) -> Row:
    """Shares of the time in P0 to P3 over the runs; P0 and P1 where the runs know them, P2 and P3 of all."""
    row: Row = {}
    for name in ("share_p0", "share_p1", "share_p2", "share_p3"):
        known = runs.filter(pl.col(name).is_not_null() & (pl.col("held_s") > 0))
        held_s = float(known["held_s"].sum())
        row[name] = min(1.0, float((known[name] * known["held_s"]).sum()) / held_s) if held_s else None
    return row


def _stanford(runs: pl.DataFrame) -> Row:
    """Counts of the along-track Stanford diagram, by confidence and, where there is one, by the receiver's HPL."""
    row: Row = {f"stanford_{kind}": int(runs[f"stanford_{kind}"].sum()) for kind in STANFORD}
    for kind in STANFORD:
        counts = runs[f"stanford_hpl_{kind}"]
        row[f"stanford_hpl_{kind}"] = int(counts.sum()) if counts.count() else None
    return row


def _figures(runs: pl.DataFrame, episodes: pl.DataFrame, thr_vb_per_h: float) -> Row:
    seen = _hours(runs.filter(pl.col("evidence").is_not_null()), "evidence_s")
    judged = runs.filter(pl.col("false_alarm_rate_per_h").is_not_null())
    hours = _hours(runs.filter(pl.col("evidence").is_in(TRUTH)), "evidence_s")
    hours_judged = _hours(judged, "judged_s")
    failures, missed = int(episodes["failed"].sum()), int(episodes["missed"].sum())
    false_alarms, outages = int(judged["false_alarms"].sum()), int(runs["outages"].sum())
    losses = int(runs["trusted_losses"].sum())
    return {
        "runs": runs.height,
        "hours": _hours(runs),
        "hours_with_evidence": seen,
        "hours_with_truth": hours,
        "hazards": episodes.height,
        **columns_of("hazard_rate", poisson_rate(episodes.height, seen), "_per_h"),
        "failures": failures,
        "missed": missed,
        **columns_of("missed_share", clopper_pearson(missed, failures)),
        "missed_rate_upper_per_h": poisson_rate_upper(missed, hours),
        "hours_judged": hours_judged,
        "false_alarms": false_alarms,
        **columns_of("false_alarm_rate", poisson_rate(false_alarms, hours_judged), "_per_h"),
        "accepted": int(runs["balises_accepted"].sum()),
        "unsafe_accepted": int(runs["unsafe_accepted"].sum()),
        "outages": outages,
        **columns_of("outage_rate", poisson_rate(outages, _hours(runs)), "_per_h"),
        "trusted_losses": losses,
        **continuity_columns(Uptime(float(runs["trusted_s"].sum()), losses)),
        **_shares(runs),
        **_stanford(runs),
        "thr_vb_per_h": thr_vb_per_h,
        "hours_needed": hours_to_substantiate(thr_vb_per_h, missed),
        "hours_still_needed": hours_still_needed(thr_vb_per_h, missed, hours),
    }


def detection_by_level(hazards: pl.DataFrame, config: SafetyConfig) -> pl.DataFrame:
    """Measured T_D and hazardous time against the allowed T_D of every service level (TVB eq. 7).

    Eq. 7 limits how long a hazardous position may stand, so `within` compares the hazardous time;
    the quantiles leave out what was never negated or detected, which is counted beside them.
    """
    episodes = independent_episodes(hazards)
    solutions = sorted(episodes["solution"].unique().to_list())
    rows = [
        {"solution": solution, "service_level": level}
        | _against(episodes.filter(pl.col("solution") == solution), config.allowed_time_to_detect_s(level))
        for solution in solutions
        for level in config.service_levels
    ]
    return _table(rows, CampaignDetection)


def _quantiles(values: pl.Series, name: str) -> Row:
    known = values.drop_nulls()
    return {
        f"{name}_median_s": known.median(),
        f"{name}_p95_s": known.quantile(0.95, interpolation="linear"),
        f"{name}_max_s": known.max(),
    }


def _against(episodes: pl.DataFrame, allowed_s: float) -> Row:
    failures = episodes.filter(pl.col("failed"))
    within = failures.filter(pl.col("hazardous_s") <= allowed_s).height
    return {
        "allowed_s": allowed_s,
        "failures": failures.height,
        "within": within,
        **columns_of("within_share", clopper_pearson(within, failures.height)),
        "never_negated": failures["hazardous_s"].null_count(),
        **_quantiles(failures["hazardous_s"], "hazardous"),
        "detected": episodes["time_to_detect_s"].count(),
        **_quantiles(episodes["time_to_detect_s"], "time_to_detect"),
    }


def plain_statements(figures: pl.DataFrame) -> list[str]:
    """What the figures do and do not show, one sentence or two per solution."""
    return [_statement(row) for row in figures.iter_rows(named=True)]


def _statement(row: Row) -> str:
    claim = f"THR_VB of {row['thr_vb_per_h']:.2e}/h at 95 %"
    head = (
        f"{row['solution']}: {row['missed']} missed detections of {row['failures']} position failures"
        f" at virtual balises in {row['hours_with_truth']:.6g} h with a truth."
    )
    if row["share_p1"]:
        head += f" Beyond the failure limit and not negated, at a balise or not: {row['share_p1']:.3%} of the time."
    if row["hours_still_needed"] == 0.0:
        return f"{head} This substantiates a {claim}."
    return (
        f"{head} This trial cannot substantiate a {claim}: it takes {row['hours_needed']:.3g} h with no further"
        f" miss, {row['hours_still_needed']:.3g} h more. The claim has to rest on the time to detect."
    )


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
