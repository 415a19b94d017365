"""Campaigns as people follow them: a bar on a terminal, lines in a pipe, a log file beside the results."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from pipeline import storage
from pipeline.campaign.loop import Summary, Watch
from pipeline.campaign.outcome import RunOutcome
from pipeline.campaign.plan import Plan
from pipeline.ingest.files import is_url, join
from pipeline.present import duration_text
from pipeline.remote import redacted
from schemas.enums import RunStatus
from schemas.version import SOFTWARE

_LINE_EVERY_S = 5.0
_SLOW_SHOWN = 2


class Tally:
    """Counts that every way of showing progress needs."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.done = self.failed = self.skipped = 0
        self.since_s = time.monotonic()

    def add(self, outcome: RunOutcome) -> None:
        self.done += 1
        self.failed += outcome.status is not RunStatus.OK
        self.skipped += outcome.skipped

    def line(self, under_way: Sequence[tuple[str, float]] = ()) -> str:
        """One line: done, failed, rate, time left, slow runs."""
        elapsed = time.monotonic() - self.since_s
        rate = (self.done - self.skipped) / elapsed if elapsed > 0 else 0.0
        parts = [f"{self.done}/{self.total} runs", f"{self.failed} failed or partial"]
        if self.skipped:
            parts.append(f"{self.skipped} skipped")
        if rate > 0:
            left = (self.total - self.done) / rate
            parts += [f"{rate:.2f} runs/s", f"{duration_text(left)} left"]
        slow = sorted(under_way, key=lambda item: -item[1])[:_SLOW_SHOWN]
        if slow:
            parts.append("longest now: " + ", ".join(f"{run} ({duration_text(age)})" for run, age in slow))
        return ", ".join(parts)


def outcome_line(outcome: RunOutcome) -> str:
    """One run in one line."""
    how = "skipped, " if outcome.skipped else ""
    text = f"{outcome.run_id}: {how}{outcome.status.value}"
    if outcome.error:
        text += f": {outcome.error}"
    elif not outcome.skipped:
        text += f" in {duration_text(outcome.seconds)}"
    if outcome.attempts > 1:
        text += f" (attempt {outcome.attempts})"
    return text


def loss_line(run_id: str, attempt: int) -> str:
    """A lost worker in one line."""
    return f"{run_id}: its worker died at attempt {attempt}; tried again"


class LineWatch:
    """Plain lines: each run that is not ok, and every few seconds how far the campaign is."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._said_s = time.monotonic()
        self._tally = Tally(0)

    def begin(self, plan: Plan) -> None:
        self._tally = Tally(len(plan.jobs))

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        if time.monotonic() - self._said_s >= _LINE_EVERY_S:
            self._said_s = time.monotonic()
            self._say(self._tally.line(under_way))

    def finished(self, outcome: RunOutcome) -> None:
        self._tally.add(outcome)
        if outcome.status is not RunStatus.OK:
            self._say(outcome_line(outcome))

    def lost(self, run_id: str, attempt: int) -> None:
        self._say(loss_line(run_id, attempt))

    def end(self, summary: Summary) -> None:
        self._say(self._tally.line())

    def _say(self, text: str) -> None:
        print(text, file=self._stream, flush=True)


class BarWatch:
    """A progress bar on a terminal."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
        self._progress = Progress(*columns, console=self._console)
        self._tally = Tally(0)
        self._task = TaskID(0)

    def begin(self, plan: Plan) -> None:
        self._tally = Tally(len(plan.jobs))
        self._task = self._progress.add_task("", total=len(plan.jobs))
        self._progress.start()

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        text = self._tally.line(under_way).partition(", ")[2]
        self._progress.update(self._task, completed=self._tally.done, description=text)

    def finished(self, outcome: RunOutcome) -> None:
        self._tally.add(outcome)
        if outcome.status is not RunStatus.OK:
            self._progress.console.print(outcome_line(outcome), markup=False, highlight=False)

    def lost(self, run_id: str, attempt: int) -> None:
        self._progress.console.print(loss_line(run_id, attempt), markup=False, highlight=False)

    def end(self, summary: Summary) -> None:
        self.look(())
        self._progress.stop()


class LogWatch:
    """`OUT/replay.log`: every run with its time; an object store gets it when the campaign ends."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._place: str = ""

    def begin(self, plan: Plan) -> None:
        self._place = str(join(plan.out, "replay.log"))
        self._write(f"{SOFTWARE}: {len(plan.jobs)} runs")

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        return None

    def finished(self, outcome: RunOutcome) -> None:
        self._write(outcome_line(outcome))
        if outcome.trace:
            self._write(redacted(outcome.trace))

    def lost(self, run_id: str, attempt: int) -> None:
        self._write(loss_line(run_id, attempt))

    def end(self, summary: Summary) -> None:
        self._write(summary_line(summary))
        if is_url(self._place):
            storage.write_bytes(self._place, "".join(self._lines).encode())

    def _write(self, text: str) -> None:
        line = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {text}\n"
        if is_url(self._place):
            self._lines.append(line)
            return
        with storage.as_output_error(self._place), Path(self._place).open("a", encoding="utf-8") as log:
            log.write(line)


def summary_line(summary: Summary) -> str:
    """A campaign in one line."""
    counts = [f"{summary.count(status)} {status.value}" for status in RunStatus]
    text = f"{len(summary.outcomes)} of {summary.planned} runs: " + ", ".join(counts)
    if summary.skipped:
        text += f" ({summary.skipped} of them complete before)"
    return f"{text}; {duration_text(summary.seconds)}"


def watches(quiet: bool) -> list[Watch]:
    """What shows a campaign on this terminal or pipe."""
    if quiet:
        return [LogWatch()]
    return [BarWatch() if sys.stderr.isatty() else LineWatch(), LogWatch()]
