"""Positions of one solution on the path of another, so that the two can be compared (LOC Fig. 3).

Each solution has its own matched path. Where one of them began later, on another net element or in the other
direction, their path positions count from different places.
"""

from __future__ import annotations

import polars as pl

from pipeline.epochs.timeline import crossing_gap_ns
from schemas.arrays import times_ns
from schemas.config import LdsConfig

_PLACE = ("netelement_id", "measure_m", "path_m")


def on_path_of(epochs: pl.DataFrame, other: pl.DataFrame, lds: LdsConfig) -> pl.DataFrame:
    """The rows of `other` with `path_m` as it counts on the path of `epochs`; null where nothing joins the paths.

    Both in order of time with `t, netelement_id, measure_m, path_m`. On a net element that both are on at one time
    the measure says how far apart they are; elsewhere the paths stand to each other as they did there before (at
    the beginning: as they will).
    """
    mine, theirs = _with_sense(epochs), _with_sense(other).with_row_index("row")
    pairs = theirs.join_asof(
        mine, on="t_ns", strategy="nearest", tolerance=crossing_gap_ns(times_ns(epochs), lds), suffix="_mine"
    )
    together = (pl.col("netelement_id") == pl.col("netelement_id_mine")) & (pl.col("sense") * pl.col("sense_mine") != 0)
    turned = pl.col("sense") * pl.col("sense_mine")
    here_m = pl.col("path_m_mine") + pl.col("sense_mine") * (pl.col("measure_m") - pl.col("measure_m_mine"))
    placed = (
        pairs.with_columns(together=together.fill_null(value=False), turned=turned, here_m=here_m)
        .with_columns(
            turned=pl.when("together").then("turned"),
            start_m=pl.when("together").then(pl.col("here_m") - pl.col("turned") * pl.col("path_m")),
        )
        .with_columns(pl.col("turned", "start_m").forward_fill().backward_fill())
        .select("row", path_m=pl.col("start_m") + pl.col("turned") * pl.col("path_m"))
    )
    return other.with_columns(placed.sort("row")["path_m"])


def paired(epochs: pl.DataFrame, other: pl.DataFrame, lds: LdsConfig) -> pl.DataFrame:
    """For each epoch: `row_other`, the last of `other` since the epoch before, and `path_m`, where the train was then.

    Two receivers need not measure at the same times. Where they do, `path_m` is the epoch's own; else it lies between
    the positions of this epoch and the one before, if both have one and are no more than `crossing_gap_s` apart.
    Null where there is nothing to compare. `epochs` with `t, path_m` (null where not usable), `other` with `t`.
    """
    stamps = other.select(t_other=_stamp()).with_row_index("row_other")
    own = epochs.select("path_m", t_ns=_stamp())
    since = pl.col("t_ns") - pl.col("t_ns").shift(1)
    early = pl.col("t_ns") - pl.col("t_other")
    between = (early < since) & (since <= crossing_gap_ns(times_ns(epochs), lds))
    way = (pl.col("path_m") - pl.col("path_m").shift(1)) * (early / since)
    return (
        own.join_asof(stamps, left_on="t_ns", right_on="t_other", strategy="backward")
        .with_columns(path_m=pl.when(early == 0).then("path_m").when(between).then(pl.col("path_m") - way))
        .select("path_m", row_other=pl.when(pl.col("path_m").is_not_null()).then("row_other"))
    )


def _stamp() -> pl.Expr:
    return pl.col("t").to_physical()


def _with_sense(epochs: pl.DataFrame) -> pl.DataFrame:
    """Places with `sense`: +1 where the path runs with the measure of its net element, -1 against it; 0 where a
    visit does not tell.
    """
    own = [pl.col(name) - pl.col(name).mean().over("visit") for name in ("path_m", "measure_m")]
    placed = epochs.select(*_PLACE, t_ns=_stamp(), visit=pl.col("netelement_id").rle_id()).with_columns(
        moved=own[0] * own[1]
    )
    return placed.select("t_ns", *_PLACE, sense=pl.col("moved").sum().over("visit").sign().cast(pl.Int8))
