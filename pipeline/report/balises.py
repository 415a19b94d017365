"""What became of each balise: right, lost, could not be checked, wrong; on the pages of runs and of the campaign."""

from __future__ import annotations

import polars as pl

from pipeline.report.columns import frame_table
from schemas.campaign import CampaignBalises
from schemas.enums import BaliseKind, Judgement, PassageStatus

OUTCOMES = ("read", "right", "lost", "unknown", "wrong")
"""From harmless to bad. `read`: a physical balise, which is evidence itself."""

_COLUMNS = (
    *("balise_id", "kind", "passages", "unsafe_accepted", "unsafe_rate", "unproven_accepted", "lost", "lost_share"),
    *("accepted", "accepted_judged", "deletions", "location_error_mean_m", "location_error_max_m"),
    *("netelement_id", "measure_m"),
)


def outcome() -> pl.Expr:
    """What became of a passage, of `OUTCOMES`."""
    return (
        pl.when(pl.col("status") != PassageStatus.ACCEPTED.value)
        .then(pl.lit("lost"))
        .when(pl.col("kind") == BaliseKind.PHYSICAL.value)
        .then(pl.lit("read"))
        .otherwise(pl.col("judgement").cast(pl.String).fill_null(Judgement.UNKNOWN.value))
    )


def lost_shares(balises: pl.DataFrame) -> pl.DataFrame:
    """`balises` as `campaign_balises`, with the passages at which each was not accepted, and their share."""
    lost = pl.col("passages") - (pl.col("passages") * pl.col("accepted_share")).round()
    shares = {
        f"lost_share{end}": 1.0 - pl.col(f"accepted_share{other}")
        for end, other in (("", ""), ("_low", "_high"), ("_high", "_low"))
    }
    return balises.with_columns(lost=lost.fill_null(0).cast(pl.Int64), **shares)


def balise_table(identity: str, caption: str, balises: pl.DataFrame) -> str:
    """`balises` as `lost_shares`; the worst first."""
    worst_first = ("unsafe_accepted", "unproven_accepted", "lost_share", "location_error_max_m")
    order = [True] * len(worst_first)
    shown = balises.sort(*worst_first, "balise_id", descending=[*order, False], nulls_last=True)
    return frame_table(identity, caption, shown, _COLUMNS, CampaignBalises)
