"""The reference stream on the network, by itself: the judge's witness (DOMAIN section 5.1).

It never sees a position of a solution, nor an odometer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.matching.match import Match, match
from schemas.arrays import flags, floats
from schemas.config import FixSigma, HazardConfig, MatchingConfig, Vehicle
from schemas.enums import Fix
from schemas.errors import InputError
from schemas.run import Site

# A variance of zero means "not known" in a `gnss` stream.
_LEAST_SIGMA_M = 1e-3


def match_reference(
    reference: pl.DataFrame,
    site: Site,
    config: MatchingConfig,
    hazards: HazardConfig,
    balise_reads: pl.DataFrame | None = None,
) -> Match | None:
    """Place the reference's samples (ordered, unique `t`) on the site's track, none where no sample comes near any.

    `reference` has `t, latitude_deg, longitude_deg, height_m, sigma_m`; where `sigma_m` is null,
    `reference_sigma_m` per axis holds. That sigma, and `reference_aside_m` at least, is also the bias of the run, and
    no sample lies farther beside its track than that allows. Balise reads are evidence like the reference itself: they
    prove net elements. A route holds only as far as the reference lies on it. Path positions and heights are those of
    the place that the reference gives, which is the GNSS antenna: the caller takes off its lever arm.
    """
    fixes = as_fixes(reference, hazards.reference_sigma_m)
    aside_m = max(float(np.median(np.sqrt(floats(fixes, "cov_ee_m2")))), hazards.reference_aside_m)
    own = config.model_copy(update={"cross_bias_sigma_m": aside_m, "on_track_bias_m": aside_m})
    sites = [site] if site.route is None else [site, replace(site, route=None)]
    found = [one for one in (_matched(fixes, own, each, balise_reads) for each in sites) if one is not None]
    # That with the most samples on the track.
    return max(found, key=lambda one: flags(one.epochs, "on_track").sum(), default=None)


def _matched(fixes: pl.DataFrame, own: MatchingConfig, site: Site, balise_reads: pl.DataFrame | None) -> Match | None:
    try:
        return match(fixes, None, site, Vehicle(), own, FixSigma(), balise_reads)
    except InputError:
        return None


def as_fixes(reference: pl.DataFrame, sigma_default_m: float) -> pl.DataFrame:
    """The samples as a `gnss` stream whose covariance is theirs."""
    variance = pl.col("sigma_m").fill_null(sigma_default_m).clip(lower_bound=_LEAST_SIGMA_M) ** 2
    return reference.select(
        "t",
        pl.lit("reference").alias("solution"),
        "latitude_deg",
        "longitude_deg",
        "height_m",
        variance.alias("cov_ee_m2"),
        pl.lit(0.0).alias("cov_en_m2"),
        variance.alias("cov_nn_m2"),
        variance.alias("cov_uu_m2"),
        pl.lit(Fix.RTK_FIXED.value, dtype=pl.Enum(Fix)).alias("fix"),
    )
