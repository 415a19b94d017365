"""Hazards in words, the worst first: for endings, lists and heads of pages, which all take them from here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import polars as pl

from schemas.arrays import NS_PER_S
from schemas.enums import Hazard, Judgement, PassageStatus, Timing
from schemas.words import say

Row = Mapping[str, Any]
_say = partial(say, "hazards")


def hazard_words(hazards: pl.DataFrame, passages: pl.DataFrame) -> list[str]:
    """One phrase per fault of a `hazards` table, the worst first; rows that another hazard made are left out.

    `passages`: of the same run, for where the balises were that it had accepted.
    """
    if hazards.is_empty():
        return []
    faults = hazards.filter(pl.col("caused_by").is_null())
    wrong = _wrong_acceptances(passages)
    ranked = sorted(faults.iter_rows(named=True), key=_badness)
    return [_phrase(row, wrong.get((row["solution"], row["hazard_id"]))) for row in ranked]


def withstood(hazards: pl.DataFrame) -> str:
    """What a safe run came through: `2 jumps of up to 300 m negated within 0.2 s, 1 shift that no monitor saw`."""
    faults = hazards.filter(pl.col("caused_by").is_null())
    kinds = pl.col("hazard").cast(pl.String).replace_strict({kind.value: _say(kind.value) for kind in Hazard})
    parts = []
    for (kind,), rows in faults.group_by(kinds, maintain_order=True):
        for (detected,), part in rows.group_by("detected", maintain_order=True):
            response = _response_words(part, detected=bool(detected))
            parts.append(f"{part.height} {kind}{'s' * (part.height > 1)}{_sizes(part['size_m'])} {response}")
    return ", ".join(parts)


def _sizes(size_m: pl.Series) -> str:
    largest_m = size_m.abs().max()
    if largest_m is None:
        return ""
    return _say("of_size" if len(size_m) == 1 else "of_sizes", largest_m)


def _response_words(rows: pl.DataFrame, *, detected: bool) -> str:
    """How the LDS responded to these faults: from the begin of the fault to the block."""
    if not detected:
        return _say("withstood")
    took_ns = (rows["t_negated"] - rows["t_onset"]).dt.total_nanoseconds().drop_nulls().to_list()
    return _say("negated_within", max(took_ns) / NS_PER_S) if took_ns else _say("negated")


def _wrong_acceptances(passages: pl.DataFrame) -> dict[tuple[str, int], Row]:
    """The wrong acceptance of each hazard with the largest location error."""
    wrong = passages.filter(
        (pl.col("status") == PassageStatus.ACCEPTED.value) & (pl.col("judgement") == Judgement.WRONG.value)
    )
    worst = wrong.drop_nulls("hazard_id").sort(pl.col("location_error_m").abs(), descending=True, nulls_last=True)
    rows = worst.unique(["solution", "hazard_id"], keep="first", maintain_order=True)
    return {(row["solution"], row["hazard_id"]): row for row in rows.iter_rows(named=True)}


def _badness(row: Row) -> tuple[Any, ...]:
    """Accepted ones first, then those that no monitor saw, those too late, the larger ones."""
    late = {False: 0, None: 1, True: 2}[row["within_budget"]]
    return (not row["accepted_ids"], row["detected"], late, -abs(row["size_m"] or 0.0), row["hazard_id"])


def _phrase(row: Row, wrong: Row | None) -> str:
    """`VB_JUMP_1B: VB04 accepted 303.6 m early; no monitor saw it`, or `VB_SHIFT: VB03 40 m late, not accepted; ...`.

    `wrong`: the worst of the wrong acceptances of the row; a balise is as far off as its own location error says,
    not as the fault at its largest.
    """
    what = f"{_hit(row)}, {_accepted(row)}" if wrong is None else _wrongly_accepted(row, wrong)
    return f"{row['hazard']}: {what}; {_detection(row)}{_in_use(row)}"


def _wrongly_accepted(row: Row, wrong: Row) -> str:
    error_m = wrong["location_error_m"]
    others = len(row["accepted_ids"] or []) - 1
    more = _say("more", others) if others > 0 else ""
    if error_m is None:
        return _say("wrongly_accepted", wrong["balise_id"]) + more
    return _say("accepted_early" if error_m > 0 else "accepted_late", wrong["balise_id"], abs(error_m)) + more


def _hit(row: Row) -> str:
    """The balises that it hit, how far off and to which side."""
    off = _off(row["size_m"], row["timing"])
    return " ".join(text for text in (_some(row["balise_ids"]) or _say("no_balise"), off) if text)


def _off(size_m: float | None, timing: Timing | str | None) -> str:
    """`502 m early`, `3 m off` where the side is not known, `late` where the size is not; nothing where neither is."""
    size = "" if size_m is None else f"{abs(size_m):.0f} m"
    side = "" if timing in (None, Timing.NONE) else str(timing)
    return " ".join(text for text in (size, side or "off" * bool(size)) if text)


def _accepted(row: Row) -> str:
    accepted = row["accepted_ids"] or []
    hit = row["balise_ids"] or []
    if not accepted:
        return _say("not_accepted")
    return _say("accepted") if set(accepted) == set(hit) else f"{_some(accepted)} {_say('accepted')}"


def _detection(row: Row) -> str:
    """Which monitor saw it, and how late; a drift against its failure, since its onset may be the alarm itself."""
    if not row["detected"]:
        return _say("unseen")
    since_failure_s = row["time_since_failure_s"]
    if row["rate_mps"] is not None and since_failure_s is not None:
        side = "seen_before_failure" if since_failure_s < 0.0 else "seen_after_failure"
        return _say(side, row["monitor"], abs(since_failure_s))
    late_s = row["time_to_detect_s"]
    return _say("seen", row["monitor"]) if late_s is None else _say("seen_after_onset", row["monitor"], late_s)


def _in_use(row: Row) -> str:
    """How long its position was in use, where that was too long."""
    return _say("in_use", row["hazardous_s"], row["budget_s"]) if row["within_budget"] is False else ""


def _some(names: Iterable[str] | None) -> str:
    """`VB03`, `VB03 VB04`, `VB03 to VB09 (7)`: as many as a line takes."""
    listed = list(names or [])
    return " ".join(listed) if len(listed) < 3 else f"{listed[0]} to {listed[-1]} ({len(listed)})"
