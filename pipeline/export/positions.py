"""Where the train was by GNSS, by the match and by the truth, as positions of one solution of a run."""

from __future__ import annotations

from dataclasses import dataclass

import polars as pl

from pipeline.export.places import Ground, beside, ground_at, ground_of, sign_of, stretches_of
from schemas.arrays import floats
from schemas.run import Site

_COVARIANCE = ("ee", "en", "eu", "nn", "nu", "uu")


@dataclass(frozen=True)
class Positions:
    """Frames of `t, latitude_deg, longitude_deg, height_m`, rows without a position left out.

    `gnss` is the corrected position that was matched (of the balise antenna, at its time of validity), `matched`
    its foot on the rails, `truth` where the evidence puts the train on the rails. Heights are those of the survey,
    null on a 2-D one.
    """

    gnss: pl.DataFrame
    matched: pl.DataFrame
    truth: pl.DataFrame


def positions_of(epochs: pl.DataFrame, site: Site) -> Positions:
    """Positions of one solution's epochs. Truth is the path position less the error along it (CONTRACT section 3)."""
    column = {name: floats(epochs, name) for name in _NEEDED}
    rails = ground_of(site.track, epochs["netelement_id"], column["measure_m"])
    stretches = stretches_of(epochs)
    sign = sign_of(epochs, stretches)
    gnss = beside(rails, sign, column["cross_track_m"], column["vertical_m"])
    true_path = column["path_m"] - column["direction"] * column["error_along_m"]
    truth = ground_at(site.track, stretches, true_path)
    return Positions(_frame(epochs["t"], gnss), _frame(epochs["t"], rails), _frame(epochs["t"], truth))


_NEEDED = ("measure_m", "path_m", "cross_track_m", "vertical_m", "direction", "error_along_m")


def as_gnss(frame: pl.DataFrame) -> pl.DataFrame:
    """Positions in the columns of the `gnss` stream that position messages are made of; covariance not known."""
    unknown = [pl.lit(None, dtype=pl.Float64).alias(f"cov_{axes}_m2") for axes in _COVARIANCE]
    return frame.with_columns(*unknown, fix=pl.lit("estimated"))


def _frame(t: pl.Series, ground: Ground) -> pl.DataFrame:
    columns = {
        "latitude_deg": ground.latitude_deg,
        "longitude_deg": ground.longitude_deg,
        "height_m": ground.height_m,
    }
    frame = pl.DataFrame({"t": t, **columns}).with_columns(pl.col(pl.Float64).fill_nan(None))
    return frame.filter(pl.col("latitude_deg").is_not_null() & pl.col("longitude_deg").is_not_null())
