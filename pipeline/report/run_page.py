"""The page of one run: what happened, where, when, and what the replay made of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any
from urllib.parse import quote

import polars as pl

from pipeline.figures.known_counts import known_counts
from pipeline.figures.levels import LEVEL_LISTS
from pipeline.figures.verdict import verdict_reasons, word_of, worst_verdict
from pipeline.report.architectures import architectures_section
from pipeline.report.columns import Row, figures, frame_table
from pipeline.report.markup import Cell, Json, badge, figure, link, page, pairs, script_json, section, verdict_head
from pipeline.report.plan_view import plan_data
from pipeline.report.series import MOMENTS, moments_of, reasons, stanford_data, time_data
from schemas.campaign import STANFORD, CampaignLevels
from schemas.config import Configuration
from schemas.enums import TRUTH
from schemas.run import RunTables, Site
from schemas.tables import Alarms, Hazards, Passages, Runs

_FIGURES = (
    *("verdict", "duration_s", "distance_m", "epochs", "gnss_rate_hz", "evidence", "share_unknown", "vehicle"),
    *("odometer_contradicted", "availability", "outages", "longest_outage_s", "along_error_p95_m"),
    *("along_error_max_m", "along_error_epochs", "cross_error_p95_m", "up_error_p95_m", "balises_on_path"),
    *("balises_accepted", "balises_rejected", "balises_missed", "balises_not_available", "unsafe_accepted"),
    *("unproven_accepted", "location_error_p95_m", "location_error_count", "failures", "failures_within_budget"),
    *("failures_beyond_budget", "missed_detections", "time_to_detect_max_s", "hazardous_max_s", "alarms"),
    *("false_alarms", "false_alarm_rate_per_h", "exposure_max_s", "exposure_p99_s", "mtbf_h", "latency_s"),
    *("odometer_scale", "ambiguous_stretches", "duplicates", "out_of_order"),
    *(f"share_{state}" for state in ("p0", "p1", "p2", "p3")),
    *(f"{prefix}_{kind}" for prefix in ("stanford", "stanford_hpl") for kind in STANFORD),
)
_HAZARDS = (
    *("hazard_id", "failure_mode", "timing", "size_m", "rate_mps", "t_onset", "t_failure", "t_detected", "monitor"),
    *("time_to_detect_s", "time_since_failure_s", "hazardous_s", "hazardous_may_s", "budget_s", "within_budget"),
    *("balise_ids", "accepted_ids", "suspect", "evidence", "speed_mps", "caused_by"),
)
_PASSAGES = (
    *("balise_id", "status", "kind", "direction", "t_offered", "t_true", "judgement", "location_error_m"),
    *("location_accuracy_m", "speed_mps", "window_open_m", "odometer_distance_m", "window_close_m", "confidence_m"),
    *("linking_error", "reaction", "failure_mode", "cause", "suspect_after_the_fact", "hazard_id"),
)
_ALARMS = (
    *("t_start", "t_end", "monitors", "peak_ratio", "verdict", "suspect", "hazard_id", "netelement_id", "measure_m"),
)
_PLOTS = (
    ("plan", "Plan", "GNSS positions coloured by the state of the LDS; balises by what became of them; "
     "thick lines are expectation windows."),
    ("bands", "LDS mode, state, TVB and alarm", "Where nothing is drawn there was no epoch. Hazards are shaded; "
     "of the chosen one the dotted line is the onset, the solid one the detection, the dashed one the failure."),
    ("speed", "Speed", ""),
    ("along", "Error along the track", "Positive ahead of the train, drawn where it is known to 5 m; the confidence "
     "interval is dashed. Where it is never known: GNSS minus odometer."),
    ("across", "Error across the track and of height", "Without truth: residual against the surveyed track."),
    ("linking", "Distance since the last accepted balise", "Bars are the expectation windows of the balises offered, "
     "in odometer distance; markers are the offers."),
    ("exposure", "Exposure", "Time since the last linked TVB or accepted VB."),
    ("monitors-along", "Monitors along the track", "Value over threshold: beyond ±1 the monitor fails."),
    ("monitors-cross", "Monitors across the track", "Value over threshold."),
    ("monitors-up", "Monitors of height", "Value over threshold."),
    ("monitors-other", "Other monitors", "Value over threshold."),
    ("states", "State of every monitor", "Not evaluated is not the same as passed."),
    ("stanford", "Stanford diagram", "Epochs of known error: error along the track against the confidence claimed. "
     "Below the diagonal the claim was wrong."),
)  # fmt: skip


@dataclass(frozen=True)
class Made:
    """What stands on every page: limits, and the configuration as it was resolved."""

    config: Configuration
    config_text: str | None
    site: Site | None


def run_page(
    tables: RunTables, metadata: Mapping[str, str], made: Made, architectures: pl.DataFrame | None = None
) -> str:
    """HTML of one run with all its solutions; one is shown at a time, all of them are in the page.

    `architectures`: the run's solutions side by side, where there are several.
    """
    rows = list(tables.runs.iter_rows(named=True))
    names = [row["solution"] for row in rows if row["solution"]]
    parts = [_solution(f"s{number}", row, tables, len(rows) > 1) for number, row in enumerate(rows)]
    side_by_side = "" if architectures is None else architectures_section("architectures", architectures)
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
    moments = {name: _milliseconds(row[name]) for name in MOMENTS}
    return {"id": row["hazard_id"], "class": row["hazard"], **moments}


def _passage_data(row: Row) -> Json:
    return {
        "id": row["balise_id"],
        "status": str(row["status"]),
        "t_ms": _milliseconds(row["t_offered"] or row["t_true"]),
        "error_m": row["location_error_m"],
        "open_m": row["window_open_m"],
        "close_m": row["window_close_m"],
        "odometer_m": row["odometer_distance_m"],
    }


def hazard_cell(row: Row, title: str, page_href: str = "", **attributes: str) -> Cell:
    """A link that zooms a run's page to a hazard; one that no monitor found stands out."""
    href = f"{page_href}#s={quote(row['solution'], safe='')}&h={row['hazard_id']}"
    return Cell(title, title, link(href, title, **attributes), "" if row["detected"] else "bad")


def _milliseconds(value: Any) -> float | None:
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
        section(f"figures-{key}", title, *notes, figures(known, Runs, _FIGURES), _levels(key, row)),
        section(f"hazards-{key}", "Hazards", _hazards(key, row, hazards)),
        _drawings(key),
        section(f"passages-{key}", "Passages", _passages(key, passages)),
        section(f"alarms-{key}", "Alarms", _alarms(key, alarms)),
        section(f"reasons-{key}", "Monitors not evaluated", _reasons(key, epochs)),
    ]
    opening = f'<div class="solution" id="{key}" data-solution="{escape(name)}">'
    return opening + "\n".join(parts) + "</div>"


def _drawings(key: str) -> str:
    return section(f"drawings-{key}", "Drawings", *(figure(f"{key}-{plot}", *told) for plot, *told in _PLOTS))


def _levels(key: str, run: Row) -> str:
    """What the run would be worth at each service level."""
    shown = pl.DataFrame({name: run[column] or [] for name, column in LEVEL_LISTS.items()})
    title = "Position failures against the allowed T_D (TVB eq. 7)"
    return frame_table(f"table-levels-{key}", title, shown, contract=CampaignLevels)


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

    def named(row: Row) -> Cell:
        return hazard_cell(row, f"{row['hazard_id']} {row['hazard']}", data_hazard=str(row["hazard_id"]))

    caption = "Hazards; a link zooms every drawing to its hazard"
    return frame_table(f"table-hazards-{key}", caption, hazards, _HAZARDS, Hazards, {"hazard_id": named})


def _passages(key: str, passages: pl.DataFrame) -> str:
    def status(row: Row) -> Cell:
        return Cell(row["status"], row["status"], tone="" if row["status"] == "accepted" else "bad")

    caption = "Passages of balises"
    return frame_table(f"table-passages-{key}", caption, passages, _PASSAGES, Passages, {"status": status})


def _alarms(key: str, alarms: pl.DataFrame) -> str:
    return frame_table(f"table-alarms-{key}", "Alarm episodes", alarms, _ALARMS, Alarms)


def _reasons(key: str, epochs: pl.DataFrame) -> str:
    return frame_table(f"table-reasons-{key}", "Why monitors could not judge", reasons(epochs))


def _provenance(rows: Sequence[Row], metadata: Mapping[str, str], made: Made) -> str:
    first = rows[0]
    named = {key: str(first[key]) for key in ("software", "contract", "config_digest", "input_digest")}
    return section("provenance", "Provenance", pairs(sorted((named | dict(metadata)).items())), configuration(made))


def configuration(made: Made) -> str:
    """The resolved configuration, folded."""
    if made.config_text is None:
        return '<p class="notice partial">The result holds no config.toml: limits are the defaults.</p>'
    text = f'<pre tabindex="0">{escape(made.config_text)}</pre>'
    return f"<details><summary>Resolved configuration (TOML)</summary>{text}</details>"
