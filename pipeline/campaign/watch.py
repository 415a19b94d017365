"""What a campaign tells of itself: to whoever watches while it goes on, and in the end; counted and in words."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from pipeline.campaign.outcome import RunOutcome
from pipeline.campaign.plan import Plan
from pipeline.show.terminal import duration_text
from pipeline.stages.run_row.verdict import CampaignHead, figures_beside, head_of, word_of
from schemas.enums import RunStatus, RunVerdict
from schemas.errors import visible
from schemas.words import beside_words, remedy_words

_BESIDE = {
    "balises_accepted": pl.Int64,
    "balises_on_path": pl.Int64,
    "availability": pl.Float64,
    "proof_margin_m": pl.Float64,
    "held_s": pl.Float64,
}
UnderWay = Sequence[tuple[str, float]]

_WORST_FIRST = {"unsafe": 0, "failed": 1, "unproven": 2, "safe": 3}


@dataclass(frozen=True)
class Summary:
    """A campaign in figures."""

    planned: int
    outcomes: tuple[RunOutcome, ...]
    seconds: float

    @property
    def head(self) -> CampaignHead:
        """The worst verdict of the runs that were reached, and their counts."""
        return head_of(outcome.verdict for outcome in self.outcomes)

    def beside(self) -> dict[str, Any]:
        """The figures beside the verdict over all runs that have one; nothing where none has."""
        rows = [{name: getattr(outcome, name) for name in _BESIDE} for outcome in self.outcomes if outcome.held_s]
        return dict(figures_beside(pl.DataFrame(rows, schema=_BESIDE))) if rows else {}

    def count(self, status: RunStatus) -> int:
        return sum(outcome.status == status for outcome in self.outcomes)

    @property
    def all_ok(self) -> bool:
        return self.count(RunStatus.OK) == self.planned

    @property
    def skipped(self) -> int:
        return sum(outcome.skipped for outcome in self.outcomes)

    @property
    def defects(self) -> int:
        return sum(outcome.defect for outcome in self.outcomes)

    @property
    def left(self) -> int:
        """Runs that were not reached."""
        return self.planned - len(self.outcomes)


class Watch:
    """Whoever wants to see a campaign go on: told of what somebody should see to, and of runs that are not ok."""

    def begin(self, plan: Plan) -> None:
        self.total = len(plan.jobs)
        self.done = self.failed = self.skipped = 0
        self.since_s = time.monotonic()

    def look(self, under_way: UnderWay) -> None:
        """Called several times a second with the runs under way and their age [s]."""

    def noted(self, text: str) -> None:
        """Something that somebody should see to."""
        raise NotImplementedError

    def lost(self, run_id: str, attempt: int) -> None:
        """The worker died that was at this attempt of a run; it is tried again."""
        self.noted(visible(f"{run_id}: its worker died at attempt {attempt}; tried again"))

    def finished(self, outcome: RunOutcome) -> None:
        self.done += 1
        self.failed += outcome.status is not RunStatus.OK
        self.skipped += outcome.skipped
        self.told(outcome)

    def told(self, outcome: RunOutcome) -> None:
        """A run that has ended, after it was counted."""
        if outcome.status is not RunStatus.OK:
            self.noted(outcome_line(outcome))

    def end(self, summary: Summary) -> None: ...

    @property
    def rate_per_s(self) -> float | None:
        """Runs replayed per second; none before the first."""
        elapsed_s, replayed = time.monotonic() - self.since_s, self.done - self.skipped
        return replayed / elapsed_s if replayed and elapsed_s > 0 else None

    @property
    def left_s(self) -> float | None:
        """Seconds until the end at this rate."""
        rate_per_s = self.rate_per_s
        return None if rate_per_s is None else (self.total - self.done) / rate_per_s

    def line(self, under_way: UnderWay = ()) -> str:
        """One line: done, failed, rate, time left, slow runs."""
        parts = [f"{self.done}/{self.total} runs", f"{self.failed} failed or partial"]
        if self.skipped:
            parts.append(f"{self.skipped} skipped")
        if self.rate_per_s is not None and self.left_s is not None:
            parts += [f"{self.rate_per_s:.2f} runs/s", f"{duration_text(self.left_s)} left"]
        if slow := slowest(under_way):
            parts.append("longest now: " + ", ".join(f"{visible(run)} ({duration_text(age_s)})" for run, age_s in slow))
        return ", ".join(parts)

    def figures(self, under_way: UnderWay = ()) -> dict[str, object]:
        """The same for programs."""
        counts = {"done": self.done, "failed": self.failed, "skipped": self.skipped, "total": self.total}
        slow = [{"run_id": run, "seconds": round(age_s, 3)} for run, age_s in slowest(under_way)]
        times = {"rate_per_s": _rounded(self.rate_per_s), "left_s": _rounded(self.left_s)}
        return {**counts, **times, "slow": slow}


def slowest(under_way: UnderWay) -> list[tuple[str, float]]:
    """The two runs that have been under way for longest."""
    return sorted(under_way, key=lambda item: -item[1])[:2]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def outcome_line(outcome: RunOutcome) -> str:
    """One run in one line, its verdict first."""
    how = "skipped, " if outcome.skipped else ""
    word, status = word_of(outcome.verdict), outcome.status.value
    beside = "" if outcome.status is RunStatus.OK or status == word else f", {status}"
    text = f"{outcome.run_id}: {how}{word}{beside}"
    if outcome.error:
        text += f": {outcome.error}"
    elif not outcome.skipped:
        text += f" in {duration_text(outcome.seconds)}"
    if outcome.attempts > 1:
        text += f" (attempt {outcome.attempts})"
    return visible(text).replace("\n", r"\n")


def summary_line(summary: Summary) -> str:
    """A campaign in one line, its verdict first."""
    counts = [f"{summary.count(status)} {status.value}" for status in RunStatus]
    beside = f"; {beside_words(figures)}" if (figures := summary.beside()) else ""
    text = f"{summary.head}{beside}; {len(summary.outcomes)} of {summary.planned} runs: " + ", ".join(counts)
    if summary.skipped:
        text += f" ({summary.skipped} of them complete before)"
    return f"{text}; {duration_text(summary.seconds)}"


def ending_rows(summary: Summary) -> pl.DataFrame:
    """What a person reads when a campaign has ended, the worst run first: verdict, figures beside it, why, faults."""
    ranked = sorted(summary.outcomes, key=lambda outcome: (_WORST_FIRST[word_of(outcome.verdict)], outcome.run_id))
    names = ("verdict", "run_id", "accepted", "available", "margin", "why", "faults")
    rows = [
        (word_of(outcome.verdict), outcome.run_id, *_beside(outcome), _reason(outcome), _few(outcome.faults))
        for outcome in ranked
    ]
    return pl.DataFrame(rows, schema=dict.fromkeys(names, pl.String), orient="row")


def _beside(outcome: RunOutcome) -> tuple[str, str, str]:
    """Balises accepted of those on the path, availability, proof margin."""
    if outcome.verdict is None:
        return "-", "-", "-"
    accepted = f"{outcome.balises_accepted} of {outcome.balises_on_path}"
    available = "-" if outcome.availability is None else f"{outcome.availability:.0%}"
    return accepted, available, "-" if outcome.proof_margin_m is None else f"{outcome.proof_margin_m:.1f} m"


def remedy_lines(summary: Summary, **places: str) -> list[str]:
    """Per remedy how many runs it would mend, and the command for the worst of them; the most frequent first.

    `places`: paths as the user named them.
    """
    ranked = sorted(summary.outcomes, key=lambda outcome: (_WORST_FIRST[word_of(outcome.verdict)], outcome.run_id))
    mended: dict[str, list[RunOutcome]] = {}
    for outcome in ranked:
        for remedy in outcome.remedies:
            mended.setdefault(remedy, []).append(outcome)
    order = sorted(mended, key=lambda remedy: -len(mended[remedy]))
    return [
        f"{len(runs)} of {len(ranked)} runs: {remedy_words(remedy, **places | {'run': runs[0].log})}"
        for remedy, runs in ((remedy, mended[remedy]) for remedy in order)
    ]


def _reason(outcome: RunOutcome) -> str:
    """What is wrong with the run: why its verdict is no better, what cut it short, what its time was lost to."""
    why = "" if outcome.verdict is RunVerdict.SAFE else outcome.why
    cut = "" if outcome.status is RunStatus.OK else outcome.error or outcome.status.value
    status = f"partial: {cut}" if cut and outcome.status is RunStatus.PARTIAL else cut
    lost = f"lost to {outcome.lost}" if outcome.lost else ""
    return "; ".join(text for text in (why, status, lost) if text)


def _few(faults: Sequence[str]) -> str:
    more = [f"and {len(faults) - 2} more"] if len(faults) > 2 else []
    return "; ".join([*faults[:2], *more]) or "none"


def outcome_rows(summary: Summary) -> pl.DataFrame:
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
        "balises_accepted": pl.Int64,
        "balises_on_path": pl.Int64,
        "availability": pl.Float64,
        "proof_margin_m": pl.Float64,
        "why": pl.String,
        "remedies": pl.List(pl.String),
        "faults": pl.List(pl.String),
    }
    rows = [
        (word_of(outcome.verdict), *(_listed(getattr(outcome, name)) for name in list(kinds)[1:]))
        for outcome in summary.outcomes
    ]
    return pl.DataFrame(rows, schema=kinds, orient="row")


def _listed(value: object) -> object:
    return list(value) if isinstance(value, tuple) else value
