"""How a campaign ended, on the screen or for programs."""

from __future__ import annotations

import sys

from pipeline.campaign.tally import ending_rows, outcome_line, outcome_rows, summary_line
from pipeline.campaign.watch import Summary
from pipeline.results.terminal import show_table, to_json
from schemas.enums import RunStatus

_SHOWN_RUNS = 25


def show_summary(summary: Summary, out: str, quiet: bool, as_json: bool) -> None:
    """As JSON, as messages of what failed alone, or for people."""
    if as_json:
        told = {"verdict": summary.head.word, "verdicts": summary.head.counts()}
        figures = {"planned": summary.planned, "left": summary.left, "skipped": summary.skipped}
        seconds = round(summary.seconds, 3)
        print(to_json({**told, **figures, "seconds": seconds, "out": out, "runs": outcome_rows(summary)}))
    elif quiet:
        for outcome in summary.outcomes:
            if outcome.status is not RunStatus.OK:
                print(f"balise: {outcome_line(outcome)}", file=sys.stderr)
    else:
        _show_ending(summary, out)


def _show_ending(summary: Summary, out: str) -> None:
    """The verdicts, the worst first; of many runs those that are not safe."""
    print(summary_line(summary))
    rows = ending_rows(summary)
    remarkable = rows.filter(rows["verdict"] != "safe")
    shown = rows if rows.height <= _SHOWN_RUNS else remarkable.head(_SHOWN_RUNS)
    if shown.height:
        show_table(shown)
    if (more := remarkable.height - shown.height) > 0:
        print(f'{more} more are not safe: `balise sql {out} "SELECT verdict, run_id, error FROM runs"` lists all.')
    print(f"Tables are in {out}; `balise report {out}` writes pages of them.")
