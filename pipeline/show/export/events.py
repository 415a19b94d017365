"""Hazards and passages as sentences with an instant."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import polars as pl

from pipeline.show.export.messages import Level
from schemas.enums import Judgement, PassageStatus

Row = Mapping[str, Any]
Entry = tuple[int, int, str, str]


def hazard_entries(hazards: pl.DataFrame) -> list[Entry]:
    """Time [ns], level, name, text: what a hazard is, and when it was detected, failed and ended."""
    entries: list[Entry] = []
    for row in _rows_of(hazards):
        name = f"hazard {row['hazard_id']}"
        entries.append((row["t_hazard"], Level.ERROR, name, hazard_text(row)))
        moments = (
            ("t_onset", Level.WARNING, "onset"),
            ("t_failure", Level.ERROR, "position failure"),
            ("t_detected", Level.WARNING, f"detected by {row['monitor']}"),
            ("t_negated", Level.INFO, "negated"),
            ("t_end", Level.INFO, "end"),
        )
        entries += [(row[key], level, name, text) for key, level, text in moments if row[key] is not None]
    return entries


def hazard_text(row: Row) -> str:
    """One line on a hazard."""
    size = "of unknown size" if row["size_m"] is None else f"of {row['size_m']:.1f} m"
    hit = ", ".join(row["balise_ids"]) or "no VB"
    accepted = f", accepted despite the fault: {', '.join(row['accepted_ids'])}" if row["accepted_ids"] else ""
    detected = "detected" if row["detected"] else "not detected"
    return f"{row['hazard']} {size}, {row['failure_mode']}, {detected}, hits {hit}{accepted}, suspect: {row['suspect']}"


def passage_entries(passages: pl.DataFrame) -> list[Entry]:
    """Entries of the passages, at the time the balise was offered, else passed."""
    entries: list[Entry] = []
    for row in _rows_of(passages):
        t_ns = row["t_offered"] if row["t_offered"] is not None else row["t_true"]
        if t_ns is None:
            continue
        accepted = row["status"] == PassageStatus.ACCEPTED
        wrong = row["judgement"] == Judgement.WRONG
        level = Level.WARNING if not accepted else Level.ERROR if wrong else Level.INFO
        error = "" if row["location_error_m"] is None else f", location error {row['location_error_m']:.2f} m"
        judged = "" if row["judgement"] is None else f", position {row['judgement']}"
        entries.append((t_ns, level, row["balise_id"], f"{row['status']}{judged}{error}"))
    return entries


def _rows_of(frame: pl.DataFrame) -> list[dict[str, Any]]:
    """Rows with times in nanoseconds since 1970."""
    times = [name for name, dtype in frame.schema.items() if isinstance(dtype, pl.Datetime)]
    return frame.with_columns(pl.col(times).to_physical()).to_dicts()
