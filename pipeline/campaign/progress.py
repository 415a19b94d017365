"""Campaigns as people follow them: a bar on a terminal, lines in a pipe, a log file beside the results."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from pipeline import storage
from pipeline.campaign.loop import Summary, Watch
from pipeline.campaign.outcome import RunOutcome
from pipeline.campaign.plan import Plan
from pipeline.present import duration_text
from pipeline.storage.files import is_url, join
from pipeline.storage.object_store import redacted
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

    def line(self, under_way: Sequence[tuple[str, float]] = ()) -> str:
        """One line: done, failed, rate, time left, slow runs."""
        parts = [f"{self.done}/{self.total} runs", f"{self.failed} failed or partial"]
        if self.skipped:
            parts.append(f"{self.skipped} skipped")
        if self.rate_per_s is not None and self.left_s is not None:
            parts += [f"{self.rate_per_s:.2f} runs/s", f"{duration_text(self.left_s)} left"]
        if slow := slowest(under_way):
            parts.append("longest now: " + ", ".join(f"{run} ({duration_text(age_s)})" for run, age_s in slow))
        return ", ".join(parts)

    def figures(self, under_way: Sequence[tuple[str, float]] = ()) -> dict[str, object]:
        """The same for programs."""
        counts = {"done": self.done, "failed": self.failed, "skipped": self.skipped, "total": self.total}
        slow = [{"run_id": run, "seconds": round(age_s, 3)} for run, age_s in slowest(under_way)]
        times = {"rate_per_s": _rounded(self.rate_per_s), "left_s": _rounded(self.left_s)}
        return {**counts, **times, "slow": slow}


def slowest(under_way: Sequence[tuple[str, float]]) -> list[tuple[str, float]]:
    """The runs that have been under way for longest."""
    return sorted(under_way, key=lambda item: -item[1])[:_SLOW_SHOWN]


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


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


def say(text: str, stream: TextIO) -> None:
    """One line; a reader or a terminal that has gone is no reason to stop a campaign."""
    with contextlib.suppress(OSError):
        print(text, file=stream, flush=True)


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
        say(text, self._stream)


class JsonWatch:
    """JSON lines for programs: `run` as each run ends, `lost` with each worker that dies, `progress` in between."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._said_s = time.monotonic()
        self._tally = Tally(0)

    def begin(self, plan: Plan) -> None:
        self._tally = Tally(len(plan.jobs))
        self._say("progress", self._tally.figures())

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        if time.monotonic() - self._said_s >= _LINE_EVERY_S:
            self._said_s = time.monotonic()
            self._say("progress", self._tally.figures(under_way))

    def finished(self, outcome: RunOutcome) -> None:
        self._tally.add(outcome)
        names = ("run_id", "status", "error", "skipped", "attempts", "hazards", "missed_detections")
        told = {name: getattr(outcome, name) for name in names}
        self._say("run", {**told, "seconds": round(outcome.seconds, 3), **self._tally.figures()})

    def lost(self, run_id: str, attempt: int) -> None:
        self._say("lost", {"run_id": run_id, "attempt": attempt})

    def end(self, summary: Summary) -> None:
        self._say("progress", self._tally.figures())

    def _say(self, event: str, told: Mapping[str, object]) -> None:
        say(json.dumps({"event": event, **told}), self._stream)


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
        # The terminal may be closed.
        with contextlib.suppress(OSError):
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


def watches(quiet: bool, as_json: bool = False) -> list[Watch]:
    """What shows a campaign on this terminal or pipe."""
    if quiet:
        return [LogWatch()]
    if as_json:
        return [JsonWatch(), LogWatch()]
    return [BarWatch() if sys.stderr.isatty() else LineWatch(), LogWatch()]
