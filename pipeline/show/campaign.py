"""A campaign in words and rows: one run, all of them, what would mend them."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

import polars as pl

from pipeline.results.figures.head import word_of
from pipeline.results.outcome import CampaignSummary, RunOutcome
from pipeline.show.terminal import duration_text
from schemas.enums import RunStatus, RunVerdict
from schemas.errors import visible
from schemas.words import accepted_words, remedy_words, say, verdict_figures_words

_WORST_FIRST = {"unsafe": 0, "failed": 1, "unproven": 2, "safe": 3}


def outcome_line(outcome: RunOutcome) -> str:
    """One run in one line, its verdict first."""
    how = "skipped, " if outcome.skipped else ""
    word = word_of(outcome.verdict)
    status = outcome.status.value
    status_words = "" if outcome.status is RunStatus.OK or status == word else f", {status}"
    text = f"{outcome.run_id}: {how}{word}{status_words}"
    if outcome.error:
        text += f": {outcome.error}"
    elif not outcome.skipped:
        text += f" in {duration_text(outcome.seconds)}"
    if outcome.attempts > 1:
        text += f" (attempt {outcome.attempts})"
    return visible(text).replace("\n", r"\n")


def summary_line(summary: CampaignSummary) -> str:
    """A campaign in one line, its verdict first."""
    counts = [f"{summary.count(status)} {status.value}" for status in RunStatus]
    figures_words = f"; {verdict_figures_words(figures)}" if (figures := summary.verdict_figures()) else ""
    text = f"{summary.head}{figures_words}; {len(summary.outcomes)} of {summary.planned} runs: " + ", ".join(counts)
    if summary.count_skipped:
        text += f" ({summary.count_skipped} of them complete before)"
    return f"{text}; {duration_text(summary.seconds)}"


def ending_rows(summary: CampaignSummary) -> pl.DataFrame:
    """What a person reads when a campaign has ended, the worst run first: verdict, figures, why, faults."""
    ranked = sorted(summary.outcomes, key=lambda outcome: (_WORST_FIRST[word_of(outcome.verdict)], outcome.run_id))
    names = ("verdict", "run_id", "accepted", "available", "margin", "why", "faults")
    rows = [
        (
            word_of(outcome.verdict),
            outcome.run_id,
            *_outcome_figures(outcome),
            _why_words(outcome),
            _first_faults(outcome.faults),
        )
        for outcome in ranked
    ]
    return pl.DataFrame(rows, schema=dict.fromkeys(names, pl.String), orient="row")


def _outcome_figures(outcome: RunOutcome) -> tuple[str, str, str]:
    """Balises accepted of those on the path, availability, proof margin."""
    if outcome.verdict is None:
        return "-", "-", "-"
    accepted = "".join(accepted_words(vars(outcome)))
    available = say("verdicts", "not_known") if outcome.availability is None else f"{outcome.availability:.0%}"
    return accepted, available, "-" if outcome.proof_margin_m is None else f"{outcome.proof_margin_m:.1f} m"


def remedy_lines(summary: CampaignSummary, **places: str) -> list[str]:
    """How many runs each remedy would mend, and the command for the worst; what gains most time first.

    `places`: paths as the user named them.
    """
    ranked = sorted(summary.outcomes, key=lambda outcome: (_WORST_FIRST[word_of(outcome.verdict)], outcome.run_id))
    mended: dict[str, list[RunOutcome]] = {}
    won_s: dict[str, float] = defaultdict(float)
    for outcome in ranked:
        for remedy, gain in zip(outcome.remedies, outcome.remedies_gain, strict=True):
            mended.setdefault(remedy, []).append(outcome)
            won_s[remedy] += gain * (outcome.moving_s or 0.0)
    whole_s = sum(outcome.moving_s or 0.0 for outcome in ranked) or math.inf
    order = sorted(mended, key=lambda remedy: (-won_s[remedy], -len(mended[remedy])))
    return [
        f"{len(runs)} of {len(ranked)} runs: "
        + remedy_words(remedy, won_s[remedy] / whole_s, **places | {"run": runs[0].log})
        for remedy, runs in ((remedy, mended[remedy]) for remedy in order)
    ]


def _why_words(outcome: RunOutcome) -> str:
    """What is wrong with the run: why its verdict is no better, what cut it short, what its time was lost to."""
    why = "" if outcome.verdict is RunVerdict.SAFE else outcome.why
    cut = "" if outcome.status is RunStatus.OK else outcome.error or outcome.status.value
    status = f"partial: {cut}" if cut and outcome.status is RunStatus.PARTIAL else cut
    lost = f"lost to {outcome.lost}" if outcome.lost else ""
    return "; ".join(text for text in (why, status, lost) if text)


def _first_faults(faults: Sequence[str]) -> str:
    """The first two faults, and how many more there are."""
    more = [f"and {len(faults) - 2} more"] if len(faults) > 2 else []
    return "; ".join([*faults[:2], *more]) or "none"


def outcome_rows(summary: CampaignSummary) -> pl.DataFrame:
    """A campaign as a table: one row per run that was reached, its verdict first."""
    kinds: dict[str, type[pl.DataType] | pl.DataType] = {
        "verdict": pl.String,
        "run_id": pl.String,
        "status": pl.String,
        "hazards": pl.Int64,
        "missed_detections": pl.Int64,
        "seconds": pl.Float64,
        "skipped": pl.Boolean,
        "attempts": pl.Int64,
        "error": pl.String,
        "balises_found": pl.Int64,
        "balises_passed": pl.Int64,
        "balises_accepted": pl.Int64,
        "balises_on_path": pl.Int64,
        "availability": pl.Float64,
        "proof_margin_m": pl.Float64,
        "why": pl.String,
        "remedies": pl.List(pl.String),
        "faults": pl.List(pl.String),
    }
    rows = [
        (word_of(outcome.verdict), *(_as_list(getattr(outcome, name)) for name in list(kinds)[1:]))
        for outcome in summary.outcomes
    ]
    return pl.DataFrame(rows, schema=kinds, orient="row")


def _as_list(value: object) -> object:
    """A tuple as a list, anything else as it is."""
    return list(value) if isinstance(value, tuple) else value
