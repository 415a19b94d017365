"""Classes of pieces by exact bounds over passes."""

from __future__ import annotations

from collections import Counter

import numpy as np
import polars as pl

from pipeline.studies.line.pieces import Pieces
from pipeline.studies.line.spans import FIRST_LOSS, SpanState
from pipeline.studies.tally import Compliance, share_shown
from schemas.conform import conform
from schemas.line import LOSSES, SHORT_OF_SATELLITES, LineCause, LineCriteria, LineDirection, LinePieces, PieceClass

KEYS = ["piece", "growing"]
_TRIALS = ["bad", "passes", "wrong_in_use", "unjudged"]
_SHOWN = {
    **dict.fromkeys(("loss_share", "loss_low", "loss_high", "unsafe_high"), pl.Float64),
    "passes_needed": pl.Int64,
    "finding": pl.String,
}


def piece_classes(
    passes: pl.DataFrame, undetected: pl.DataFrame, pieces: Pieces, criteria: LineCriteria
) -> pl.DataFrame:
    """`LinePieces` of the passes of all runs (with `run_id`); `undetected`: `piece, largest_undetected_m`."""
    places = pl.DataFrame(
        {
            "piece": np.arange(len(pieces.element)),
            "netelement_id": pieces.element_names,
            "from_m": pieces.from_m,
            "to_m": pieces.to_m,
        }
    ).join(pl.DataFrame({"growing": [True, False]}), how="cross")
    side = pl.when("growing").then(pl.lit(LineDirection.GROWING.value)).otherwise(pl.lit(LineDirection.FALLING.value))
    counted = (
        places.join(_count_per_piece(passes, criteria), on=KEYS, how="left", maintain_order="left")
        .join(undetected, on="piece", how="left", maintain_order="left")
        .with_columns(
            pl.col(pl.UInt32).cast(pl.Int64).fill_null(0),
            pl.col("monitors", "hours_of_day").fill_null(""),
            direction=side,
        )
        .with_columns(bad=pl.col("lost") + pl.col("wrong_in_use"))
        .with_columns(passes=pl.col("right") + pl.col("bad"))
    )
    return conform(_classify(counted, criteria), LinePieces)


def independent_passes(passes: pl.DataFrame, criteria: LineCriteria) -> pl.DataFrame:
    """Independent passes: each run, or the worst of a day."""
    if criteria.independent == "pass":
        return passes
    state = pl.col("state").replace_strict({int(SpanState.UNKNOWN): 2, int(SpanState.RIGHT): 1}, default=0)
    dated = passes.with_columns(
        day=pl.col("t").dt.date(), judged=pl.when(pl.col("state") >= int(FIRST_LOSS)).then(3).otherwise(state)
    )
    # Of passes as bad as each other the one with the fewest satellites, those without a number last.
    order = ("judged", "state", "cause", "satellites")
    falling = [True, True, False, False]
    worst = dated.sort(order, descending=falling, nulls_last=True).group_by(*KEYS, "day", maintain_order=True)
    claimed = dated.group_by(*KEYS, "day").agg(pl.col("claimed").any())
    return worst.first().drop("claimed").join(claimed, on=[*KEYS, "day"])


def _count_per_piece(passes: pl.DataFrame, criteria: LineCriteria) -> pl.DataFrame:
    """Counts per piece and direction; hours of the day are those of all right passes."""
    state = pl.col("state")
    cause = pl.col("cause")
    right = state == int(SpanState.RIGHT)
    wrong = state == int(SpanState.WRONG_IN_USE)
    lost = (state >= int(FIRST_LOSS)) & ~wrong
    # A receiver is compared with itself: what it used on the right passes of the run.
    usual = pl.col("satellites").filter(right).median().over("run_id")
    passes = passes.with_columns(few=pl.col("satellites") <= criteria.satellites_share * usual)
    hour = pl.col("t").dt.strftime("%H").unique()
    hours = passes.filter(right).group_by(KEYS).agg(hours=hour.len(), hours_of_day=hour.sort().str.join(" "))
    return (
        independent_passes(passes, criteria)
        .group_by(KEYS)
        .agg(
            right=right.sum(),
            lost=lost.sum(),
            wrong_in_use=wrong.sum(),
            claimed_wrongly=pl.col("claimed").sum(),
            unknown=state.is_between(int(SpanState.NOT_COVERED), int(SpanState.UNKNOWN)).sum(),
            unjudged=(state == int(SpanState.UNKNOWN)).sum(),
            after_alarm=(state == int(SpanState.AFTER_ALARM)).sum(),
            wrong_track=(cause == LineCause.WRONG_TRACK.value).sum(),
            unsafe=(cause == LineCause.UNSAFE_ACCEPTANCE.value).sum(),
            days=pl.col("t").filter(right | lost | wrong).dt.date().n_unique(),
            few_satellites=(pl.col("few") & lost).sum(),
            monitors=pl.col("monitor").drop_nulls(),
            **{f"lost_{loss.value}": (cause == loss.value).sum() for loss in LOSSES},
        )
        .with_columns(pl.col("monitors").map_elements(_most_frequent_first, return_dtype=pl.String))
        .join(hours, on=KEYS, how="left")
    )


def _most_frequent_first(names: pl.Series) -> str:
    """Names once each, the most frequent first."""
    return " ".join(name for name, _ in sorted(Counter(names).items(), key=lambda item: (-item[1], item[0])))


def _classify(counted: pl.DataFrame, criteria: LineCriteria) -> pl.DataFrame:
    """Pieces with bounds, class and cause: what was not judged counts against each bound."""
    cases = counted.select(_TRIALS).unique()
    rows = [
        _bounds_of_passes(bad, number, wrong, unjudged, criteria) for bad, number, wrong, unjudged in cases.iter_rows()
    ]
    shown = pl.DataFrame(rows, schema=_SHOWN, orient="row")
    judged = counted.join(pl.concat([cases, shown], how="horizontal"), on=_TRIALS, how="left", maintain_order="left")
    misleading = (pl.col("wrong_in_use") > 0) | (pl.col("claimed_wrongly") > 0)
    unsuitable = misleading | (pl.col("finding") == Compliance.NOT_MET.value)
    is_met = pl.col("finding") == Compliance.MET.value
    hours = pl.col("hours") >= criteria.hours_least
    piece_class = (
        pl.when(unsuitable)
        .then(pl.lit(PieceClass.UNSUITABLE.value))
        .when(is_met & hours)
        .then(pl.lit(PieceClass.SUITABLE.value))
        .otherwise(pl.lit(PieceClass.UNKNOWN.value))
    )
    return judged.with_columns(
        piece_class=piece_class,
        cause=_cause_expression(unsuitable, is_met, hours),
        passes_needed=pl.when(~unsuitable).then("passes_needed"),
    )


def _bounds_of_passes(bad: int, number: int, wrong: int, unjudged: int, criteria: LineCriteria) -> tuple[object, ...]:
    """Bounds, needed passes and findings of so many passes, in the order of `_SHOWN`."""
    lost = share_shown(bad, number, unjudged, criteria.loss_limit, criteria.confidence)
    unsafe = share_shown(wrong, number, unjudged, criteria.loss_limit, criteria.confidence)
    bounds = lost.bounds
    return bounds.value, bounds.low, bounds.high, unsafe.bounds.high, lost.needed, lost.finding.value


def _cause_expression(unsuitable: pl.Expr, shown: pl.Expr, hours: pl.Expr) -> pl.Expr:
    """Expression for what speaks most against a piece, the first that applies."""
    lost = pl.concat_list(f"lost_{loss.value}" for loss in LOSSES).list.arg_max()
    named = lost.replace_strict(dict(enumerate(loss.value for loss in LOSSES)), return_dtype=pl.String)
    few = named.is_in(SHORT_OF_SATELLITES) & (2 * pl.col("few_satellites") > pl.col("lost"))
    most_lost = pl.when(few).then(pl.lit(LineCause.FEW_SATELLITES.value)).otherwise(named)
    some = {
        name: pl.col(name) > 0 for name in ("unsafe", "wrong_in_use", "wrong_track", "lost", "right", "after_alarm")
    }
    order: list[tuple[pl.Expr, LineCause | pl.Expr]] = [
        (some["unsafe"], LineCause.UNSAFE_ACCEPTANCE),
        ((pl.col("claimed_wrongly") > 0) & ~some["wrong_in_use"], LineCause.CLAIMED_WRONGLY),
        (some["wrong_in_use"] & some["wrong_track"], LineCause.WRONG_TRACK),
        (some["wrong_in_use"], LineCause.WRONG),
        (unsuitable, most_lost),
        (shown & hours, LineCause.NONE),
        (shown, LineCause.FEW_HOURS),
        (pl.col("unjudged") > pl.col("lost"), LineCause.NOT_JUDGED),
        (some["lost"], most_lost),
        (some["right"], LineCause.FEW_PASSES),
        (some["after_alarm"], LineCause.AFTER_ALARM),
        (pl.col("unknown") > 0, LineCause.NOT_JUDGED),
    ]
    return pl.coalesce(
        *(pl.when(when).then(cause if isinstance(cause, pl.Expr) else pl.lit(cause.value)) for when, cause in order),
        pl.lit(LineCause.NO_PASS.value),
    )
