"""The facts at the head of a run's page: when, where, with what, from which files; and its figures as tiles."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import polars as pl

from pipeline.report.columns import Row
from pipeline.report.markup import Cell, cell, number, table
from pipeline.report.words import WORDS
from schemas.run import RunTables

_TRAINS = {
    "file": "odometer and antenna as in the vehicle file",
    "learned": "no vehicle file: odometer scale and GNSS latency learned in the run",
    "none": "no odometer: no monitor along the track can work",
}
FILES = "_files"
_COUNTED = (
    ("accepted at a wrong place", "unsafe_accepted", "bad"),
    ("wrong in use for too long", "failures_beyond_budget", "bad"),
    ("faults not found in time", "missed_detections", "bad"),
    ("accepted, could not be checked", "unproven_accepted", "doubt"),
)
JUDGES = {"reference": "a reference", "balise": "balise reads", "odometer": "the odometer alone"}


def facts(rows: Sequence[Row], tables: RunTables, metadata: Mapping[str, str]) -> list[tuple[str, str]]:
    """When, where, with what, by which program, from which files."""
    first = rows[0]
    found = {
        "Date": _span(first),
        "Line": _line(first, tables.epochs),
        "Train": _TRAINS.get(first["vehicle"], "not known"),
        "Receivers": ", ".join(map(_receiver, (row for row in rows if row["solution"]))),
        "Judged by": JUDGES.get(first["evidence"], "nothing: the log has no reference, no reads, no odometer"),
        "Reading of the log": ", ".join(dict.fromkeys(_reading(row) for row in rows)),
        "Program": f"{first['software']}, tables {first['contract']}",
        "Digest of log and site": first["input_digest"],
        "Digest of configuration and vehicle": first["config_digest"],
        "Digest of the log": metadata.get("log_digest", ""),
    }
    return [(name, value) for name, value in found.items() if value]


def _receiver(row: Row) -> str:
    return f"{row['solution']} {number(row['gnss_rate_hz'])} Hz"


def _span(row: Row) -> str:
    if row["t_start"] is None:
        return "not known"
    hours = f"{row['t_start']:%Y-%m-%d, %H:%M:%S} to {row['t_end']:%H:%M:%S} UTC"
    return f"{hours} ({row['duration_s'] / 60.0:.1f} min)" if row["duration_s"] is not None else hours


def _line(row: Row, epochs: pl.DataFrame) -> str:
    names = epochs["netelement_id"].drop_nulls().unique(maintain_order=True).to_list()
    if not names:
        return "not known"
    more = f" and {len(names) - 6} more" if len(names) > 6 else ""
    driven = f", {row['distance_m'] / 1000.0:.1f} km driven" if row["distance_m"] is not None else ""
    return f"{', '.join(names[:6])}{more}{driven}, {row['balises_on_path']} balises passed"


def _reading(row: Row) -> str:
    until = f" up to {row['partial_until']:%H:%M:%S} UTC" if row["partial_until"] is not None else ""
    return f"{row['status']}: {WORDS[row['status']]}{until}"


def tile_figures(run: Row, balises: pl.DataFrame, unknown_limit: float) -> list[tuple[str, str, str]]:
    """What a reader must not miss; a tile that is bad looks bad. `balises`: as `lost_shares`."""
    share = run["share_unknown"]
    checked = share is not None and share <= unknown_limit
    lost, passed = (int(balises[name].sum()) for name in ("lost", "passages"))
    return [
        *((words, number(run[name]), _tone(run[name], tone)) for words, name, tone in _COUNTED),
        ("of the time in use not checked", _percent(share), "good" if checked else "doubt"),
        ("balises lost, of those passed", f"{lost} of {passed}", _tone(lost, "lost")),
        ("false alarms", number(run["false_alarms"]), _tone(run["false_alarms"], "lost")),
        ("of moving time with a valid TVB", _percent(run["availability"]), "" if run["availability"] else "lost"),
    ]


def _tone(count: int | None, tone: str) -> str:
    """Nobody counted: in doubt."""
    return "doubt" if count is None else tone if count else "good"


def _percent(share: float | None) -> str:
    return "not known" if share is None else f"{share:.1%}"


def file_table(metadata: Mapping[str, str]) -> str:
    """The files that the run was made from, as `[name, bytes, SHA-256]` under each key that ends so."""
    listed = {key: json.loads(value) for key, value in sorted(metadata.items()) if key.endswith(FILES)}
    heads = [("part", ""), ("file", ""), ("bytes", ""), ("SHA-256", "")]
    rows = [
        [Cell(part := key.removesuffix(FILES), part), *(cell(value) for value in file)]
        for key, files in listed.items()
        for file in files
    ]
    return table("table-files", "Files that this run was made from", heads, rows) if rows else ""
