"""The page of one run: what happened, where, when, and what the replay made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any
from urllib.parse import quote

import polars as pl

from pipeline.figures.known_counts import known_counts
from pipeline.figures.verdict import word_of, worst_verdict
from pipeline.report.architectures import architectures_section
from pipeline.report.markup import (
    Cell,
    badge,
    cell,
    figure,
    link,
    page,
    pairs,
    section,
    table,
    verdict_head,
)
from pipeline.report.packing import Json, script_json
from pipeline.report.plan_view import plan_data
from pipeline.report.run_columns import ALARM_COLUMNS, HAZARD_COLUMNS, PASSAGE_COLUMNS, PLOTS
from pipeline.report.run_summary import figures, levels, verdict_reasons
from pipeline.report.series import moments_of, reasons, time_data
from pipeline.report.stanford import stanford_data
from pipeline.safety.side_by_side import Key, side_by_side_table
from pipeline.safety.tally import Tally
from schemas.config import Configuration
from schemas.enums import TRUTH
from schemas.run import RunTables, Site

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Made:
    """What stands on every page: limits, and the configuration as it was resolved."""

    config: Configuration
    config_text: str | None
    site: Site | None


def run_page(
    tables: RunTables, metadata: Mapping[str, str], made: Made, architectures: Mapping[Key, Tally] | None = None
) -> str:
    """HTML of one run with all its solutions; one is shown at a time, all of them are in the page.

    `architectures`: the run's solutions side by side, where there are several.
    """
    rows = list(tables.runs.iter_rows(named=True))
    names = [row["solution"] for row in rows if row["solution"]]
    parts = [_solution(f"s{number}", row, tables, len(rows) > 1) for number, row in enumerate(rows)]
    side_by_side = architectures_section("architectures", side_by_side_table(dict(architectures or {})))
    body = "\n".join([_navigation(names), *parts, side_by_side, _provenance(rows, metadata, made)])
    data = {
        "run": tables.run_id,
        "limits": _limits(made.config),
        "order": [row["solution"] for row in rows],
        "solutions": {name: _solution_data(name, tables, made) for name in names},
    }
    status = "".join(badge(status) for status in dict.fromkeys(str(row["status"]) for row in rows))
    title = f"<p>{link('../index.html', 'Campaign')}</p><h1>Run {escape(tables.run_id)} {status}</h1>"
    heading = _verdict(rows, made.config) + title
    return page(f"{tables.run_id} · balise", heading, body, script_json(data), "../assets", "run.js")


def _verdict(rows: Sequence[Row], config: Configuration) -> str:
    """The worst verdict of the solutions, and what it follows from."""
    limit = config.hazards.unknown_share_limit
    reasons = [
        f"{row['solution']}: {word_of(row['verdict'])}, {verdict_reasons(row, limit)}."
        if row["verdict"] is not None
        else f"{row['solution'] or 'run'}: failed."
        for row in rows
    ]
    return verdict_head(word_of(worst_verdict(row["verdict"] for row in rows)), " ".join(reasons))


def _limits(config: Configuration) -> Json:
    return {
        "ci_limit_m": config.lds.ci_limit_m,
        "failure_limit_m": config.hazards.failure_limit_m,
        "shift_limit_m": config.hazards.shift_limit_m,
        "budget_s": config.budget_s,
    }


def _solution_data(name: str, tables: RunTables, made: Made) -> Json:
    epochs, passages, hazards, alarms = (
        frame.filter(pl.col("solution") == name)
        for frame in (tables.epochs, tables.passages, tables.hazards, tables.alarms)
    )
    moments_ns = moments_of(hazards, alarms)
    return {
        "time": time_data(epochs, moments_ns, made.config.align.gap_reset_s),
        "plan": plan_data(epochs, passages, made.site, moments_ns),
        "stanford": stanford_data(epochs, made.config.lds.ci_limit_m),
        "hazards": [_hazard_data(row) for row in hazards.iter_rows(named=True)],
        "passages": [_passage_data(row) for row in passages.iter_rows(named=True)],
    }


def _hazard_data(row: Row) -> Json:
    moments = ("t_onset", "t_hazard", "t_failure", "t_detected", "t_negated", "t_end")
    return {
        "id": row["hazard_id"],
        "class": str(row["hazard"]),
        **{name: milliseconds(row[name]) for name in moments},
    }


def _passage_data(row: Row) -> Json:
    return {
        "id": row["balise_id"],
        "status": str(row["status"]),
        "t_ms": milliseconds(row["t_offered"] if row["t_offered"] is not None else row["t_true"]),
        "error_m": row["location_error_m"],
        "open_m": row["window_open_m"],
        "close_m": row["window_close_m"],
        "odometer_m": row["odometer_distance_m"],
    }


def hazard_hash(solution: str, hazard_id: int) -> str:
    """The part of an address that zooms a run's page to a hazard."""
    return f"#s={quote(solution, safe='')}&h={hazard_id}"


def milliseconds(value: Any) -> float | None:
    """An instant as the page's scripts take it."""
    return None if value is None else round(value.timestamp() * 1000.0, 3)


def _navigation(names: list[str]) -> str:
    buttons = "".join(
        f'<button type="button" data-solution="{escape(name)}" aria-pressed="false">{escape(name)}</button>'
        for name in names
    )
    chooser = f'<div role="group" aria-label="Solution">{buttons}</div>' if len(names) > 1 else ""
    moves = (
        ("back", "← earlier"), ("forward", "later →"), ("in", "zoom in"), ("out", "zoom out"), ("all", "whole run"),
        ("previous", "previous hazard"), ("next", "next hazard"),
    )  # fmt: skip
    tools = "".join(f'<button type="button" data-move="{key}">{text}</button>' for key, text in moves)
    if not names:
        return ""
    return (
        f'<nav class="tools" aria-label="Time axis">{chooser}<div role="group" aria-label="Zoom">{tools}</div>'
        '<p id="window" aria-live="polite"></p></nav>'
    )


def _solution(key: str, row: Row, tables: RunTables, several: bool) -> str:
    name = row["solution"]
    notes = [f'<p class="notice {row["status"]}">{escape(text)}</p>' for text in (row["error"], row["notes"]) if text]
    if not name:
        return "".join(notes) or '<p class="notice failed">The run failed.</p>'
    hazards, passages, alarms = (
        frame.filter(pl.col("solution") == name) for frame in (tables.hazards, tables.passages, tables.alarms)
    )
    epochs = tables.epochs.filter(pl.col("solution") == name)
    known = known_counts(tables.runs.filter(pl.col("solution") == name)).row(0, named=True)
    title = f"Figures of {name}" if several else "Figures"
    parts = [
        section(f"figures-{key}", title, *notes, figures(known), levels(key, row)),
        section(f"hazards-{key}", "Hazards", _hazards(key, row, hazards)),
        _drawings(key),
        section(f"passages-{key}", "Passages", _passages(key, passages)),
        section(f"alarms-{key}", "Alarms", _alarms(key, alarms)),
        section(f"reasons-{key}", "Monitors not evaluated", _reasons(key, epochs)),
    ]
    opening = f'<div class="solution" id="{key}" data-solution="{escape(name)}">'
    return opening + "\n".join(parts) + "</div>"


def _drawings(key: str) -> str:
    figures = (figure(f"{key}-{plot}", title, note) for plot, title, note in PLOTS)
    return section(f"drawings-{key}", "Drawings", *figures)


def _hazards(key: str, run: Row, hazards: pl.DataFrame) -> str:
    if hazards.is_empty():
        if run["evidence"] is None:
            return '<p class="notice partial">No hazard was found, but there was nothing to judge the positions by.</p>'
        if run["evidence"] not in TRUTH:
            return (
                '<p class="notice partial">No hazard was found, but the odometer alone can only show that a position'
                " was wrong, never that it was right.</p>"
            )
        share = run["share_unknown"]
        left = "; no position was in use" if share is None else f"; {share:.1%} of the moving time in use is not judged"
        return f'<p class="none">No hazard was found; judged by: {escape(str(run["evidence"]))}{left}.</p>'
    rows = []
    for row in hazards.iter_rows(named=True):
        title = f"{row['hazard_id']} {row['hazard']}"
        anchor = link(hazard_hash(row["solution"], row["hazard_id"]), title, data_hazard=str(row["hazard_id"]))
        first = Cell(title, float(row["hazard_id"]), anchor, "" if row["detected"] else "bad")
        rows.append([first, *(cell(row[key]) for key, _ in HAZARD_COLUMNS)])
    titles = ["hazard", *(title for _, title in HAZARD_COLUMNS)]
    return table(f"table-hazards-{key}", "Hazards; a link zooms every drawing to its hazard", titles, rows)


def _passages(key: str, passages: pl.DataFrame) -> str:
    rows = [
        [
            cell(row["balise_id"]),
            Cell(str(row["status"]), str(row["status"]), tone="" if row["status"] == "accepted" else "bad"),
            *(cell(row[key], 4) for key, _ in PASSAGE_COLUMNS),
        ]
        for row in passages.iter_rows(named=True)
    ]
    titles = ["balise", "status", *(title for _, title in PASSAGE_COLUMNS)]
    return table(f"table-passages-{key}", "Passages of balises", titles, rows)


def _alarms(key: str, alarms: pl.DataFrame) -> str:
    rows = [[cell(row[key]) for key, _ in ALARM_COLUMNS] for row in alarms.iter_rows(named=True)]
    return table(f"table-alarms-{key}", "Alarm episodes", [title for _, title in ALARM_COLUMNS], rows)


def _reasons(key: str, epochs: pl.DataFrame) -> str:
    by_reason: dict[tuple[str, int], list[str]] = {}
    for monitor, reason, count in reasons(epochs):
        by_reason.setdefault((reason, count), []).append(monitor)
    rows = [[cell(reason), cell(count), cell(names)] for (reason, count), names in by_reason.items()]
    return table(f"table-reasons-{key}", "Why monitors could not judge", ["reason", "epochs", "monitors"], rows)


def _provenance(rows: Sequence[Row], metadata: Mapping[str, str], made: Made) -> str:
    first = rows[0]
    named = {key: str(first[key]) for key in ("software", "contract", "config_digest", "input_digest")}
    text = made.config_text
    shown = (
        f'<details><summary>Resolved configuration (TOML)</summary><pre tabindex="0">{escape(text)}</pre></details>'
        if text is not None
        else '<p class="notice partial">The result holds no config.toml: limits drawn here are the defaults.</p>'
    )
    return section("provenance", "Provenance", pairs(sorted((named | dict(metadata)).items())), shown)
