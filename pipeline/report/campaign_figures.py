"""Headline figures of a campaign per solution, each with its exact bounds."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from pipeline.figures.bounds import Estimate, clopper_pearson, hours_still_needed, poisson_rate, poisson_rate_upper
from pipeline.figures.campaign_tables import acceptances, with_truth
from pipeline.figures.independent import independent_episodes
from pipeline.figures.levels import level_counts
from pipeline.figures.run_figures import is_passage
from pipeline.report.markup import UNKNOWN, number
from pipeline.safety.measured import failures_of
from schemas.config import SafetyConfig
from schemas.enums import TRUTH, BaliseKind, PassageStatus, RunStatus

_REPLAYED = (RunStatus.OK, RunStatus.PARTIAL)


@dataclass(frozen=True)
class Figure:
    """One figure: its name, its value as text, and what bounds it."""

    name: str
    value: str
    bounds: str = ""


def headline(
    runs: pl.DataFrame,
    failed: int,
    hazards: pl.DataFrame,
    passages: pl.DataFrame,
    safety: SafetyConfig,
) -> list[Figure]:
    """Figures of one solution; every table holds that solution's rows of all runs. `failed`: runs that could not be
    replayed with it.

    Rates count what the campaign contains, injected faults included.
    """
    runs = runs.filter(pl.col("status") != RunStatus.FAILED)
    return [
        *_extent(runs, failed),
        *_failure_figures(runs, safety),
        *_hazard_figures(runs, hazards),
        *_balise_figures(with_truth(passages, runs)),
        _false_alarms(runs),
    ]


def _extent(runs: pl.DataFrame, failed: int) -> list[Figure]:
    hours = _total(runs, "duration_s") / 3600.0
    counts = [f"{runs.filter(pl.col('status') == status).height} {status.value}" for status in _REPLAYED]
    lost = f"; {failed} more failed and count nowhere" if failed else ""
    known = runs.filter(pl.col("availability").is_not_null() & pl.col("duration_s").is_not_null())
    weight = _total(known, "duration_s")
    moving = known.select((pl.col("availability") * pl.col("duration_s")).alias("held"))
    mean = _total(moving, "held") / weight if weight else None
    return [
        Figure("runs", str(runs.height), ", ".join(counts) + lost),
        Figure("replayed", f"{number(hours)} h", f"{number(_total(runs, 'distance_m') / 1000.0)} km"),
        Figure(
            "availability of the TVB while moving",
            UNKNOWN if mean is None else f"{mean:.2%}",
            "mean of the runs, weighted by their duration",
        ),
    ]


def _truth_hours(runs: pl.DataFrame) -> float:
    return _total(runs.filter(pl.col("evidence").is_in(TRUTH)), "evidence_s") / 3600.0


def _failure_figures(runs: pl.DataFrame, safety: SafetyConfig) -> list[Figure]:
    """Failures against the budget; against a THR every one counts that is not shown to be within it, over the hours
    judged by a reference or balise reads.
    """
    seen, hours = _total(runs, "evidence_s") / 3600.0, _truth_hours(runs)
    failures, within, beyond = (
        int(_total(runs, name)) for name in ("failures", "failures_within_budget", "failures_beyond_budget")
    )
    open_cases = failures - within
    upper, needed = poisson_rate_upper(open_cases, hours), hours_still_needed(safety.thr_vb_per_h, open_cases, hours)
    claim = "" if upper is None else f"; one-sided 95 %: below {number(upper)} /h"
    return [
        Figure("hours judged", f"{number(seen)} h", f"{number(hours)} h of these by reference or balises"),
        Figure(
            "position failures in use",
            f"{failures}, {beyond} beyond the budget",
            f"{within} within it, {open_cases - beyond} not known; those not within it per hour by reference or balises"
            f" {_rate(poisson_rate(open_cases, hours))}{claim}",
        ),
        Figure(
            "longest hazardous time",
            _seconds(runs["hazardous_max_s"].max()),
            "judged wrong in use, from the epoch before",
        ),
        Figure(
            "to substantiate the THR of a VB",
            f"{needed:.3g} h more",
            f"by reference or balises, without a further failure, for {safety.thr_vb_per_h:g} /h",
        ),
    ]


def _hazard_figures(runs: pl.DataFrame, hazards: pl.DataFrame) -> list[Figure]:
    """Faults, not rows; rate and share are of those that a reference or balise reads tell."""
    faults = independent_episodes(hazards)
    judged = faults.filter("with_truth")
    known = judged.filter("failed")
    share = clopper_pearson(int(known["missed"].sum()), known.height)
    return [
        Figure(
            "faults that led to hazards",
            f"{faults.height} in {hazards.height} rows",
            f"{judged.height} by reference or balises: {_rate(poisson_rate(judged.height, _truth_hours(runs)))}",
        ),
        Figure(
            "missed detections",
            f"{faults['missed'].sum()} of {faults['failed'].sum()} with a failure",
            f"of the {known.height} judged by a truth {_share(share)}",
        ),
        Figure(
            "longest time to detect",
            _seconds(hazards["time_to_detect_s"].max()),
            f"of the {hazards['detected'].sum()} hazards detected; {(~hazards['detected']).sum()} were not",
        ),
    ]


def _balise_figures(passages: pl.DataFrame) -> list[Figure]:
    virtual = passages.filter(pl.col("kind") == BaliseKind.VIRTUAL)
    met = virtual.filter(is_passage())
    through = met.filter(pl.col("status") == PassageStatus.ACCEPTED)
    counts = virtual.select(condition.sum().alias(name) for name, condition in acceptances().items()).row(0, named=True)
    judged, unsafe, seen, unproven = (
        counts[name] for name in ("accepted_judged", "unsafe_judged", "unsafe_accepted", "unproven_accepted")
    )
    return [
        Figure(
            "VBs accepted",
            f"{through.height} of {met.height} passages",
            _share(clopper_pearson(through.height, met.height)),
        ),
        Figure(
            "accepted despite a wrong position",
            f"{unsafe} of {judged} judged by a truth",
            f"{_share(clopper_pearson(unsafe, judged))}; {seen - unsafe} more by the odometer alone; of {unproven}"
            " accepted ones nothing says whether the position was right",
        ),
    ]


def _false_alarms(runs: pl.DataFrame) -> Figure:
    """Only runs whose alarms were all judged say anything about false ones."""
    judged = runs.filter(pl.col("false_alarm_rate_per_h").is_not_null())
    if judged.is_empty():
        return Figure("false alarms", "not known", "no run with a truth that judges every alarm")
    hours = _total(judged, "judged_s") / 3600.0
    count = int(_total(judged, "false_alarms"))
    rate = f"{_rate(poisson_rate(count, hours))}; {runs.height - judged.height} runs left out"
    return Figure("false alarms", f"{count} in {number(hours)} h judged", rate)


@dataclass(frozen=True)
class LevelFigures:
    """What the failures come to against one service level's allowed T_D; `share`: within it, judged by a truth."""

    level: str
    allowed_s: float
    within: int
    exceeded: int
    unknown: int
    share: Estimate


def level_figures(runs: pl.DataFrame, safety: SafetyConfig) -> list[LevelFigures]:
    """Hazardous time of each failure against the allowed T_D of each service level (TVB eq. 7)."""
    failures = failures_of(runs)
    rows = []
    for level in safety.service_levels:
        allowed_s = safety.allowed_time_to_detect_s(level)
        whole, judged = (
            level_counts(part["hazardous_s"].to_list(), part["hazardous_may_s"].to_list(), allowed_s)
            for part in (failures, failures.filter("by_truth"))
        )
        share = clopper_pearson(judged[0], sum(judged))
        rows.append(LevelFigures(level, allowed_s, *whole, failures.height - sum(whole), share))
    return rows


def share_text(estimate: Estimate) -> str:
    return _share(estimate)


def _total(frame: pl.DataFrame, column: str) -> float:
    return float(frame[column].sum())


def _rate(rate: Estimate) -> str:
    if rate.value is None:
        return "rate not known"
    return f"{number(rate.value)} /h (95 %: {number(rate.low)} to {number(rate.high)})"


def _share(share: Estimate) -> str:
    if share.value is None or share.low is None or share.high is None:
        return "share not known"
    return f"{share.value:.1%} (95 %: {share.low:.1%} to {share.high:.1%})"


def _seconds(value: object) -> str:
    return f"{number(float(value))} s" if isinstance(value, int | float) else "not known"
