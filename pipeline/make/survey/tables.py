"""Tables of points, CSV or Parquet, under the names that spreadsheets and surveyors give their columns."""

from __future__ import annotations

import re

import polars as pl

from pipeline.make.survey.pieces import COLUMNS, Survey, piece_of
from pipeline.read.ingest.guesses import SURVEY, word_of
from pipeline.read.site.read import to_wgs84
from pipeline.read.site.tables import EPSG_WGS84, RawTable, load_table
from schemas.config import SiteConfig
from schemas.errors import SiteError

_STATION = r"^(?<sign>[+-]?)(?<km>\d+)\s?\+\s?(?<m>\d{3}(?:\.\d+)?)$"
NUMBERS = ("latitude_deg", "longitude_deg", "height_m", "line_km", "sigma_m")


def read_points(place: str, stem: str, data: bytes, epsg: int | None, config: SiteConfig) -> Survey:
    """One piece per net element, in the order of the rows; one piece in all without a column for it."""
    table = placed_table(place, data, epsg, config)
    for name in ("latitude_deg", "longitude_deg"):
        if name not in table.columns:
            raise SiteError(
                "has no positions",
                place=place,
                found=f"columns {', '.join(table.columns)}",
                expected="latitude_deg and longitude_deg, or x_m and y_m with an EPSG code",
            )
        if (missing := table[name].is_null()).any():
            raise SiteError("has no value", place=f"{place}: column {name}: row {missing.arg_true()[0] + 1}")
    if "netelement_id" not in table.columns:
        table = table.with_columns(netelement_id=pl.lit(stem))
    survey = Survey()
    for (name,), part in table.group_by(["netelement_id"], maintain_order=True):
        columns = {key: part[key] for key in COLUMNS if key in part.columns}
        survey.pieces.append(piece_of(place, str(name), columns))
    return survey


def placed_table(place: str, data: bytes, epsg: int | None, config: SiteConfig) -> pl.DataFrame:
    """A table with the contract's column names, numbers as numbers, positions in WGS 84, line metres as kilometres.

    `epsg`: of x and y where the file does not say. Columns that are not known stay as they are. Raises `SiteError`.
    """
    breaches: list[str] = []
    raw = load_table(place, data, breaches)
    if raw is None:
        raise SiteError(breaches[0])
    table = _with_contract_names(place, raw.frame)
    known = (*NUMBERS, "x_m", "y_m", "line_m", "measure_m", "location_accuracy_m")
    table = table.with_columns(_parse_numbers(place, table[name]) for name in known if name in table.columns)
    if "line_m" in table.columns and "line_km" not in table.columns:
        table = table.with_columns(line_km=pl.col("line_m") / 1000)
    return _table_in_degrees(place, table, raw.epsg if raw.epsg != EPSG_WGS84 else epsg, config)


def _table_in_degrees(place: str, table: pl.DataFrame, epsg: int | None, config: SiteConfig) -> pl.DataFrame:
    """A table with coordinates in degrees, of whatever reference system."""
    if not {"x_m", "y_m"} <= set(table.columns) or "latitude_deg" in table.columns:
        return table
    if epsg is None:
        raise SiteError(
            "has x and y, but names no EPSG code",
            place=place,
            remedy="Write `# epsg: 31370` (yours) as its first line, or give --epsg.",
        )
    breaches: list[str] = []
    plane = RawTable(place, table, epsg)
    known = table["x_m"].is_not_null() & table["y_m"].is_not_null()
    named = table.filter(known).rename({"x_m": "longitude_deg", "y_m": "latitude_deg"})
    turned = to_wgs84(plane, named, config, breaches)
    if breaches or not known.all():
        raise SiteError(breaches[0] if breaches else f"{place}: row {(~known).arg_true()[0] + 1} has no x or no y")
    return turned


def _with_contract_names(place: str, frame: pl.DataFrame) -> pl.DataFrame:
    """A table with the names that surveys have here."""
    words = {name: word_of(name) for name in frame.columns}
    fitting = {name: [key for key, pattern in SURVEY.items() if re.fullmatch(pattern, words[name])] for name in words}
    meanings = {name: keys[0] for name, keys in fitting.items() if keys}
    twice = sorted({name for name in meanings.values() if list(meanings.values()).count(name) > 1})
    if twice:
        same = [name for name, meaning in meanings.items() if meaning in twice]
        raise SiteError("columns mean the same", place=place, found=", ".join(same), remedy="Keep one of them.")
    return frame.rename(meanings)


def _stations_to_km(text: pl.Series) -> pl.Series:
    """Kilometres and metres, `48+050` and `-0+120`, as kilometres."""
    table = text.str.strip_chars().str.extract_groups(_STATION).struct.unnest()
    sign, km, m = (table[name] for name in ("sign", "km", "m"))
    value = (km.cast(pl.Float64) + m.cast(pl.Float64) / 1000.0) * pl.select(
        pl.when(sign == "-").then(-1.0).otherwise(1.0)
    ).to_series()
    return value.cast(pl.String).fill_null(text).alias(text.name)


def _parse_numbers(place: str, column: pl.Series) -> pl.Series:
    """Numbers, with a decimal comma where no number of the column has a point."""
    if column.dtype != pl.String:
        return column.cast(pl.Float64)
    text = column.replace("", None)
    if not text.str.contains(".", literal=True).any():
        text = text.str.replace(",", ".", literal=True)
    if column.name == "line_km":
        text = _stations_to_km(text)
    values = text.cast(pl.Float64, strict=False)
    wrong = (values.is_null() & text.is_not_null()) | ~values.fill_null(0.0).is_finite()
    if wrong.any():
        row = int(wrong.arg_true()[0])
        where = f"{place}: column {column.name}: row {row + 1}"
        raise SiteError("cannot be read", place=where, found=repr(column[row]), expected="a number")
    return values
