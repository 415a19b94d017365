"""What is better by less evidence: a `right` or `safe` that was not there before something was taken away."""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from schemas.run import RunTables
from tests.replay.crooked import reasons_of, verdict_of

# A witness that others contradict doubts what they say; taken away, they stand as they would without it.
_CONTRADICTED = ("evidence_disputed", "evidence_contradicted", "input_doubtful", "sigma_doubtful")
# The same place, but for the rounding of a path found anew [m].
_SAME_M = 0.01
# Fewer samples measure a lag a little otherwise: intervals within so much of the limit may change sides [m].
_EDGE_M = 1.0
LIMIT_M = 20.0


def better_by_less(whole: RunTables, less: RunTables, read_ns: Sequence[int]) -> list[str]:
    """Epochs placed alike in both that only the weaker one calls right, and a verdict that became `safe`.

    `read_ns`: times of the reads that are left. Before the first and after the last of them a balise read stands for
    5 m + 5 %, an assumption (DOMAIN section 5.1) that a second read beyond may refute: these epochs are not compared.
    """
    found: list[str] = []
    epochs = whole.epochs.join(less.epochs, on=["t", "solution"], suffix="_less")
    alike = (pl.col("netelement_id") == pl.col("netelement_id_less")) & (
        (pl.col("measure_m") - pl.col("measure_m_less")).abs() < _SAME_M
    )
    reaches_m = pl.max_horizontal(pl.col("error_low_m").abs(), pl.col("error_high_m").abs())
    clear = (reaches_m - LIMIT_M).abs() > _EDGE_M
    t_ns = pl.col("t").dt.timestamp("ns")
    between = t_ns.is_between(min(read_ns, default=0), max(read_ns, default=0))
    gained = epochs.filter(
        alike,
        clear,
        between | ~_is("evidence_less", "balise"),
        _is("judgement_less", "right"),
        ~_is("judgement", "right"),
    )
    if gained.height:
        found.append(f"{gained.height} epochs right, the first at {gained['t'][0]}, was {gained['judgement'][0]}")
    if verdict_of(less) == "safe" and verdict_of(whole) != "safe":
        found.append(f"safe, was {verdict_of(whole)} by {reasons_of(whole)}")
    return [] if set(reasons_of(whole)) & set(_CONTRADICTED) else found


def _is(column: str, value: str) -> pl.Expr:
    return pl.col(column).cast(pl.String) == value
