"""Survey errors that many runs reveal: elements off which the runs lie by more than both sigmas allow."""

from __future__ import annotations

from collections.abc import Iterable

import polars as pl

from schemas.config import Configuration

_DEFAULTS = Configuration()
_AXES = {"cross": ("cross_track_m", "sigma_cross_m"), "vertical": ("vertical_m", "sigma_up_m")}


def survey_findings(
    epochs: Iterable[pl.DataFrame], track: pl.DataFrame | None = None, config: Configuration = _DEFAULTS
) -> pl.DataFrame:
    """Residuals per net element and axis over many runs, those that do not fit their sigma marked.

    `epochs` holds `epochs` tables, one run each; `track`, where the site is at hand, gives the survey's own sigma;
    beyond `on_track_sigmas` an element is inconsistent. Columns: `netelement_id, axis (cross, vertical), runs,
    epochs, residual_m` (cross positive left of the element's own sense), `sigma_m` of that residual with the
    survey's, `ratio, inconsistent`. An antenna off the train's middle shows on all elements of a run, to opposite
    sides on runs in opposite directions.
    """
    passages = [_residuals_by_passage(frame, config) for frame in epochs]
    if not passages:
        return pl.DataFrame(schema=SURVEY_COLUMNS)
    survey = pl.DataFrame(schema={"netelement_id": pl.String, "survey_m2": pl.Float64})
    if track is not None:
        survey = track.group_by("netelement_id").agg((pl.col("sigma_m") ** 2).mean().alias("survey_m2"))
    weight = 1.0 / pl.col("variance_m2")
    merged = (
        pl.concat(passages)
        .group_by("netelement_id", "axis")
        .agg(
            pl.len().cast(pl.Int64).alias("runs"),
            pl.col("epochs").sum(),
            ((pl.col("residual_m") * weight).sum() / weight.sum()).alias("residual_m"),
            (1.0 / weight.sum()).alias("variance_m2"),
        )
        .join(survey, on="netelement_id", how="left")
    )
    variance = pl.col("variance_m2") + pl.col("survey_m2").fill_null(0.0)
    return (
        merged.with_columns(variance.sqrt().alias("sigma_m"))
        .with_columns((pl.col("residual_m").abs() / pl.col("sigma_m")).alias("ratio"))
        .with_columns((pl.col("ratio") > config.matching.on_track_sigmas).alias("inconsistent"))
        .sort("ratio", "netelement_id", "axis", descending=[True, False, False])
        .select(*SURVEY_COLUMNS)
    )


SURVEY_COLUMNS: dict[str, type[pl.DataType]] = {
    "netelement_id": pl.String,
    "axis": pl.String,
    "runs": pl.Int64,
    "epochs": pl.Int64,
    "residual_m": pl.Float64,
    "sigma_m": pl.Float64,
    "ratio": pl.Float64,
    "inconsistent": pl.Boolean,
}


def _residuals_by_passage(epochs: pl.DataFrame, config: Configuration) -> pl.DataFrame:
    """Median residual of one run on each element, with its variance.

    A passage shorter than `user_tau_s` is one observation, and so are several solutions: they share the sky, the
    antenna and mostly the ranges.
    """
    used = epochs.filter(pl.col("on_track") & pl.col("netelement_id").is_not_null())
    # The sense in which the run's path goes over the element, from where both positions grow.
    sense = pl.cov("measure_m", "path_m").sign().fill_null(1.0)
    seconds = (pl.col("t").max() - pl.col("t").min()).dt.total_nanoseconds() * 1e-9
    parts = []
    for axis, (residual, sigma) in _AXES.items():
        known = used.filter(pl.col(residual).is_not_null() & pl.col(sigma).is_not_null())
        turn = pl.when(sense < 0).then(-1.0).otherwise(1.0) if axis == "cross" else pl.lit(1.0)
        part = known.group_by("solution", "netelement_id").agg(
            pl.lit(axis).alias("axis"),
            pl.len().cast(pl.Int64).alias("epochs"),
            (pl.col(residual).median() * turn).alias("residual_m"),
            ((pl.col(sigma) ** 2).mean() / (1.0 + seconds / (2.0 * config.monitors.user_tau_s))).alias("variance_m2"),
        )
        parts.append(part)
    return (
        pl.concat(parts)
        .group_by("netelement_id", "axis")
        .agg(pl.col("epochs").sum(), pl.col("residual_m", "variance_m2").mean())
    )
