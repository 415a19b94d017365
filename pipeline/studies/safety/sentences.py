"""What the figures of a result do and do not show, in sentences for an assessor (`schemas/words.toml`, `[safety]`)."""

from __future__ import annotations

import polars as pl

from pipeline.results.figures.head import head_of, run_verdicts, verdict_figures
from pipeline.studies.reservations import failed_runs, reservation_sentences, several_settings
from schemas.enums import RunStatus, Verdict
from schemas.words import say, say_of, verdict_figures_words


def verdict_statement(runs: pl.DataFrame) -> str:
    """The verdict of the campaign with its counts and the figures next to it: the first words of what is said."""
    head = head_of(run_verdicts(runs).values())
    return (
        f"{head}."
        if head.verdict is None
        else say("safety", "verdict", head, verdict_figures_words(verdict_figures(runs)))
    )


def reservations(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """What keeps the figures from being those of traffic, and what they leave out."""
    number = runs["run_id"].n_unique()
    injected = runs.filter(pl.col("faults_injected").fill_null(value=False))["run_id"].n_unique()
    partial = runs.filter(pl.col("status") == RunStatus.PARTIAL)["run_id"].n_unique()
    return [
        *reservation_sentences("safety", {"injected": injected and (injected, number)}),
        *failed_runs(runs),
        *reservation_sentences("safety", {"partial": partial and (partial, number)}),
        *several_settings(runs, say("safety", "limits")),
        *_unjudged_sentences(runs, alarms),
    ]


def _unjudged_sentences(runs: pl.DataFrame, alarms: pl.DataFrame) -> list[str]:
    """Time and alarms of each solution that nothing could judge."""
    said = []
    done = runs.filter(pl.col("status") != RunStatus.FAILED).sort("solution")
    for (solution,), rows in done.group_by("solution", maintain_order=True):
        held_h, judged_h = (float(rows[name].sum()) / 3600.0 for name in ("held_s", "evidence_s"))
        time = (solution, held_h - judged_h, held_h, rows["evidence"].null_count(), rows.height)
        unknown = alarms.filter((pl.col("solution") == solution) & (pl.col("verdict") == Verdict.UNKNOWN))
        doubtful = (solution, unknown.height, unknown["run_id"].n_unique())
        # Less than a second is not worth saying.
        worth = held_h - judged_h >= 1.0 / 3600.0
        said += reservation_sentences(
            "safety", {"unchecked_time": worth and time, "unchecked_alarms": unknown.height and doubtful}
        )
    return said


def slow_receivers(levels: pl.DataFrame) -> list[str]:
    """Service levels whose allowed time is over before the next epoch can block a position (TVB section 5)."""
    slow = levels.filter(~pl.col("receiver_quick_enough"))
    counted = slow.group_by("solution", "service_level", "allowed_s", maintain_order=True).agg(
        runs=pl.col("run_id").n_unique(), needs_s=pl.col("receiver_needs_s").max()
    )
    return [say_of("safety", "slow_receiver", row) for row in counted.iter_rows(named=True)]


def level_statements(detection: pl.DataFrame) -> list[str]:
    """How many failures of each solution were in use no longer than each service level allows."""
    unknown = pl.col("failures") - pl.col("within") - pl.col("exceeded")
    failed = detection.filter(pl.col("failures") > 0).with_columns(unknown=unknown)
    said = []
    for (solution,), rows in failed.group_by("solution", maintain_order=True):
        levels = ", ".join(say_of("safety", "level", row) for row in rows.iter_rows(named=True))
        said.append(say("safety", "levels", solution, rows["failures"][0], levels))
    return said


def plain_statements(figures: pl.DataFrame) -> list[str]:
    """What the figures do and do not show, one paragraph per solution."""
    apart = figures.with_columns(
        unknown=pl.col("failures") - pl.col("failures_within_budget") - pl.col("failures_beyond_budget"),
        missed_besides=pl.col("missed") - pl.col("missed_judged"),
        unsafe_besides=pl.col("unsafe_accepted") - pl.col("unsafe_judged"),
    )
    paragraphs = []
    for row in apart.iter_rows(named=True):
        proved = row["hours_still_needed"] == 0.0
        said = {
            **dict.fromkeys(("failures", "missed", "accepted"), row),
            "not_blocked": row["share_p1"],
            "proved" if proved else "not_proved": row,
        }
        paragraphs.append(" ".join(reservation_sentences("safety", said)))
    return paragraphs
