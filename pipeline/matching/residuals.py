"""Constant cross-track biases per net element, kept apart from GNSS faults (DOMAIN section 2)."""

from __future__ import annotations

import polars as pl

# Median absolute deviation to standard deviation of a Gaussian: 1 / Phi^-1(3/4).
_MAD_TO_SIGMA = 1.4826


def biases(epochs: pl.DataFrame) -> pl.DataFrame:
    """Per element in order of travel: median cross-track residual [m], its scatter [m] by the median
    absolute deviation (a fault of less than half the epochs does not move either), number of epochs.

    Over a run, so it is for reports only: nothing that feeds detection may use it.
    """
    used = epochs.filter(pl.col("fix_valid") & pl.col("on_track"))
    deviation = (pl.col("cross_track_m") - pl.col("cross_track_m").median()).abs().median()
    return used.group_by("netelement_id", maintain_order=True).agg(
        pl.col("cross_track_m").median().alias("cross_bias_m"),
        (_MAD_TO_SIGMA * deviation).alias("cross_scatter_m"),
        pl.len().cast(pl.Int64).alias("epochs"),
    )
