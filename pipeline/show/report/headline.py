"""The head of a page: the verdict in one sentence, facts of when, where and with what, and the figures as tiles."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence

import polars as pl

from pipeline.results.figures.hazard_words import hazard_words, withstood_words
from pipeline.results.figures.head import head_of, run_verdicts, verdict_figures, word_of, worst_verdict
from pipeline.show.report.columns import Row
from pipeline.show.report.markup import Cell, number, table, value_cell
from pipeline.show.report.words import WORDS, count_words, first_names
from schemas.enums import Origin, Reason, RunVerdict
from schemas.frozen import frozen
from schemas.run import RunTables
from schemas.words import JUDGES, part_words, reason_words, say, unnoticed_words, verdict_figures_words

_ALL_SAFE = "every acceptance right, every position failure within the time allowed, in all runs"


@frozen
class Headline:
    """`word` is the verdict, `worst` the sentence behind it, `beside` its figures, `reasons` all that made it."""

    word: str
    worst: str
    reasons: str
    figures: str = ""


def run_headline(rows: Iterable[Row], hazards: pl.DataFrame, passages: pl.DataFrame) -> Headline:
    """Headline of one run with all its solutions, headed by the worst of them."""
    listed = list(rows)
    verdict = worst_verdict(row["verdict"] for row in listed)
    heading = next((row for row in listed if row["verdict"] == verdict), listed[0])
    if verdict is None:
        return Headline(word_of(verdict), heading["error"] or "the run failed", "")
    worst = _decisive_words(heading, hazards, passages)
    proved = _margin_words(heading) if verdict == RunVerdict.SAFE else ""
    figures = _join_sentences(verdict_figures_words(heading), part_words(heading), proved)
    if len(listed) > 1:
        reasons = " ".join(_solution_sentence(row) for row in listed)
        return Headline(word_of(verdict), f"{heading['solution']}: {worst}", reasons, figures)
    reasons = f"{reason_words(heading)}." if verdict == RunVerdict.UNSAFE else ""
    return Headline(word_of(verdict), worst, reasons, figures)


def _join_sentences(*texts: str) -> str:
    """One sentence after the other; the page ends the last."""
    return ". ".join(text[0].upper() + text[1:] for text in texts if text)


def _margin_words(run: Row) -> str:
    """What a safe verdict rests on: the evidence, and how large an error would have been noticed."""
    used_s, judged_s = run["in_use_s"], run["in_use_judged_s"]
    judge = JUDGES.get(run["evidence"])
    judged = say("verdicts", "judged", judge, judged_s / used_s) if judge and used_s and judged_s is not None else ""
    return _join_sentences(judged, unnoticed_words(run["undetected_max_m"], run["undetected_share_beyond"]))


def _solution_sentence(row: Row) -> str:
    """Verdict of a solution with its reasons and figures, as a sentence."""
    why = "" if row["verdict"] is None else f", {reason_words(row)}, {verdict_figures_words(row)}"
    return f"{row['solution']}: {word_of(row['verdict'])}{why}."


def _decisive_words(run: Row, hazards: pl.DataFrame, passages: pl.DataFrame) -> str:
    """What made the verdict, in the fewest words that name it: the worst of the faults that did, else the counts.

    Of a safe run with faults: what it withstood.
    """
    of_solution = pl.col("solution") == run["solution"]
    if run["verdict"] == RunVerdict.SAFE:
        withstood = withstood_words(hazards.filter(of_solution))
        return withstood or f"{reason_words(run)}; {say('verdicts', 'no_fault')}"
    accepted = pl.col("accepted_ids").list.len() > 0
    late = pl.col("within_budget").eq(other=False)
    guilty = hazards.filter(of_solution, accepted | late)
    return next(iter(hazard_words(guilty, passages)), reason_words(run))


def campaign_headline(runs: pl.DataFrame, hazards: pl.DataFrame, passages: pl.DataFrame) -> tuple[Headline, str | None]:
    """Headline of all runs, and the run that it names; frames with `run_id`."""
    head = head_of(run_verdicts(runs).values())
    total = sum(head.counts().values())
    counts = ", ".join(f"{count} {name}" for name, count in head.counts().items() if count)
    summary = f"{count_words(total, 'run')}: {counts}."
    if head.verdict is None:
        return Headline(head.word, "no run could be replayed", summary), None
    figures = verdict_figures_words(verdict_figures(runs))
    if head.verdict == RunVerdict.SAFE:
        withstood = withstood_words(hazards) or say("verdicts", "no_fault")
        largest_m = None if runs["undetected_max_m"].has_nulls() else float(runs["undetected_max_m"].max())  # type: ignore[arg-type]
        proved = _join_sentences(figures, unnoticed_words(largest_m))
        return Headline(head.word, f"{_ALL_SAFE}; {withstood}", summary, proved), None
    rows = runs.filter(pl.col("verdict") == head.verdict.value)
    order = ("unsafe_accepted", "hazardous_max_s", "unproven_accepted", "share_unknown")
    worst = rows.sort(*order, "run_id", descending=[True] * len(order) + [False], nulls_last=True).head(1)
    if worst.is_empty():
        return Headline(
            head.word, f"{count_words(head.failed, 'run')} failed, the others are safe", summary, figures
        ), None
    row = worst.row(0, named=True)
    of_run = pl.col("run_id") == row["run_id"]
    reason = _decisive_words(row, hazards.filter(of_run), passages.filter(of_run))
    return Headline(head.word, f"{reason} (run {row['run_id']})", summary, figures), row["run_id"]


_TRAINS = {
    "file": "odometer and antenna as in the vehicle file",
    "learned": "odometer scale and GNSS latency learned in the run: no vehicle file states them",
    "none": "no odometer: no monitor along the track can work",
}
FILES = "_files"
_COUNTED = (
    ("accepted at a wrong place", "unsafe_accepted", "bad"),
    ("wrong in use for too long", "failures_beyond_budget", "bad"),
    ("faults not found in time", "missed_detections", "bad"),
    ("accepted, could not be checked", "unproven_accepted", "doubt"),
)


def fact_rows(rows: Sequence[Row], tables: RunTables, metadata: Mapping[str, str]) -> list[tuple[str, str]]:
    """When, where, with what, by which program, from which files."""
    first = rows[0]
    lines = {
        "Date": _time_words(first),
        "Line": _line_words(first, tables.epochs),
        "Train": _TRAINS.get(first["vehicle"], "not known"),
        "Odometer": _odometer_words(first),
        "Receivers": ", ".join(
            f"{row['solution']} {number(row['gnss_rate_hz'])} Hz" for row in rows if row["solution"]
        ),
        "Judged by": JUDGES.get(first["evidence"], "nothing: the log has no reference, no reads, no odometer"),
        "Reading of the log": ", ".join(dict.fromkeys(_status_words(row) for row in rows)),
        "Program": f"{first['software']}, tables {first['contract']}",
        "Digest of log and site": first["input_digest"],
        "Digest of configuration and vehicle": first["config_digest"],
        "Digest of the log": metadata.get("log_digest", ""),
    }
    return [(name, value) for name, value in lines.items() if value]


def _odometer_words(row: Row) -> str:
    """Origin of the odometer, and that this is a declaration; nothing without one."""
    origin = row["odometer_origin"]
    if origin is None:
        return ""
    declared = origin != Origin.UNKNOWN
    return say("origins", "declared" if declared else "undeclared", say("origins", origin))


def _time_words(row: Row) -> str:
    """Begin and end of a run in words."""
    if row["t_start"] is None:
        return "not known"
    hours = f"{row['t_start']:%Y-%m-%d, %H:%M:%S} to {row['t_end']:%H:%M:%S} UTC"
    return f"{hours} ({row['duration_s'] / 60.0:.1f} min)" if row["duration_s"] is not None else hours


def _line_words(row: Row, epochs: pl.DataFrame) -> str:
    """Net elements, distance and balises of a run in words."""
    names = epochs["netelement_id"].drop_nulls().unique(maintain_order=True).to_list()
    if not names:
        return "not known"
    driven = f", {row['distance_m'] / 1000.0:.1f} km driven" if row["distance_m"] is not None else ""
    return f"{first_names(names, 6)}{driven}, {row['balises_passed']} balises passed"


def _status_words(row: Row) -> str:
    """How the log could be read, in words."""
    until = f" up to {row['partial_until']:%H:%M:%S} UTC" if row["partial_until"] is not None else ""
    return f"{row['status']}: {WORDS[row['status']]}{until}"


def tile_figures(run: Row, balises: pl.DataFrame) -> list[tuple[str, str, str]]:
    """What a reader must not miss; a tile that is bad looks bad. `balises`: as `lost_shares`."""
    share = run["share_unknown"]
    checked = share is not None and Reason.UNKNOWN_IN_USE not in (run["reasons"] or ())
    lost, passed = (int(balises[name].sum()) for name in ("lost", "passages"))
    return [
        *((words, number(run[name]), _count_tone(run[name], tone)) for words, name, tone in _COUNTED),
        ("of the time in use not checked", _percent_words(share), "good" if checked else "doubt"),
        ("passages without the balise, of all", f"{lost} of {passed}", _count_tone(lost, "lost")),
        ("false alarms", number(run["false_alarms"]), _count_tone(run["false_alarms"], "lost")),
        ("of moving time with a valid TVB", _percent_words(run["availability"]), "" if run["availability"] else "lost"),
    ]


def _count_tone(count: int | None, tone: str) -> str:
    """Tone of a count; in doubt where nobody counted."""
    return "doubt" if count is None else tone if count else "good"


def _percent_words(share: float | None) -> str:
    """A share in per cent."""
    return "not known" if share is None else f"{share:.1%}"


def file_table(metadata: Mapping[str, str]) -> str:
    """The files that the run was made from, as `[name, bytes, SHA-256]` under each key that ends so."""
    listed = {key: json.loads(value) for key, value in sorted(metadata.items()) if key.endswith(FILES)}
    heads = [("part", ""), ("file", ""), ("bytes", ""), ("SHA-256", "")]
    rows = [
        [Cell(part := key.removesuffix(FILES), part), *(value_cell(value) for value in file)]
        for key, files in listed.items()
        for file in files
    ]
    return table("table-files", "Files that this run was made from", heads, rows) if rows else ""
