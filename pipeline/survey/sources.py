"""Which reader a survey needs, by its name."""

from __future__ import annotations

from pathlib import Path

from pipeline.survey.geojson_lines import read_geojson
from pipeline.survey.pieces import MOST_BYTES, Survey, with_own_names
from pipeline.survey.recorded import read_recorded
from pipeline.survey.tables import read_points
from pipeline.survey.xml_lines import read_kmz, read_xml
from schemas.config import Configuration, Vehicle
from schemas.errors import SiteError

_KINDS = "GPX, KML, KMZ, GeoJSON, CSV, Parquet, or a run (folder or .mcap) with a reference"


def read_surveys(paths: list[Path], epsg: int | None, vehicle: Vehicle, config: Configuration) -> Survey:
    """All pieces of all files, each under a name of its own. Raises `SiteError`, for a run `InputError`."""
    survey = Survey()
    for path in paths:
        survey.add(_read(path, epsg, vehicle, config))
    if not any(len(piece) > 1 for piece in survey.pieces):
        raise SiteError("holds no line", place=", ".join(map(str, paths)), expected="a line of two points or more")
    survey.pieces = with_own_names(survey.pieces)
    return survey


def _read(path: Path, epsg: int | None, vehicle: Vehicle, config: Configuration) -> Survey:
    suffix = path.suffix.lower()
    if path.is_dir() or suffix == ".mcap":
        return read_recorded(path, vehicle, config)
    place, data = str(path), content_of_survey(path)
    match suffix:
        case ".gpx" | ".kml":
            return read_xml(place, path.stem, data)
        case ".kmz":
            return read_kmz(place, path.stem, data)
        case ".geojson" | ".json":
            return read_geojson(place, path.stem, data)
        case ".csv" | ".txt" | ".parquet":
            return read_points(place, path.stem, data, epsg, config.site)
    raise SiteError("is no survey that is known", place=place, found=suffix or "no suffix", expected=_KINDS)


def content_of_survey(path: Path) -> bytes:
    """The file, unless it is too large to be one."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise SiteError("is too large", place=str(path), expected=f"at most {MOST_BYTES // 1_000_000} MB")
        return path.read_bytes()
    except OSError as error:
        raise SiteError(f"cannot be read: {error.strerror}", place=str(path)) from None
