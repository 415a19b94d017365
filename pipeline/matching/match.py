"""The matching stage: positions of one solution on the track network."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.matching.chain import chain_path
from pipeline.matching.epochs import Assignment, epoch_frame
from pipeline.matching.fixes import Fixes, fixes_of
from pipeline.matching.path import TravelledPath
from pipeline.matching.residuals import biases
from pipeline.track import track_of
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.errors import InputError
from schemas.run import Site

AMBIGUOUS_COLUMNS: dict[str, pl.DataType | type[pl.DataType]] = {
    "t_start": pl.Datetime("ns", "UTC"),
    "t_end": pl.Datetime("ns", "UTC"),
    "netelement_id": pl.String,
    "other_netelement_id": pl.String,
    "probability": pl.Float64,
}


@dataclass(frozen=True)
class Match:
    """Epochs on the path, the path, cross-track biases per element, and stretches of doubt."""

    epochs: pl.DataFrame
    path: TravelledPath
    biases: pl.DataFrame
    ambiguous: pl.DataFrame


def match(
    fixes: pl.DataFrame,
    odometer: pl.DataFrame | None,
    site: Site,
    vehicle: Vehicle,
    config: MatchingConfig,
    fix_sigma: FixSigma,
    balise_reads: pl.DataFrame | None = None,
) -> Match:
    """Place one solution's epochs (ordered, unique `t`) on the site's track.

    `odometer` is the cleaned stream with `t, distance_m, speed_mps`, or none. Raises `InputError` where no
    epoch comes near any track.
    """
    arrays = fixes_of(fixes, fix_sigma)
    if not arrays.valid.any():
        raise InputError("no epoch has a position", place="gnss", expected="latitude, longitude and a fix")
    path, found = chain_path(arrays, odometer, track_of(site.track), site, config)
    epochs = epoch_frame(arrays, fixes["solution"], path, found, vehicle, config)
    return Match(epochs, path, biases(epochs), pl.DataFrame(schema=AMBIGUOUS_COLUMNS))


def certain(fixes: Fixes) -> Assignment:
    """One leg, no alternative."""
    ones = np.ones(len(fixes))
    return Assignment(np.zeros(len(fixes), dtype=np.int64), None, ones, ones)
