"""Hazards in words, the worst first: for endings, lists and heads of pages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import polars as pl

from schemas.enums import Timing

Row = Mapping[str, Any]


def hazard_words(hazards: pl.DataFrame) -> list[str]:
    """One phrase per fault of a `hazards` table, the worst first; rows that another hazard made are left out."""
    faults = hazards.filter(pl.col("caused_by").is_null())
    return [hazard_phrase(row) for row in sorted(faults.iter_rows(named=True), key=_badness)]


def hazard_phrase(row: Row) -> str:
    """`VB_JUMP_1B: VB04 502 m early, accepted; no monitor saw it`."""
    return f"{row['hazard']}: {_what(row)}, {_accepted(row)}; {_seen(row)}"


def _badness(row: Row) -> tuple[Any, ...]:
    """Accepted ones first, then those that no monitor saw, those too late, the larger ones."""
    late = {False: 0, None: 1, True: 2}[row["within_budget"]]
    return (not row["accepted_ids"], row["detected"], late, -abs(row["size_m"] or 0.0), row["hazard_id"])


def _what(row: Row) -> str:
    """The balises that it hit, how far off and to which side."""
    size = "" if row["size_m"] is None else f" {abs(row['size_m']):.0f} m"
    side = "" if row["timing"] in (None, Timing.NONE) else f" {row['timing']}"
    return f"{_some(row['balise_ids']) or 'no balise'}{size}{side or ' off' * bool(size)}"


def _accepted(row: Row) -> str:
    accepted, hit = row["accepted_ids"] or [], row["balise_ids"] or []
    if not accepted:
        return "not accepted"
    return "accepted" if set(accepted) == set(hit) else f"{_some(accepted)} accepted"


def _seen(row: Row) -> str:
    seen = f"seen by {row['monitor']}" if row["detected"] else "no monitor saw it"
    if row["within_budget"] is False:
        seen += f", {row['hazardous_s']:.3g} s in use against {row['budget_s']:.3g} s allowed"
    return seen


def _some(names: Iterable[str] | None) -> str:
    """`VB03`, `VB03 VB04`, `VB03 to VB09 (7)`: as many as a line takes."""
    listed = list(names or [])
    return " ".join(listed) if len(listed) < 3 else f"{listed[0]} to {listed[-1]} ({len(listed)})"
