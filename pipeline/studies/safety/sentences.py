"""What the figures of a result do and do not show, in sentences for an assessor (`schemas/words.toml`, `[safety]`)."""

from __future__ import annotations

from typing import Any

import polars as pl

from pipeline.results.figures.head import figures_beside, head_of, run_verdicts
from pipeline.studies.reservations import failed_runs, sentences, several_settings
from schemas.enums import RunStatus, Verdict
from schemas.words import beside_words, say

Row = dict[str, Any]


def verdict_statement(runs: pl.DataFrame) -> str:
    """The verdict of the campaign with its counts and the figures beside it: the first words of what is said."""
    head = head_of(run_verdicts(runs).values())
    return f"{head}." if head.verdict is None else say("safety", "verdict", head, beside_words(figures_beside(runs)))


def reservations(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """What keeps the figures from being those of traffic, and what they leave out."""
    number = runs["run_id"].n_unique()
    injected = runs.filter(pl.col("faults_injected").fill_null(value=False))["run_id"].n_unique()
    partial = runs.filter(pl.col("status") == RunStatus.PARTIAL)["run_id"].n_unique()
    return [
        *sentences("safety", {"injected": (injected, number) if injected else ()}),
        *failed_runs(runs),
        *sentences("safety", {"partial": (partial, number) if partial else ()}),
        *several_settings(runs, say("safety", "limits")),
        *_unjudged(runs, alarms),
    ]


def _unjudged(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """Per solution: the time and the alarms that nothing could judge."""
    said = []
    done = runs.filter(pl.col("status") != RunStatus.FAILED).sort("solution")
    for (solution,), rows in done.group_by("solution", maintain_order=True):
        held_h, seen_h = (float(rows[name].sum()) / 3600.0 for name in ("held_s", "evidence_s"))
        if held_h - seen_h >= 1.0 / 3600.0:  # less is not worth saying
            runs_blind = rows["evidence"].null_count()
            said.append(say("safety", "unchecked_time", solution, held_h - seen_h, held_h, runs_blind, rows.height))
        unknown = alarms.filter((pl.col("solution") == solution) & (pl.col("verdict") == Verdict.UNKNOWN))
        if unknown.height:
            said.append(say("safety", "unchecked_alarms", solution, unknown.height, unknown["run_id"].n_unique()))
    return said


def slow_receivers(levels: pl.DataFrame) -> list[str]:
    """Service levels whose allowed time is over before the next epoch can block a position (TVB section 5)."""
    slow = levels.filter(~pl.col("receiver_quick_enough"))
    counted = slow.group_by("solution", "service_level", "allowed_s", maintain_order=True).agg(
        pl.col("run_id").n_unique(), pl.col("receiver_needs_s").max()
    )
    return [
        say("safety", "slow_receiver", solution, level, runs, needed_s, allowed_s)
        for solution, level, allowed_s, runs, needed_s in counted.iter_rows()
    ]


def level_statements(detection: pl.DataFrame) -> list[str]:
    """Per solution: how many failures were in use no longer than each service level allows."""
    failed = detection.filter(pl.col("failures") > 0).group_by("solution", maintain_order=True)
    return [
        say("safety", "levels", solution, rows["failures"][0], ", ".join(map(_level, rows.iter_rows(named=True))))
        for (solution,), rows in failed
    ]


def _level(row: Row) -> str:
    unknown = row["failures"] - row["within"] - row["exceeded"]
    beside = say("safety", "unknown_besides", unknown) if unknown else ""
    return say("safety", "level", row["within"], beside, row["allowed_s"], row["service_level"], _within_bounds(row))


def _within_bounds(row: Row) -> str:
    """The bounds of the share of failures that a truth judged; nothing without any."""
    if row["within_share"] is None:
        return ""
    judged = row["failures_judged"]
    of = "" if judged == row["failures"] else say("safety", "judged_by_truth", judged)
    return say("safety", "share_in_time", of, row["within_share_low"], row["within_share_high"])


def plain_statements(figures: pl.DataFrame) -> list[str]:
    """What the figures do and do not show, one paragraph per solution."""
    return [" ".join(sentences("safety", _statement(row))) for row in figures.iter_rows(named=True)]


def _statement(row: Row) -> dict[str, object]:
    """What is said of one solution, in this order."""
    proved = row["hours_still_needed"] == 0.0
    needed = (row["thr_vb_per_h"], row["hours_still_needed"], row["hours_needed"])
    return {
        "failures": _failures(row),
        "missed": _missed(row),
        "accepted": _accepted(row),
        "not_blocked": row["share_p1"],
        "proved": row["thr_vb_per_h"] if proved else (),
        "not_proved": () if proved else needed,
    }


def _failures(row: Row) -> tuple[object, ...]:
    within = row["failures_within_budget"]
    beyond = row["failures_beyond_budget"]
    unknown = row["failures"] - within - beyond
    beside = say("safety", "unknown", unknown) if unknown else ""
    hours = (row["hours_with_evidence"], row["hours_with_truth"])
    return (row["solution"], row["failures"], within, beyond, beside, *hours)


def _missed(row: Row) -> tuple[object, ...]:
    more = row["missed"] - row["missed_judged"]
    beside = say("safety", "missed_by_odometer", more) if more > 0 else ""
    return row["missed_judged"], row["missed_known"], beside


def _accepted(row: Row) -> tuple[object, ...]:
    more = row["unsafe_accepted"] - row["unsafe_judged"]
    beside = say("safety", "accepted_by_odometer", more) if more > 0 else ""
    unchecked = say("safety", "accepted_unchecked", row["unproven_accepted"]) if row["unproven_accepted"] else ""
    return row["accepted_judged"], row["unsafe_judged"], beside, unchecked
