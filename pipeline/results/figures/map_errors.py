"""Map errors show over a campaign: the same place raises the cross or up monitors run after run (DOMAIN section 5)."""

from __future__ import annotations

import polars as pl

from schemas.campaign import CampaignMap
from schemas.conform import conform
from schemas.enums import Suspect, Verdict

_ACROSS = r"^(cross|up)_"


def map_suspects(alarms: pl.DataFrame, reach_m: float) -> pl.DataFrame:
    """Alarms of a campaign (with `run_id`) with `suspect` set to the map where it is due.

    Due are alarms of cross and up monitors only, not held against the position, that began within `reach_m` of
    such an alarm of another run on the same net element.
    """
    numbered = alarms.with_row_index("_row")
    due = pl.col("_row").is_in(_repeated_alarms(numbered, reach_m)["_row"].implode())
    kind = alarms.schema["suspect"]
    return numbered.with_columns(
        pl.when(due).then(pl.lit(Suspect.MAP.value, kind)).otherwise(pl.col("suspect")).alias("suspect")
    ).drop("_row")


def map_places(alarms: pl.DataFrame, reach_m: float) -> pl.DataFrame:
    """Places at which several runs raised such alarms (`campaign_map`), by net element and measure."""
    apart = (pl.col("measure_m").diff() > reach_m).fill_null(value=True)
    places = (
        _repeated_alarms(alarms.with_row_index("_row"), reach_m)
        .sort("netelement_id", "measure_m", "run_id", "solution", "_row")
        .with_columns(place=apart.over("netelement_id").cum_sum().over("netelement_id"))
        .group_by("netelement_id", "place", maintain_order=True)
        .agg(
            from_m=pl.col("measure_m").min(),
            to_m=pl.col("measure_m").max(),
            axis=pl.col("monitors").explode().str.extract(_ACROSS).unique().sort().str.join(" "),
            runs=pl.col("run_id").n_unique().cast(pl.Int64),
            solutions=pl.col("solution").unique().sort(),
            alarms=pl.len().cast(pl.Int64),
            run_ids=pl.col("run_id").unique().sort(),
        )
    )
    return conform(places, CampaignMap)


def _repeated_alarms(alarms: pl.DataFrame, reach_m: float) -> pl.DataFrame:
    """Alarms across the track alone, whose position is not proved wrong, near such an alarm of another run."""
    across = (pl.col("monitors").list.len() > 0) & pl.col("monitors").list.eval(
        pl.element().str.contains(_ACROSS)
    ).list.all()
    open_case = across & (pl.col("verdict") != Verdict.TRUE.value) & pl.col("measure_m").is_not_null()
    ordered = alarms.filter(open_case).sort("netelement_id", "measure_m", "run_id", "_row")
    # Among neighbours in order of place the nearest alarm of another run stands at the end of a block of one run.
    blocks = (
        ordered.with_columns(block=pl.struct("netelement_id", "run_id").rle_id())
        .group_by("block", maintain_order=True)
        .agg(pl.col("netelement_id").first(), first_m=pl.col("measure_m").first(), last_m=pl.col("measure_m").last())
        .with_columns(
            before_m=pl.col("last_m").shift(1).over("netelement_id"),
            after_m=pl.col("first_m").shift(-1).over("netelement_id"),
        )
        .select("block", "before_m", "after_m")
    )
    near = (pl.col("measure_m") - pl.col("before_m") <= reach_m) | (pl.col("after_m") - pl.col("measure_m") <= reach_m)
    return (
        ordered.with_columns(block=pl.struct("netelement_id", "run_id").rle_id())
        .join(blocks, on="block", how="left", maintain_order="left")
        .filter(near.fill_null(value=False))
        .select(alarms.columns)
    )
