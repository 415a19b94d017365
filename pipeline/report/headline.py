"""The first sentence of a page: the verdict, what was worst, and whether a monitor saw it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import polars as pl

from pipeline.figures.hazard_words import off_words, seen_words
from pipeline.figures.verdict import head_of, run_verdicts, verdict_reasons, word_of, worst_verdict
from pipeline.report.columns import Row
from pipeline.report.markup import number
from pipeline.report.words import plural
from schemas.config import Configuration
from schemas.enums import BaliseKind, Hazard, Judgement, PassageStatus, RunVerdict, Timing

_ALL_SAFE = "every acceptance right, every position failure within the time allowed, in all runs"


@dataclass(frozen=True)
class Headline:
    """`word` is the verdict, `worst` the sentence behind it, `reasons` all that speaks for it."""

    word: str
    worst: str
    reasons: str


def wrong_acceptances(passages: pl.DataFrame) -> pl.DataFrame:
    """Virtual balises that were accepted at a wrong place, the largest error first."""
    wrong = (pl.col("judgement") == Judgement.WRONG.value) & (pl.col("status") == PassageStatus.ACCEPTED.value)
    found = passages.filter(wrong & (pl.col("kind") == BaliseKind.VIRTUAL.value))
    return found.sort(pl.col("location_error_m").abs(), descending=True, nulls_last=True, maintain_order=True)


def run_headline(rows: Iterable[Row], passages: pl.DataFrame, hazards: pl.DataFrame, config: Configuration) -> Headline:
    """Of one run with all its solutions, headed by the worst of them."""
    listed = list(rows)
    verdict = worst_verdict(row["verdict"] for row in listed)
    heading = next((row for row in listed if row["verdict"] == verdict), listed[0])
    limit = config.hazards.unknown_share_limit
    worst = _worst(heading, passages, hazards, limit) if verdict is not None else heading["error"] or "the run failed"
    named = len(listed) > 1
    if named:
        return Headline(
            word_of(verdict), f"{heading['solution']}: {worst}", " ".join(_told(row, limit) for row in listed)
        )
    told = f"{verdict_reasons(heading, limit)}." if verdict == RunVerdict.UNSAFE else ""
    return Headline(word_of(verdict), worst, told)


def _told(row: Row, limit: float) -> str:
    why = "" if row["verdict"] is None else f", {verdict_reasons(row, limit)}"
    return f"{row['solution']}: {word_of(row['verdict'])}{why}."


def _worst(run: Row, passages: pl.DataFrame, hazards: pl.DataFrame, limit: float) -> str:
    """What made the verdict, in the fewest words that name it."""
    own = pl.col("solution") == run["solution"]
    wrong = wrong_acceptances(passages.filter(own))
    if wrong.height:
        return _wrong_acceptance(wrong, hazards.filter(own))
    if run["verdict"] == RunVerdict.UNSAFE and run["hazardous_max_s"] is not None:
        return f"a wrong position was in use for {number(run['hazardous_max_s'])} s, longer than allowed"
    return verdict_reasons(run, limit)


def _wrong_acceptance(wrong: pl.DataFrame, hazards: pl.DataFrame) -> str:
    first = wrong.row(0, named=True)
    hazard = hazards.filter(pl.col("hazard_id") == first["hazard_id"])
    others = wrong.height - 1
    more = f" ({plural(others, 'more wrong acceptance')})" if others else ""
    found = hazard.row(0, named=True) if hazard.height else None
    seen = "" if found is None else f", {seen_words(found)}"
    return f"{first['balise_id']} accepted {_where(first['location_error_m'], found)}{more}{seen}"


def _where(error_m: float | None, hazard: Row | None) -> str:
    if hazard is not None and hazard["hazard"] == Hazard.VB_WRONG_TRACK:
        return "on the wrong track"
    if error_m is None:
        return "at a wrong place"
    return off_words(error_m, Timing.EARLY if error_m > 0 else Timing.LATE)


def campaign_headline(
    runs: pl.DataFrame, passages: pl.DataFrame, hazards: pl.DataFrame, config: Configuration
) -> tuple[Headline, str | None]:
    """Of all runs, and the run that it names; frames with `run_id`."""
    head = head_of(run_verdicts(runs).values())
    total = sum(head.counts().values())
    counts = ", ".join(f"{count} {name}" for name, count in head.counts().items() if count)
    said = f"{plural(total, 'run')}: {counts}."
    if head.verdict is None:
        return Headline(head.word, "no run could be replayed", said), None
    if head.verdict == RunVerdict.SAFE:
        return Headline(head.word, _ALL_SAFE, said), None
    rows = runs.filter(pl.col("verdict") == head.verdict.value)
    order = ("unsafe_accepted", "hazardous_max_s", "unproven_accepted", "share_unknown")
    worst = rows.sort(*order, "run_id", descending=[True] * len(order) + [False], nulls_last=True).head(1)
    if worst.is_empty():
        return Headline(head.word, f"{plural(head.failed, 'run')} failed, the others are safe", said), None
    row = worst.row(0, named=True)
    own = pl.col("run_id") == row["run_id"]
    reason = _worst(row, passages.filter(own), hazards.filter(own), config.hazards.unknown_share_limit)
    return Headline(head.word, f"{reason} (run {row['run_id']})", said), row["run_id"]
