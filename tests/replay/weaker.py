"""What is better by less evidence: a `right` or `safe` that was not there before something was taken away.

Of what follows nothing can be judged without what was taken away, so it is left out of the comparison:

- a witness that contradicted others is gone, or too little of it is left to contradict: they stand as without it;
- a whole recorder whose clock differs from the others' is gone: nobody knows then that any clock may be off;
- evidence from one side of a read, 5 m + 5 % (DOMAIN section 5.1), is an assumption: a second read beyond, or the
  odometer that was counted on to it, may refute it and leave the hull of both sides;
- the odometer is what the train itself goes by: with less of it other positions are in use, and the verdict is theirs.
"""

from __future__ import annotations

from collections.abc import Sequence

import polars as pl

from schemas.run import RunTables
from tests.replay.crooked import OF_ODOMETER, WEAKER, reasons_of, verdict_of

_CONTRADICTED = {"evidence_disputed", "evidence_contradicted", "input_doubtful", "sigma_doubtful"}
_DECLARATIONS = ("undeclared", "open_survey")
_WHOLE_RECORDERS = ("no_reads", "no_reference")
# The same place, but for the rounding of a path found anew [m].
_SAME_M = 0.01
# Fewer samples measure the same lag a little otherwise: the interval is the same within so much [m].
_SAME_INTERVAL_M = 0.5
LIMIT_M = 20.0


def better_by_less(
    whole: RunTables, less: RunTables, loss: str, read_ns: Sequence[int], clocks_differ: bool = False
) -> list[str]:
    """Epochs placed alike in both that only the weaker one calls right, and a verdict that became `safe`.

    `loss`: of `WEAKER`; `read_ns`: times of the reads that are left; `clocks_differ`: a recorder stamps late.
    """
    assert loss in WEAKER
    before, after = (_CONTRADICTED & set(reasons_of(tables)) for tables in (whole, less))
    if before and not after and loss not in _DECLARATIONS:
        return []
    if clocks_differ and loss in _WHOLE_RECORDERS:
        return []
    found: list[str] = []
    gained = _gained(whole, less).filter(~_from_one_side(loss, read_ns))
    if gained.height:
        found.append(f"{gained.height} epochs right, the first at {gained['t'][0]}, was {gained['judgement'][0]}")
    if loss not in OF_ODOMETER and verdict_of(less) == "safe" and verdict_of(whole) != "safe":
        found.append(f"safe, was {verdict_of(whole)} by {reasons_of(whole)}")
    return found


def _gained(whole: RunTables, less: RunTables) -> pl.DataFrame:
    """Epochs of the same place that only the weaker run calls right, but for those at the edge of the limit."""
    epochs = whole.epochs.join(less.epochs, on=["t", "solution"], suffix="_less")
    alike = (pl.col("netelement_id") == pl.col("netelement_id_less")) & (
        (pl.col("measure_m") - pl.col("measure_m_less")).abs() < _SAME_M
    )
    reach_m = _reach_m("")
    at_the_edge = ((reach_m - LIMIT_M).abs() <= _SAME_INTERVAL_M) & (
        (reach_m - _reach_m("_less")).abs() <= _SAME_INTERVAL_M
    )
    gained = _is("judgement_less", "right") & ~_is("judgement", "right")
    return epochs.filter(alike, gained, ~at_the_edge.fill_null(value=False))


def _reach_m(suffix: str) -> pl.Expr:
    return pl.max_horizontal(pl.col(f"error_{end}_m{suffix}").abs() for end in ("low", "high"))


def _from_one_side(loss: str, read_ns: Sequence[int]) -> pl.Expr:
    """Epochs that the weaker run judges from one side of a read, as far as the loss may have made it so."""
    by_reads = _is("evidence_less", "balise")
    if loss in OF_ODOMETER:
        return by_reads
    between = pl.col("t").dt.timestamp("ns").is_between(min(read_ns, default=0), max(read_ns, default=0))
    return by_reads & ~between & (loss == "fewer_reads")


def _is(column: str, value: str) -> pl.Expr:
    return pl.col(column).cast(pl.String) == value
