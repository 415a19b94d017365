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
from pipeline.campaign.outcome import RunOutcome
from pipeline.campaign.plan import Plan
from pipeline.campaign.tally import Tally, loss_line, outcome_line, summary_line
from pipeline.campaign.watch import Summary, Watch
from pipeline.figures.verdict import word_of
from pipeline.storage.address import is_url, join, redacted
from schemas.enums import RunStatus
from schemas.version import SOFTWARE

_LINE_EVERY_S = 5.0


class _Spoken:
    """Says on a stream, every few seconds, how far the campaign is."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._said_s = time.monotonic()
        self._tally = Tally(0)

    def begin(self, plan: Plan) -> None:
        self._tally = Tally(len(plan.jobs))

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        if time.monotonic() - self._said_s >= _LINE_EVERY_S:
            self._said_s = time.monotonic()
            self._say_progress(under_way)

    def end(self, summary: Summary) -> None:
        self._say_progress(())

    def _say_progress(self, under_way: Sequence[tuple[str, float]]) -> None:
        raise NotImplementedError

    def _print(self, text: str) -> None:
        """One line; a reader or a terminal that has gone is no reason to stop a campaign."""
        with contextlib.suppress(OSError):
            print(text, file=self._stream, flush=True)


class LineWatch(_Spoken):
    """Plain lines: each run that is not ok, and how far the campaign is."""

    def finished(self, outcome: RunOutcome) -> None:
        self._tally.add(outcome)
        if outcome.status is not RunStatus.OK:
            self._print(outcome_line(outcome))

    def lost(self, run_id: str, attempt: int) -> None:
        self._print(loss_line(run_id, attempt))

    def noted(self, text: str) -> None:
        self._print(text)

    def _say_progress(self, under_way: Sequence[tuple[str, float]]) -> None:
        self._print(self._tally.line(under_way))


class JsonWatch(_Spoken):
    """JSON lines for programs: `run` as each run ends, `lost` with each worker that dies, `progress` in between."""

    def begin(self, plan: Plan) -> None:
        super().begin(plan)
        self._say_progress(())

    def finished(self, outcome: RunOutcome) -> None:
        self._tally.add(outcome)
        names = ("run_id", "status", "error", "skipped", "attempts", "hazards", "missed_detections")
        told = {name: getattr(outcome, name) for name in names}
        self._say(
            "run",
            {
                "verdict": word_of(outcome.verdict),
                **told,
                "seconds": round(outcome.seconds, 3),
                **self._tally.figures(),
            },
        )

    def lost(self, run_id: str, attempt: int) -> None:
        self._say("lost", {"run_id": run_id, "attempt": attempt})

    def noted(self, text: str) -> None:
        self._say("note", {"text": text})

    def _say_progress(self, under_way: Sequence[tuple[str, float]]) -> None:
        self._say("progress", self._tally.figures(under_way))

    def _say(self, event: str, told: Mapping[str, object]) -> None:
        self._print(json.dumps({"event": event, **told}))


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
        self.noted(loss_line(run_id, attempt))

    def noted(self, text: str) -> None:
        self._progress.console.print(text, markup=False, highlight=False)

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
        self.noted(loss_line(run_id, attempt))

    def noted(self, text: str) -> None:
        self._write(text)

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


def watches(quiet: bool, as_json: bool = False) -> list[Watch]:
    """What shows a campaign on this terminal or pipe."""
    if quiet:
        return [LogWatch()]
    if as_json:
        return [JsonWatch(), LogWatch()]
    return [BarWatch() if sys.stderr.isatty() else LineWatch(), LogWatch()]
