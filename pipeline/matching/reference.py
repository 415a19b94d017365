"""The reference stream on the network, by itself: the judge's witness (DOMAIN section 5.1).

It never sees a position of a solution, nor an odometer.
"""

from __future__ import annotations

import polars as pl

from pipeline.matching.match import Match, match
from schemas.config import FixSigma, MatchingConfig, Vehicle
from schemas.enums import Fix
from schemas.errors import InputError
from schemas.run import Site

# A variance of zero means "not known" in a `gnss` stream.
_LEAST_SIGMA_M = 1e-3


def match_reference(
    reference: pl.DataFrame,
    site: Site,
    config: MatchingConfig,
    sigma_default_m: float,
    balise_reads: pl.DataFrame | None = None,
) -> Match | None:
    """Place the reference's samples (ordered, unique `t`) on the site's track, none where no sample comes near any.

    `reference` has `t, latitude_deg, longitude_deg, height_m, sigma_m`; where `sigma_m` is null, `sigma_default_m` [m]
    per axis holds. That sigma is also the bias of the run. Balise reads are evidence like the reference itself: they
    prove net elements. Path positions and heights are those of the place that the
    reference gives, which is the GNSS antenna: the caller takes off its lever arm.
    """
    fixes = _as_fixes(reference, sigma_default_m)
    typical_m = fixes["cov_ee_m2"].sqrt().median()
    own = config.model_copy(update={"cross_bias_sigma_m": typical_m})
    try:
        return match(fixes, None, site, Vehicle(), own, FixSigma(), balise_reads)
    except InputError:
        return None


def _as_fixes(reference: pl.DataFrame, sigma_default_m: float) -> pl.DataFrame:
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
