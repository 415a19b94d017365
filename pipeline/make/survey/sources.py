"""Which reader a survey needs, by its name; and the line of a run: its reference, else its RTK positions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from pipeline.make.receivers import as_run, gather
from pipeline.make.receivers.messages import UnknownError
from pipeline.make.survey.geojson_lines import read_geojson
from pipeline.make.survey.map_files import MAP_SUFFIXES, read_map
from pipeline.make.survey.pieces import Survey, content_of_survey, piece_of, with_own_names
from pipeline.make.survey.reachable import reachable_rows
from pipeline.make.survey.tables import read_points
from pipeline.make.survey.xml_lines import read_kmz, read_xml
from pipeline.read.ingest.run import read_run
from pipeline.stages.matching.epochs import fixes_of
from schemas.config import Configuration, Vehicle
from schemas.enums import Fix
from schemas.errors import SiteError
from schemas.run import RunLog

# A variance of zero means "not known" in a `gnss` stream.
_LEAST_SIGMA_M = 1e-3
_RECORDED = "Of a recorded drive: `balise convert LOG --out DRIVE`, then the same with --stream reference."
_KINDS = "GPX, KML, KMZ, GeoJSON, GeoPackage, Shapefile, FlatGeobuf, CSV, Parquet, a run, or a log of RTK"


def read_surveys(
    paths: list[Path], epsg: int | None, vehicle: Vehicle, config: Configuration, id_field: str | None = None
) -> Survey:
    """All pieces of all files, each under a name of its own. Raises `SiteError`, for a run `InputError`.

    `id_field`: attribute of maps that names the lines.
    """
    survey = Survey()
    for path in paths:
        survey.add(_read_survey(path, epsg, vehicle, config, id_field))
    if not any(len(piece) > 1 for piece in survey.pieces):
        raise SiteError("holds no line", place=", ".join(map(str, paths)), expected="a line of two points or more")
    if 0 < sum(piece.whole for piece in survey.pieces) < len(survey.pieces):
        raise SiteError(
            "holds net relations and stands beside lines without them",
            place=", ".join(map(str, paths)),
            expected="a network with its relations alone, or lines alone",
            remedy="Add the other lines and their relations to the network.",
        )
    survey.pieces = with_own_names(survey.pieces)
    return survey


def _read_survey(path: Path, epsg: int | None, vehicle: Vehicle, config: Configuration, id_field: str | None) -> Survey:
    """A survey of whatever form."""
    suffix = path.suffix.lower()
    if path.is_dir() or suffix == ".mcap":
        return read_recorded(path, vehicle, config)
    place = str(path)
    data = content_of_survey(path, config.survey)
    match suffix:
        case ".gpx" | ".kml":
            return read_xml(place, path.stem, data)
        case ".kmz":
            return read_kmz(place, path.stem, data, config.survey)
        case ".geojson" | ".json":
            return read_geojson(place, path.stem, data, config.site, id_field)
        case ".csv" | ".txt" | ".parquet":
            return read_points(place, path.stem, data, epsg, config.site)
        case _ if suffix in MAP_SUFFIXES:
            return read_map(path, data, config.survey, id_field)
    return _survey_of_receiver(path, vehicle, config)


def _survey_of_receiver(path: Path, vehicle: Vehicle, config: Configuration) -> Survey:
    """The line of a drive as a receiver recorded it."""
    try:
        run = as_run(gather([path], config.ingest), path.stem, correct=config.ingest.correct).run
    except UnknownError:
        found = path.suffix.lower() or "no suffix"
        raise SiteError(
            "is no survey that is known", place=str(path), found=found, expected=_KINDS, remedy=_RECORDED
        ) from None
    return _survey_of_run(run, path, vehicle, config)


def read_recorded(path: Path, vehicle: Vehicle, config: Configuration) -> Survey:
    """One recorded piece; heights are those of the rail where the vehicle file says how high the antenna is.

    Raises `InputError` where the run cannot be read, `SiteError` where it has no position better than GNSS alone.
    """
    return _survey_of_run(read_run(str(path), config.ingest, with_digest=False), path, vehicle, config)


def _survey_of_run(run: RunLog, path: Path, vehicle: Vehicle, config: Configuration) -> Survey:
    """A survey from the positions of a recorded run."""
    points = run.reference
    if points is None:
        fixed = run.gnss.filter(pl.col("fix").cast(pl.String) == Fix.RTK_FIXED.value)
        sigma_m = ((pl.col("cov_ee_m2") + pl.col("cov_nn_m2")) / 2).sqrt()
        first = fixed["solution"].unique().sort().head(1)
        points = fixed.filter(pl.col("solution").is_in(first.implode())).with_columns(sigma_m=sigma_m)
    points = points.drop_nulls(["latitude_deg", "longitude_deg"]).sort("t")
    if points.height < 2:
        expected = "a stream `reference`, or positions with fix `rtk_fixed`"
        raise SiteError("has no position better than GNSS alone", place=str(path), expected=expected)
    survey = Survey()
    fixes = fixes_of(_as_fixes(points, config.hazards.reference_sigma_m), config.fix_sigma)
    reached = reachable_rows(fixes)
    if (jumped := points.height - len(reached)) > 0:
        text = f"{jumped} positions to which no train can have come are left out"
        survey.report("warning", f"track: {run.run_id}", text, "Look at the recording there.")
    points = points[reached]
    height = points["height_m"].fill_null(np.nan) - vehicle.antenna_height_m
    columns = {"latitude_deg": points["latitude_deg"], "longitude_deg": points["longitude_deg"], "height_m": height}
    survey.pieces.append(piece_of(str(path), run.run_id, {**columns, "sigma_m": points["sigma_m"]}, recorded=True))
    if "antenna_height_m" not in vehicle.model_fields_set and points["height_m"].null_count() < points.height:
        text = "heights are those of the antenna: the vehicle file does not say how high it is over the rail"
        survey.report("warning", f"track: {run.run_id}", text, "Give --vehicle with antenna_height_m.")
    return survey


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
