"""The Stanford diagram: error along the track against the confidence that was claimed for it."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.report.markup import Json

_BINS = 56


def stanford_data(epochs: pl.DataFrame, limit_m: float) -> Json:
    """Counts of epochs of known error on a square grid up to twice the limit; the last bin holds all beyond it."""
    known = epochs.select(error=pl.col("error_along_m").abs(), bound=pl.col("confidence_m")).drop_nulls()
    width = 2.0 * limit_m / _BINS
    cells = (
        known.select(
            x=(pl.col("error") / width).floor().clip(0, _BINS - 1).cast(pl.Int64),
            y=(pl.col("bound") / width).floor().clip(0, _BINS - 1).cast(pl.Int64),
        )
        .group_by("x", "y")
        .len("count")
        .sort("x", "y")
    )
    counts = np.array(cells["count"].to_list(), dtype=np.int64)
    return {
        "width_m": width,
        "bins": _BINS,
        "limit_m": limit_m,
        "cells": [list(row) for row in cells.iter_rows()],
        "epochs": int(counts.sum()),
    }
