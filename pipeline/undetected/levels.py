"""Bounds of the error itself, by monitors without memory: another solution, and the ranges.

A second solution that carries no fault shows it at once: the difference moves by it. A single range at fault shows in
the residuals, whose weighted sum of squares is a parabola over the fault: it stays below its threshold on an interval.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.monitors.single import paired
from pipeline.undetected.watched import Watched
from schemas.arrays import Floats, floats
from schemas.config import LdsConfig


def with_channel(
    rows: Watched, epochs: pl.DataFrame, channel: pl.DataFrame, other: pl.DataFrame | None, lds: LdsConfig
) -> Watched:
    """The rows with the bounds of the channel monitor, of a fault that the other solution has not.

    `channel`: `value, threshold` per epoch; `other`: as the channel monitor took it. Where the other solution has its
    epochs between two of this one, the comparison is with the position in between.
    """
    if other is None:
        return rows
    value, threshold = (floats(channel, name)[rows.epoch] for name in ("value", "threshold"))
    before = _share_before(epochs, other, lds)[rows.epoch]
    moving = before * rows.way_s
    ahead_m = moving * np.maximum(rows.most_mps - rows.rate_mps, 0.0)
    behind_m = moving * np.maximum(rows.rate_mps - rows.least_mps, 0.0)
    # The position in between is bounded only where the bank saw the step to the epoch.
    seen = ~rows.fresh & (np.diff(rows.epoch, prepend=-1) == 1)
    known = np.isfinite(value) & np.isfinite(threshold) & (seen | (before == 0.0))
    return bounded(
        rows,
        np.where(known, -threshold - value - behind_m, -np.inf),
        np.where(known, threshold - value + ahead_m, np.inf),
    )


def bounded(rows: Watched, low_m: Floats, high_m: Floats) -> Watched:
    """The rows with the fault held within these bounds too."""
    return replace(rows, low_m=np.maximum(rows.low_m, low_m), high_m=np.minimum(rows.high_m, high_m))


def _share_before(epochs: pl.DataFrame, other: pl.DataFrame, lds: LdsConfig) -> Floats:
    """How far before the epoch, as a share of the step to it, this solution was compared with the other."""
    placed = pl.when(pl.col("fix_valid") & pl.col("on_track") & pl.col("path_m").is_not_null())
    numbered = epochs.with_row_index("row").select("t", path_m=placed.then(pl.col("row").cast(pl.Float64)))
    met = paired(numbered, other.filter("fix_valid", "on_track"), lds)
    place = floats(met, "path_m")
    share: Floats = np.nan_to_num(np.arange(place.size) - place)
    return share
