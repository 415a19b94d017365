"""What the figures of a result do and do not show, in sentences for an assessor."""

from __future__ import annotations

from typing import Any

import polars as pl

from pipeline.results.figures.head import figures_beside, head_of, run_verdicts
from pipeline.studies.reservations import failed_runs, several_settings
from schemas.enums import RunStatus, Verdict
from schemas.words import beside_words

Row = dict[str, object]


def verdict_statement(runs: pl.DataFrame) -> str:
    """The verdict of the campaign with its counts and the figures beside it: the first words of what is said."""
    head = head_of(run_verdicts(runs).values())
    return f"{head}." if head.verdict is None else f"{head}; {beside_words(figures_beside(runs))}."


def reservations(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """What keeps the figures from being those of traffic, and what they leave out."""
    injected = runs.filter(pl.col("faults_injected").fill_null(value=False))["run_id"].n_unique()
    number = runs["run_id"].n_unique()
    sentences = failed_runs(runs)
    if injected:
        sentences.insert(
            0,
            f"Faults were injected into {injected} of {number} runs: rates of hazards, misses and outages per hour are "
            "those of the trial, not of traffic.",
        )
    partial = runs.filter(pl.col("status") == RunStatus.PARTIAL)["run_id"].n_unique()
    if partial:
        sentences.append(f"{partial} of {number} runs are partial: only what was read of them counts.")
    limits = ": each verdict is by its own limits; those shown are the last ones."
    return [*sentences, *several_settings(runs, limits), *_unjudged(runs, alarms)]


def _unjudged(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """Per solution: the time and the alarms that nothing could judge."""
    sentences = []
    done = runs.filter(pl.col("status") != RunStatus.FAILED).sort("solution")
    for (solution,), rows in done.group_by("solution", maintain_order=True):
        held_s, seen_s = (float(rows[name].sum()) for name in ("held_s", "evidence_s"))
        if held_s - seen_s >= 1.0:  # less is not worth saying
            without = rows["evidence"].null_count()
            sentences.append(
                f"{solution}: in {(held_s - seen_s) / 3600.0:.3g} of {held_s / 3600.0:.3g} h the position could not be"
                f" checked ({without} of {rows.height} runs have no evidence at all). No rate counts this time."
            )
        open_cases = alarms.filter((pl.col("solution") == solution) & (pl.col("verdict") == Verdict.UNKNOWN))
        if open_cases.height:
            sentences.append(
                f"{solution}: {open_cases.height} alarms in {open_cases['run_id'].n_unique()} runs could not be"
                " checked. The rate of false alarms leaves these runs out."
            )
    return sentences


def slow_receivers(levels: pl.DataFrame) -> list[str]:
    """Service levels whose allowed time is over before the next epoch can block a position (TVB section 5)."""
    slow = levels.filter(~pl.col("receiver_quick_enough"))
    return [
        f"{solution}: the receiver is too slow for {level} in {runs} runs: one period and the reaction take up to "
        f"{needed_s:.4g} s, {allowed_s:.4g} s are allowed."
        for solution, level, allowed_s, runs, needed_s in slow.group_by(
            "solution", "service_level", "allowed_s", maintain_order=True
        )
        .agg(pl.col("run_id").n_unique(), pl.col("receiver_needs_s").max())
        .iter_rows()
    ]


def level_statements(detection: pl.DataFrame) -> list[str]:
    """Per solution: how many failures were in use no longer than each service level allows."""
    sentences = []
    for (solution,), rows in detection.filter(pl.col("failures") > 0).group_by("solution", maintain_order=True):
        levels = [_level(row) for row in rows.iter_rows(named=True)]
        sentences.append(f"{solution}: of {rows['failures'][0]} position failures in use " + ", ".join(levels) + ".")
    return sentences


def _level(row: dict[str, Any]) -> str:
    unknown = row["failures"] - row["within"] - row["exceeded"]
    beside = f" and {unknown} unknown" if unknown else ""
    level = f"{row['allowed_s']:.4g} s ({row['service_level']}{_within_bounds(row)})"
    return f"{row['within']} in time{beside} for {level}"


def _within_bounds(row: dict[str, Any]) -> str:
    """The bounds of the share of failures that a truth judged; nothing without any."""
    if row["within_share"] is None:
        return ""
    of = "" if row["failures_judged"] == row["failures"] else f" of the {row['failures_judged']} judged by a truth"
    return f"; 95 %{of}: {row['within_share_low']:.1%} to {row['within_share_high']:.1%}"


def plain_statements(figures: pl.DataFrame) -> list[str]:
    """What the figures do and do not show, one sentence or two per solution."""
    return [_statement(row) for row in figures.iter_rows(named=True)]


def _statement(row: dict[str, Any]) -> str:
    claim = f"THR_VB of {row['thr_vb_per_h']:.2e}/h at 95 %"
    head = " ".join([_failures(row), _missed(row), _acceptances(row)])
    if row["share_p1"]:
        head += f" Position wrong and not blocked: {row['share_p1']:.3%} of the time in runs with a truth."
    if row["hours_still_needed"] == 0.0:
        return f"{head} This proves a {claim} by counting."
    return (
        f"{head} Fault-free hours still needed to prove a {claim} by counting: {row['hours_still_needed']:.3g} h of"
        f" {row['hours_needed']:.3g} h. No trial reaches that: the claim has to rest on the time to detect."
    )


def _failures(row: dict[str, Any]) -> str:
    within = row["failures_within_budget"]
    beyond = row["failures_beyond_budget"]
    unknown = row["failures"] - within - beyond
    beside = f", {unknown} unknown" if unknown else ""
    return (
        f"{row['solution']}: {row['failures']} position failures in use, at a virtual balise or not: {within} in time,"
        f" {beyond} too late{beside}. Hours judged: {row['hours_with_evidence']:.6g}, of these"
        f" {row['hours_with_truth']:.6g} by a truth (reference or balise reads)."
    )


def _missed(row: dict[str, Any]) -> str:
    known = row["missed_known"]
    missed = row["missed_judged"]
    sentence = f"No monitor found {missed} of {known} faults with a failure that a truth judged"
    if row["missed"] > missed:
        sentence += f"; {row['missed'] - missed} more are known by the odometer alone, and shares leave them out"
    return f"{sentence}."


def _acceptances(row: dict[str, Any]) -> str:
    judged = row["accepted_judged"]
    unsafe = row["unsafe_judged"]
    seen = row["unsafe_accepted"]
    sentence = f"Of {judged} accepted virtual balises judged by a truth {unsafe} were accepted despite a wrong position"
    if seen > unsafe:
        sentence += f", and {seen - unsafe} more by the odometer alone"
    if row["unproven_accepted"]:
        sentence += f"; {row['unproven_accepted']} accepted ones could not be checked"
    return f"{sentence}."
