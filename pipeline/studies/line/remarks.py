"""What the runs cannot say of the line."""

from __future__ import annotations

from collections.abc import Iterator

import polars as pl

from pipeline.studies.reservations import runs_without_truth, several_settings
from pipeline.studies.trials import trials_needed
from schemas.line import LineCriteria, LineDirection

# So many net elements are named; the table has the rest.
_NAMED = 8
_BLIND = "nothing in them can show that a position was right, so they make no piece suitable."
_TRAINS = (
    "; their passes are counted together. Positions are those of the balise antenna: how a piece looks to the rest "
    "of a longer train is not known."
)


def remarks(
    runs: pl.DataFrame, passes: pl.DataFrame, table: pl.DataFrame, figures: pl.DataFrame, criteria: LineCriteria
) -> list[str]:
    """Sentences for people, the gravest limits first."""
    return [
        *runs_without_truth(runs, _BLIND),
        *_numbers(table, criteria),
        *_sides(table),
        *several_settings(runs, _TRAINS),
        "The tables hold neither train lengths nor C/N0: no cause is derived from them.",
        *_rest(passes, table, figures),
    ]


def _numbers(table: pl.DataFrame, criteria: LineCriteria) -> Iterator[str]:
    needed = trials_needed(0, 0, criteria.loss_limit, criteria.confidence)
    most = max(table["passes"].to_list(), default=0)
    if needed is None or most < needed:
        yield (
            f"Too few passes: a piece has {most} at most, and {needed or 'more than can be'} without a loss are needed "
            f"to show that no more than {criteria.loss_limit:.0%} are lost. Nothing can be suitable yet."
        )
    if criteria.independent == "pass":
        yield 'Passes of one day count as independent; `independent = "day"` counts them as one.'


def _sides(table: pl.DataFrame) -> Iterator[str]:
    """Net elements that runs passed in one direction only; a wrong track condemns both, whichever was run."""
    run = table.filter(pl.col("passes") > pl.col("lost_wrong_track"))
    sides = run.group_by("netelement_id", maintain_order=True).agg(pl.col("direction").unique())
    for side, opposite in (tuple(LineDirection), tuple(reversed(LineDirection))):
        lone = sides.filter(pl.col("direction") == [opposite.value])["netelement_id"].to_list()
        if lone:
            yield (
                f"No run in the direction of {side.value} measure on {', '.join(lone[:_NAMED])}"
                f"{f' and {len(lone) - _NAMED} more' if len(lone) > _NAMED else ''}: that direction is unknown there."
            )


def _rest(passes: pl.DataFrame, table: pl.DataFrame, figures: pl.DataFrame) -> Iterator[str]:
    if passes.is_empty():
        yield "No run has a place that the evidence knows on this site."
    elif passes["satellites"].is_null().all():
        yield "The runs do not say how many satellites were used: no cause is derived from that."
    if figures.is_empty():
        yield "No piece is suitable: there is nothing to propose."
    elif figures["points"].max() and (figures["points_served"] < figures["points"]).any():
        yield "Not every station or signal has a suitable piece near: see `points_served`."
    if table["largest_undetected_m"].is_null().all():
        yield "The largest undetected error is not in these tables (`balise replay --undetected` computes it)."
