"""Positions of one solution in WGS 84: as matched, their feet on the rails, and where the train was."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.results.places import GroundPositions, ground_of, offset_positions, sign_of, stretches_of
from schemas.arrays import floats
from schemas.config import HazardConfig
from schemas.frozen import frozen
from schemas.run import Site

_COVARIANCE = ("ee", "en", "eu", "nn", "nu", "uu")


@frozen
class ExportedPositions:
    """Frames of `t, latitude_deg, longitude_deg, height_m`, rows without a position left out.

    `gnss` is the corrected position that was matched (of the balise antenna, at its time of validity), `matched`
    its foot on the rails, `truth` where the evidence puts the train on the rails. Heights are those of the survey,
    null on a 2-D one.
    """

    gnss: pl.DataFrame
    matched: pl.DataFrame
    truth: pl.DataFrame


def positions_of(epochs: pl.DataFrame, site: Site) -> ExportedPositions:
    """Positions of one solution's epochs; the truth is the middle of what the evidence leaves of one net element."""
    column = {name: floats(epochs, name) for name in _NEEDED}
    rails = ground_of(site.track, epochs["netelement_id"], column["measure_m"])
    sign = sign_of(epochs, stretches_of(epochs))
    gnss = offset_positions(rails, sign, column["cross_track_m"], column["vertical_m"])
    low_m = column["true_measure_low_m"]
    high_m = column["true_measure_high_m"]
    middle_m = np.where(high_m - low_m <= 2.0 * HazardConfig().known_error_m, 0.5 * (low_m + high_m), np.nan)
    truth = ground_of(site.track, epochs["true_netelement_ids"].list.first(), middle_m)
    return ExportedPositions(
        _positions_frame(epochs["t"], gnss), _positions_frame(epochs["t"], rails), _positions_frame(epochs["t"], truth)
    )


_NEEDED = ("measure_m", "cross_track_m", "vertical_m", "true_measure_low_m", "true_measure_high_m")


def as_gnss(frame: pl.DataFrame) -> pl.DataFrame:
    """Positions in the columns of the `gnss` stream that position messages are made of; covariance not known."""
    unknown = [pl.lit(None, dtype=pl.Float64).alias(f"cov_{axes}_m2") for axes in _COVARIANCE]
    return frame.with_columns(*unknown, fix=pl.lit("estimated"))


def _positions_frame(t: pl.Series, ground: GroundPositions) -> pl.DataFrame:
    """Places with their times, without those that are not known."""
    columns = {
        "latitude_deg": ground.latitude_deg,
        "longitude_deg": ground.longitude_deg,
        "height_m": ground.height_m,
    }
    frame = pl.DataFrame({"t": t, **columns}).with_columns(pl.col(pl.Float64).fill_nan(None))
    return frame.filter(pl.col("latitude_deg").is_not_null() & pl.col("longitude_deg").is_not_null())
