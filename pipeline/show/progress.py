"""Campaigns as people follow them: a bar on a terminal, lines in a pipe, a log beside the results; and their end."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

from pipeline import storage
from pipeline.results.figures.head import word_of
from pipeline.results.outcome import CampaignSummary, RunOutcome, UnderWay
from pipeline.show.campaign import ending_rows, outcome_line, outcome_rows, remedy_lines, summary_line
from pipeline.show.terminal import duration_text, show_table, show_text, to_json
from pipeline.storage.address import is_url, join, redacted
from schemas.enums import RunStatus
from schemas.errors import visible
from schemas.version import SOFTWARE

# Between two lines of progress in a pipe.
_SAY_S = 5.0
# Characters of the bar; of both counts and the time beside it, of 100,000 runs.
_BAR = 12
_COUNTS = 24


class CampaignWatch:
    """Counts the runs of a campaign, and shows those that are not ok and what somebody should see to."""

    def begin(self, runs: int, out: str) -> None:
        """Say that so many runs are to be replayed into `out`."""
        self.total = runs
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
        """One more run has ended."""
        self.done += 1
        self.failed += outcome.status is not RunStatus.OK
        self.skipped += outcome.skipped
        self.show_outcome(outcome)

    def show_outcome(self, outcome: RunOutcome) -> None:
        """Show a run that has ended, once it is counted."""
        if outcome.status is not RunStatus.OK:
            self.noted(outcome_line(outcome))

    def end(self, summary: CampaignSummary) -> None: ...

    @property
    def rate_per_s(self) -> float | None:
        """Runs replayed per second; none before the first."""
        elapsed_s = time.monotonic() - self.since_s
        replayed = self.done - self.skipped
        return replayed / elapsed_s if replayed and elapsed_s > 0 else None

    @property
    def left_s(self) -> float | None:
        """Seconds until the end at this rate."""
        rate_per_s = self.rate_per_s
        return None if rate_per_s is None else (self.total - self.done) / rate_per_s

    def line(self, under_way: UnderWay = ()) -> str:
        """One line: done, failed, rate, time left, slow runs."""
        return ", ".join([f"{self.done}/{self.total} runs", *self.line_parts(under_way)])

    def line_parts(self, under_way: UnderWay = ()) -> list[str]:
        """What is said with how many are done, what matters most first."""
        parts = [f"{self.failed} failed or partial"]
        if self.skipped:
            parts.append(f"{self.skipped} skipped")
        if self.rate_per_s is not None and self.left_s is not None:
            parts += [f"{duration_text(self.left_s)} left", f"{self.rate_per_s:.2f} runs/s"]
        if slow := slowest(under_way):
            parts.append("longest now: " + ", ".join(f"{visible(run)} ({duration_text(age_s)})" for run, age_s in slow))
        return parts

    def figures(self, under_way: UnderWay = ()) -> dict[str, object]:
        """The same for programs."""
        counts = {"done": self.done, "failed": self.failed, "skipped": self.skipped, "total": self.total}
        slow = [{"run_id": run, "seconds": round(age_s, 3)} for run, age_s in slowest(under_way)]
        times = {"rate_per_s": _round_figure(self.rate_per_s), "left_s": _round_figure(self.left_s)}
        return {**counts, **times, "slow": slow}


def join_fitting(parts: Sequence[str], room: int) -> str:
    """As many of the parts as `room` characters take, the first in any case."""
    text = parts[0]
    for part in parts[1:]:
        if len(text) + len(part) + 2 > room:
            break
        text += f", {part}"
    return text


def slowest(under_way: UnderWay) -> list[tuple[str, float]]:
    """The two runs that have been under way for longest."""
    return sorted(under_way, key=lambda item: -item[1])[:2]


def _round_figure(value: float | None) -> float | None:
    """A figure with three decimals, None where not known."""
    return None if value is None else round(value, 3)


class LineWatch(CampaignWatch):
    """Plain lines: each run that is not ok, and every few seconds how far the campaign is."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._said_s = time.monotonic()

    def look(self, under_way: UnderWay) -> None:
        """Say where the campaign stands, every so often."""
        if time.monotonic() - self._said_s >= _SAY_S:
            self._said_s = time.monotonic()
            self.progress(under_way)

    def progress(self, under_way: UnderWay) -> None:
        """Say where the campaign stands now."""
        self.noted(self.line(under_way))

    def noted(self, text: str) -> None:
        """One line; a reader or a terminal that has gone is no reason to stop a campaign."""
        with contextlib.suppress(OSError):
            print(text, file=self._stream, flush=True)

    def end(self, summary: CampaignSummary) -> None:
        """Say where it ended."""
        self.progress(())


class JsonWatch(LineWatch):
    """JSON lines for programs: `run` as each run ends, `lost` with each worker that dies, `progress` in between."""

    def begin(self, runs: int, out: str) -> None:
        """Say that it begins."""
        super().begin(runs, out)
        self.progress(())

    def progress(self, under_way: UnderWay) -> None:
        """Say where the campaign stands now."""
        self._print_event("progress", **self.figures(under_way))

    def show_outcome(self, outcome: RunOutcome) -> None:
        """Say what became of a run."""
        names = (
            *("run_id", "status", "error", "skipped", "attempts", "hazards", "missed_detections"),
            *(
                "balises_found",
                "balises_passed",
                "balises_accepted",
                "balises_on_path",
                "availability",
                "proof_margin_m",
                "remedies",
            ),
        )
        fields = {"verdict": word_of(outcome.verdict), **{name: getattr(outcome, name) for name in names}}
        self._print_event("run", **fields | {"seconds": round(outcome.seconds, 3)} | self.figures())

    def lost(self, run_id: str, attempt: int) -> None:
        """Say that the worker of a run died."""
        self._print_event("lost", run_id=run_id, attempt=attempt)

    def noted(self, text: str) -> None:
        """Say a sentence."""
        self._print_event("note", text=text)

    def _print_event(self, event: str, **fields: object) -> None:
        """Print an event as one line of JSON."""
        super().noted(json.dumps({"event": event, **fields}))


class BarWatch(CampaignWatch):
    """A progress bar on a terminal."""

    def begin(self, runs: int, out: str) -> None:
        """Show a bar."""
        # Takes long to load, and a pipe has no bar.
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        super().begin(runs, out)
        columns = (BarColumn(_BAR), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
        self._bar = Progress(*columns, console=Console(stderr=True))
        self._task = self._bar.add_task("", total=runs)
        self._bar.start()

    def look(self, under_way: UnderWay) -> None:
        """Bring the bar up to date."""
        room = self._bar.console.width - _BAR - _COUNTS
        text = join_fitting(self.line_parts(under_way), room)
        self._bar.update(self._task, completed=self.done, description=text)

    def noted(self, text: str) -> None:
        """Print a sentence above the bar."""
        self._bar.console.print(text, markup=False, highlight=False)

    def end(self, summary: CampaignSummary) -> None:
        """Take the bar away."""
        # The terminal may be closed.
        with contextlib.suppress(OSError):
            self.look(())
            self._bar.stop()


class LogWatch(CampaignWatch):
    """`OUT/replay.log`: every run with its time; an object store gets it when the campaign ends."""

    def begin(self, runs: int, out: str) -> None:
        """Begin the log file of the campaign."""
        super().begin(runs, out)
        self._place = str(join(out, "replay.log"))
        self._lines = list[str]()
        self.noted(f"{SOFTWARE}: {runs} runs")

    def show_outcome(self, outcome: RunOutcome) -> None:
        """Write what became of a run, with the trace of a defect."""
        self.noted(outcome_line(outcome))
        if outcome.trace:
            self.noted(redacted(outcome.trace))

    def noted(self, text: str) -> None:
        """Write a line with its time."""
        line = f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ} {text}\n"
        if is_url(self._place):
            self._lines.append(line)
            return
        with storage.as_output_error(self._place), Path(self._place).open("a", encoding="utf-8") as log:
            log.write(line)

    def end(self, summary: CampaignSummary) -> None:
        """Write the summary; to an object store all lines at once."""
        self.noted(summary_line(summary))
        if is_url(self._place):
            storage.write_bytes(self._place, "".join(self._lines).encode())


def watches(quiet: bool, as_json: bool = False) -> list[CampaignWatch]:
    """What shows a campaign on this terminal or pipe."""
    if quiet:
        return [LogWatch()]
    if as_json:
        return [JsonWatch(), LogWatch()]
    return [progress_watch(), LogWatch()]


def progress_watch() -> CampaignWatch:
    """A bar on a terminal, lines in a pipe."""
    return BarWatch() if sys.stderr.isatty() else LineWatch()


def show_summary(
    summary: CampaignSummary, out: str, quiet: bool, as_json: bool, *, has_pages: bool, **places: str
) -> None:
    """How it ended: as JSON, as messages of what failed alone, or for people; `places`: as in `remedy_lines`."""
    if as_json:
        print(to_json(summary_answer(summary, out)))
    elif quiet:
        for outcome in summary.outcomes:
            if outcome.status is not RunStatus.OK:
                print(f"balise: {outcome_line(outcome)}", file=sys.stderr)
    else:
        _show_ending(summary, out)
        pages = "" if has_pages else f"; `balise report {out}` writes pages of them"
        print(f"Tables are in {out}{pages}.")
        for line in remedy_lines(summary, out=out, **places):
            print(f"Remedy for {line}")


def summary_answer(summary: CampaignSummary, out: str) -> dict[str, object]:
    """The same for programs."""
    head = {"verdict": summary.head.word, "verdicts": summary.head.counts(), **summary.verdict_figures()}
    figures = {"planned": summary.planned, "left": summary.count_left, "skipped": summary.count_skipped}
    return {**head, **figures, "seconds": round(summary.seconds, 3), "out": out, "runs": outcome_rows(summary)}


def _show_ending(summary: CampaignSummary, out: str, most: int = 25) -> None:
    """The verdicts, the worst first; of many runs those that are not safe."""
    show_text(summary_line(summary))
    rows = ending_rows(summary)
    remarkable = rows.filter(rows["verdict"] != "safe")
    shown = rows if rows.height <= most else remarkable.head(most)
    if shown.height:
        show_table(shown)
    if (more := remarkable.height - shown.height) > 0:
        print(f'{more} more are not safe: `balise sql {out} "SELECT verdict, run_id, error FROM runs"` lists all.')
