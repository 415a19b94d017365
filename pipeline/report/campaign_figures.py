"""Headline figures of a campaign per solution, each with its exact bounds."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from pipeline.figures.bounds import Estimate, clopper_pearson, hours_still_needed, poisson_rate, poisson_rate_upper
from pipeline.figures.campaign_tables import with_judgement
from pipeline.figures.run_figures import is_passage
from pipeline.hazards.independent import independent_episodes
from pipeline.report.markup import UNKNOWN, number
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
    failure_limit_m: float,
) -> list[Figure]:
    """Figures of one solution; every table holds that solution's rows of all runs. `failed`: runs that could not be
    replayed with it.

    Rates count what the campaign contains, injected faults included.
    """
    runs = runs.filter(pl.col("status") != RunStatus.FAILED)
    return [
        *_extent(runs, failed),
        *_hazard_figures(runs, hazards, safety),
        *_balise_figures(with_judgement(passages, runs), failure_limit_m),
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


def _hazard_figures(runs: pl.DataFrame, hazards: pl.DataFrame, safety: SafetyConfig) -> list[Figure]:
    """Rates count faults, not rows, over the hours in which there was evidence to see them by; what substantiates a
    THR are hours with a truth alone (reference or balises).
    """
    seen = _total(runs.filter(pl.col("evidence").is_not_null()), "evidence_s") / 3600.0
    hours = _total(runs.filter(pl.col("evidence").is_in(TRUTH)), "evidence_s") / 3600.0
    faults = independent_episodes(hazards)
    failures = faults.filter(pl.col("failed"))
    missed = failures.filter(pl.col("missed")).height
    judged = failures.filter(pl.col("with_truth"))
    share = clopper_pearson(judged.filter(pl.col("missed")).height, judged.height)
    upper = poisson_rate_upper(missed, hours)
    needed = hours_still_needed(safety.thr_vb_per_h, missed, hours)
    claim = "" if upper is None else f"; one-sided 95 %: below {number(upper)} /h"
    return [
        Figure("hours with evidence", f"{number(seen)} h", f"{number(hours)} h of these by reference or balises"),
        Figure(
            "faults that led to hazards",
            f"{faults.height} in {hazards.height} rows",
            _rate(poisson_rate(faults.height, seen)),
        ),
        Figure(
            "missed detections",
            f"{missed} of {failures.height} with a failure",
            f"of the {judged.height} judged by a truth {_share(share)}; against the hours by reference or balises"
            f" {_rate(poisson_rate(missed, hours))}{claim}",
        ),
        Figure(
            "to substantiate the THR of a VB",
            f"{needed:.3g} h more",
            f"by reference or balises, without a further missed detection, for {safety.thr_vb_per_h:g} /h",
        ),
        Figure(
            "longest time to detect",
            _seconds(hazards["time_to_detect_s"].max()),
            f"of the {hazards['detected'].sum()} hazards detected; {(~hazards['detected']).sum()} were not",
        ),
        Figure(
            "longest hazardous time",
            _seconds(failures["hazardous_s"].max()),
            f"from failure to negation; {failures['hazardous_s'].null_count()} failures were never negated",
        ),
    ]


def _balise_figures(passages: pl.DataFrame, failure_limit_m: float) -> list[Figure]:
    virtual = passages.filter(pl.col("kind") == BaliseKind.VIRTUAL)
    accepted = virtual.filter(pl.col("status") == PassageStatus.ACCEPTED)
    passages_known = virtual.filter(is_passage())
    through = passages_known.filter(pl.col("status") == PassageStatus.ACCEPTED)
    judged = accepted.filter(pl.col("judged"))
    seen = accepted.filter(pl.col("location_error_m").abs() > failure_limit_m).height
    unsafe = judged.filter(pl.col("location_error_m").abs() > failure_limit_m).height
    return [
        Figure(
            "VBs accepted",
            f"{through.height} of {passages_known.height} passages",
            _share(clopper_pearson(through.height, passages_known.height)),
        ),
        Figure(
            "accepted beyond the failure limit",
            f"{unsafe} of {judged.height} judged by a truth",
            f"{_share(clopper_pearson(unsafe, judged.height))}; {accepted.height - judged.height} more not judged by"
            f" one, {seen - unsafe} of these beyond it by the odometer",
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
    """What the hazards with a failure come to against one service level's allowed T_D."""

    level: str
    allowed_s: float
    within: int
    late: int
    never: int
    share: Estimate


def level_figures(hazards: pl.DataFrame, safety: SafetyConfig) -> list[LevelFigures]:
    """Hazardous time of each fault with a failure against the allowed T_D of each service level (TVB eq. 7)."""
    failures = independent_episodes(hazards).filter(pl.col("failed"))
    negated = failures.filter(pl.col("hazardous_s").is_not_null())
    rows = []
    for level in safety.service_levels:
        allowed_s = safety.allowed_time_to_detect_s(level)
        within = negated.filter(pl.col("hazardous_s") <= allowed_s).height
        never = failures.height - negated.height
        judged = failures.filter(pl.col("with_truth"))
        share = clopper_pearson(judged.filter(pl.col("hazardous_s") <= allowed_s).height, judged.height)
        rows.append(LevelFigures(level, allowed_s, within, negated.height - within, never, share))
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
