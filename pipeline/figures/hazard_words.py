"""Hazards in words, the worst first: for endings, lists and heads of pages, which all take them from here."""

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
    return f"{row['hazard']}: {_what(row)}, {_accepted(row)}; {_seen(row)}{_in_use(row)}"


def _badness(row: Row) -> tuple[Any, ...]:
    """Accepted ones first, then those that no monitor saw, those too late, the larger ones."""
    late = {False: 0, None: 1, True: 2}[row["within_budget"]]
    return (not row["accepted_ids"], row["detected"], late, -abs(row["size_m"] or 0.0), row["hazard_id"])


def _what(row: Row) -> str:
    """The balises that it hit, how far off and to which side."""
    off = _off(row["size_m"], row["timing"])
    return " ".join(text for text in (_some(row["balise_ids"]) or "no balise", off) if text)


def _off(size_m: float | None, timing: Timing | str | None) -> str:
    """`502 m early`, `3 m off` where the side is not known, `late` where the size is not; nothing where neither is."""
    size = "" if size_m is None else f"{abs(size_m):.0f} m"
    side = "" if timing in (None, Timing.NONE) else str(timing)
    return " ".join(text for text in (size, side or "off" * bool(size)) if text)


def _accepted(row: Row) -> str:
    accepted, hit = row["accepted_ids"] or [], row["balise_ids"] or []
    if not accepted:
        return "not accepted"
    return "accepted" if set(accepted) == set(hit) else f"{_some(accepted)} accepted"


def _seen(row: Row) -> str:
    """Which monitor saw it, and how late."""
    if not row["detected"]:
        return "no monitor saw it"
    late_s = row["time_to_detect_s"]
    return f"{row['monitor']} saw it" + ("" if late_s is None else f" {late_s:.3g} s after the fault began")


def _in_use(row: Row) -> str:
    """How long its position was in use, where that was too long."""
    if row["within_budget"] is not False:
        return ""
    return f", {row['hazardous_s']:.3g} s in use against {row['budget_s']:.3g} s allowed"


def _some(names: Iterable[str] | None) -> str:
    """`VB03`, `VB03 VB04`, `VB03 to VB09 (7)`: as many as a line takes."""
    listed = list(names or [])
    return " ".join(listed) if len(listed) < 3 else f"{listed[0]} to {listed[-1]} ({len(listed)})"
