"""What the runs cannot say of the line."""

from __future__ import annotations

import polars as pl

from pipeline.studies.reservations import reservation_sentences, runs_without_truth, several_settings
from pipeline.studies.tally import trials_needed
from schemas.line import LineCriteria, LineDirection
from schemas.words import say

# So many net elements are named; the table has the rest.
_NAMED = 8


def line_remarks(
    runs: pl.DataFrame, passes: pl.DataFrame, table: pl.DataFrame, figures: pl.DataFrame, criteria: LineCriteria
) -> list[str]:
    """Sentences for people, the gravest limits first."""
    needed = trials_needed(0, 0, criteria.loss_limit, criteria.confidence)
    most = max(table["passes"].to_list(), default=0)
    few = needed is None or most < needed
    unserved = figures.height > 0 and figures["points"].max() and (figures["points_served"] < figures["points"]).any()
    never = say("line", "never_enough")
    numbers = {
        "too_few_passes": few and (most, needed or never, criteria.loss_limit),
        "by_day": criteria.independent == "pass",
    }
    rest = {
        "not_in_tables": True,
        "no_place": passes.is_empty(),
        "no_satellites": not passes.is_empty() and passes["satellites"].is_null().all(),
        "no_proposal": figures.is_empty(),
        "points_without_piece": unserved,
        "no_undetected": table["largest_undetected_m"].is_null().all(),
    }
    return [
        *runs_without_truth(runs, say("line", "blind")),
        *reservation_sentences("line", numbers),
        *_one_sided_remarks(table),
        *several_settings(runs, say("line", "trains")),
        *reservation_sentences("line", rest),
    ]


def _one_sided_remarks(table: pl.DataFrame) -> list[str]:
    """Sentences on net elements that runs passed in one direction only.

    A wrong track condemns both directions, whichever was run.
    """
    run = table.filter(pl.col("passes") > pl.col("lost_wrong_track"))
    sides = run.group_by("netelement_id", maintain_order=True).agg(pl.col("direction").unique())
    said = []
    for side, opposite in (tuple(LineDirection), tuple(reversed(LineDirection))):
        lone = sides.filter(pl.col("direction") == [opposite.value])["netelement_id"].to_list()
        more = say("line", "and_more", len(lone) - _NAMED) if len(lone) > _NAMED else ""
        if lone:
            said.append(say("line", "one_direction", side.value, ", ".join(lone[:_NAMED]), more))
    return said
