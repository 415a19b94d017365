"""Classes of pieces by exact bounds over passes."""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from typing import Any

import numpy as np
import polars as pl

from pipeline.figures.bounds import clopper_pearson
from pipeline.line.pieces import Pieces
from pipeline.line.spans import FIRST_LOSS, State
from schemas.conform import conform
from schemas.line import LOSSES, LineCause, LineCriteria, LineDirection, LinePieces, PieceClass

# More passes than any line sees: a limit that needs more is not asked for by counting.
_MOST_PASSES = 10_000_000
KEYS = ["piece", "growing"]


def piece_classes(
    passes: pl.DataFrame, undetected: pl.DataFrame, pieces: Pieces, criteria: LineCriteria
) -> pl.DataFrame:
    """`LinePieces` of the passes of all runs (with `run_id`); `undetected`: `piece, largest_undetected_m`."""
    told = {(row["piece"], row["growing"]): row for row in _counted(passes, criteria).iter_rows(named=True)}
    errors = dict(undetected.select("piece", "largest_undetected_m").iter_rows())
    names = pieces.names
    rows = []
    for piece, name in enumerate(names):
        for growing in (True, False):
            place = {
                "piece": piece,
                "netelement_id": name,
                "from_m": float(pieces.from_m[piece]),
                "to_m": float(pieces.to_m[piece]),
                "direction": (LineDirection.GROWING if growing else LineDirection.FALLING).value,
                "largest_undetected_m": errors.get(piece),
            }
            rows.append({**place, **_judged(told.get((piece, growing), _NOTHING), criteria)})
    return conform(
        pl.DataFrame(
            rows,
            schema_overrides={"largest_undetected_m": pl.Float64, "passes_needed": pl.Int64},
            infer_schema_length=None,
        ),
        LinePieces,
    )


def trials(passes: pl.DataFrame, criteria: LineCriteria) -> pl.DataFrame:
    """Independent passes: each run, or the worst of a day."""
    if criteria.independent == "pass":
        return passes
    # Loss, then what the evidence should have shown, then right, then what says nothing.
    state = pl.col("state").replace_strict({int(State.UNKNOWN): 2, int(State.RIGHT): 1}, default=0)
    dated = passes.with_columns(
        day=pl.col("t").dt.date(), judged=pl.when(pl.col("state") >= int(FIRST_LOSS)).then(3).otherwise(state)
    )
    worst = dated.sort("judged", "state", "cause", descending=[True, True, False]).group_by(
        *KEYS, "day", maintain_order=True
    )
    claimed = dated.group_by(*KEYS, "day").agg(pl.col("claimed").any())
    return worst.first().drop("claimed").join(claimed, on=[*KEYS, "day"])


def _counted(passes: pl.DataFrame, criteria: LineCriteria) -> pl.DataFrame:
    state, cause = pl.col("state"), pl.col("cause")
    right, wrong = state == int(State.RIGHT), state == int(State.WRONG_IN_USE)
    lost = (state >= int(FIRST_LOSS)) & ~wrong
    hours = passes.filter(right).group_by(KEYS).agg(hours=pl.col("t").dt.hour().unique().sort())
    return (
        trials(passes, criteria)
        .group_by(KEYS)
        .agg(
            right=right.sum(),
            lost=lost.sum(),
            wrong_in_use=wrong.sum(),
            claimed_wrongly=pl.col("claimed").sum(),
            unknown=state.is_between(int(State.UNSEEN), int(State.UNKNOWN)).sum(),
            unjudged=(state == int(State.UNKNOWN)).sum(),
            after_alarm=(state == int(State.AFTER_ALARM)).sum(),
            wrong_track=(cause == LineCause.WRONG_TRACK.value).sum(),
            unsafe=(cause == LineCause.UNSAFE_ACCEPTANCE.value).sum(),
            days=pl.col("t").filter(right | lost | wrong).dt.date().n_unique(),
            monitors=pl.col("monitor").drop_nulls(),
            **{f"lost_{one.value}": (cause == one.value).sum() for one in LOSSES},
        )
        .join(hours, on=KEYS, how="left")
        .with_columns(pl.col("hours").fill_null([]))
    )


_NOTHING: dict[str, Any] = {
    **dict.fromkeys(("right", "lost", "wrong_in_use", "claimed_wrongly", "unknown", "unjudged"), 0),
    **dict.fromkeys(("after_alarm", "days", "wrong_track", "unsafe"), 0),
    **{f"lost_{one.value}": 0 for one in LOSSES},
    "hours": [],
    "monitors": [],
}


def _judged(counts: dict[str, Any], criteria: LineCriteria) -> dict[str, Any]:
    """Counts of one piece and direction with bounds and class: what was not judged counts against each bound."""
    bad = counts["lost"] + counts["wrong_in_use"]
    number = counts["right"] + bad
    unjudged = counts["unjudged"]
    low, high, unsafe = (
        clopper_pearson(events, number + unjudged, criteria.confidence)
        for events in (bad, bad + unjudged, counts["wrong_in_use"] + unjudged)
    )
    decided, cause = _class(counts, low.low, high.high, criteria)
    needed = None if decided is PieceClass.UNSUITABLE else passes_needed(bad + unjudged, number + unjudged, criteria)
    monitors = [name for name, _ in sorted(Counter(counts["monitors"]).items(), key=lambda one: (-one[1], one[0]))]
    return {
        **{name: counts[name] for name in _NOTHING if name not in ("wrong_track", "unsafe", "hours", "monitors")},
        "piece_class": decided.value,
        "cause": cause.value,
        "monitors": " ".join(monitors),
        "passes": number,
        "loss_share": bad / number if number else None,
        "loss_low": low.low,
        "loss_high": high.high,
        "unsafe_high": unsafe.high,
        "passes_needed": needed,
        "hours": len(counts["hours"]),
        "hours_of_day": " ".join(f"{hour:02d}" for hour in counts["hours"]),
    }


def _class(
    counts: dict[str, Any], low: float | None, high: float | None, criteria: LineCriteria
) -> tuple[PieceClass, LineCause]:
    """One wrong position in use decides; else the bounds of the share of passes lost."""
    if counts["wrong_in_use"] or counts["claimed_wrongly"]:
        return PieceClass.UNSUITABLE, _misleading_cause(counts)
    if low is not None and low > criteria.loss_limit:
        return PieceClass.UNSUITABLE, _most_lost(counts)
    if high is None or high > criteria.loss_limit:
        return PieceClass.UNKNOWN, _open_cause(counts)
    if len(counts["hours"]) < criteria.hours_least:
        return PieceClass.UNKNOWN, LineCause.FEW_HOURS
    return PieceClass.SUITABLE, LineCause.NONE


def _misleading_cause(counts: dict[str, Any]) -> LineCause:
    if counts["unsafe"]:
        return LineCause.UNSAFE_ACCEPTANCE
    if not counts["wrong_in_use"]:
        return LineCause.CLAIMED_WRONGLY
    return LineCause.WRONG_TRACK if counts["wrong_track"] else LineCause.WRONG


def _most_lost(counts: dict[str, Any]) -> LineCause:
    return max(LOSSES, key=lambda cause: int(counts[f"lost_{cause.value}"]))


def _open_cause(counts: dict[str, Any]) -> LineCause:
    if counts["unjudged"] > counts["lost"]:
        return LineCause.NOT_JUDGED
    if counts["lost"]:
        return _most_lost(counts)
    if counts["right"]:
        return LineCause.FEW_PASSES
    if counts["after_alarm"]:
        return LineCause.AFTER_ALARM
    return LineCause.NOT_JUDGED if counts["unknown"] else LineCause.NO_PASS


def passes_needed(bad: int, number: int, criteria: LineCriteria) -> int | None:
    """Further right passes until the upper bound of the share lost keeps the limit; None beyond all reason."""
    return _needed(bad, number, criteria.loss_limit, criteria.confidence)


@lru_cache(maxsize=4096)
def _needed(bad: int, number: int, limit: float, confidence: float) -> int | None:
    def kept(more: int) -> bool:
        high = clopper_pearson(bad, number + more, confidence).high
        return high is not None and high <= limit

    most = 1
    while not kept(most):
        most *= 2
        if most > _MOST_PASSES:
            return None
    # `kept` turns true once and stays so.
    low = -1
    while most - low > 1:
        middle = (low + most) // 2
        low, most = (low, middle) if middle >= 0 and kept(middle) else (middle, most)
    return most


def classes_array(table: pl.DataFrame, growing: bool) -> np.ndarray[Any, np.dtype[np.object_]]:
    """Class of each piece in one direction, in order of the pieces."""
    side = (LineDirection.GROWING if growing else LineDirection.FALLING).value
    return table.filter(pl.col("direction") == side).sort("piece")["piece_class"].cast(pl.String).to_numpy()
