"""Tables of a site from Parquet or CSV: columns found, converted and checked, every breach collected."""

from __future__ import annotations

import io
from dataclasses import dataclass
from enum import StrEnum

import polars as pl

from pipeline.ingest.csv_text import comments_of, epsg_in, read_table
from schemas.enums import BaliseKind, Navigability, Reaction

EPSG_WGS84 = 4326


@dataclass(frozen=True)
class RawTable:
    """A table as it stands in the file; `epsg` is what the file names, if it does."""

    file: str
    frame: pl.DataFrame
    epsg: int = EPSG_WGS84


@dataclass(frozen=True)
class Column:
    """What a column must be; `default` fills a column or cell that is absent (none: must be given)."""

    dtype: type[pl.DataType]
    required: bool = True
    nullable: bool = False
    default: str | float | bool | None = None
    low: float | None = None
    high: float | None = None
    words: type[StrEnum] | None = None


TRACK = {
    "netelement_id": Column(pl.String),
    "measure_m": Column(pl.Float64, required=False, nullable=True),
    "latitude_deg": Column(pl.Float64),
    "longitude_deg": Column(pl.Float64),
    "height_m": Column(pl.Float64, required=False, nullable=True, low=-1_000.0, high=10_000.0),
    "sigma_m": Column(pl.Float64, required=False, nullable=True, low=0.0),
}
LINKS = {
    "netelement_a": Column(pl.String),
    "position_a": Column(pl.Int64, low=0, high=1),
    "netelement_b": Column(pl.String),
    "position_b": Column(pl.Int64, low=0, high=1),
    "navigability": Column(pl.String, words=Navigability),
}
BALISES = {
    "balise_id": Column(pl.String),
    "netelement_id": Column(pl.String),
    "measure_m": Column(pl.Float64),
    "kind": Column(pl.String, words=BaliseKind),
    "location_accuracy_m": Column(pl.Float64, required=False, default=12.0, low=0.0, high=63.0),
    "linked": Column(pl.Boolean, required=False, default=True),
    "link_reaction": Column(pl.String, required=False, default=Reaction.SERVICE_BRAKE.value, words=Reaction),
}
ROUTE = {
    "netelement_id": Column(pl.String),
    "direction": Column(pl.String),
    "leg": Column(pl.Int64, required=False, default=0, low=0),
}


def load_table(file: str, data: bytes, breaches: list[str]) -> RawTable | None:
    """A Parquet or CSV file as it stands, or a breach."""
    try:
        return _parquet(file, data) if file.endswith(".parquet") else _csv(file, data)
    except (pl.exceptions.PolarsError, OSError, ValueError) as error:
        kind = "Parquet" if file.endswith(".parquet") else "CSV"
        breaches.append(f"{file}: is not readable as {kind} ({str(error).splitlines()[0]})")
        return None


def typed_table(raw: RawTable, columns: dict[str, Column], breaches: list[str]) -> pl.DataFrame | None:
    """The contract's columns with the contract's types, or breaches and none."""
    before = len(breaches)
    missing = [name for name, column in columns.items() if column.required and name not in raw.frame.columns]
    if missing:
        have = ", ".join(raw.frame.columns)
        breaches.append(f"{raw.file}: no column {', '.join(missing)}; found {have}")
        return None
    typed = [_typed(raw, name, column, breaches) for name, column in columns.items()]
    return pl.DataFrame(typed) if len(breaches) == before else None


def rows_text(mask: pl.Series) -> str:
    """Which rows, for a message: the first few, counted from 0 as in the table."""
    rows = mask.arg_true().to_list()
    shown = ", ".join(str(row) for row in rows[:3])
    return f"row {shown}" if len(rows) <= 3 else f"rows {shown} and {len(rows) - 3} more"


def _parquet(file: str, data: bytes) -> RawTable:
    import pyarrow.parquet

    metadata = pyarrow.parquet.read_schema(io.BytesIO(data)).metadata or {}
    named = {key.lower(): value for key, value in metadata.items()}.get(b"epsg")
    return _with_epsg(file, pl.read_parquet(io.BytesIO(data)), named.decode() if named else None)


def _csv(file: str, data: bytes) -> RawTable:
    return _with_epsg(file, read_table(data, infer=False), epsg_in(comments_of(data)))


def _with_epsg(file: str, frame: pl.DataFrame, named: str | None) -> RawTable:
    """The EPSG code from Parquet metadata or CSV comment, or from a column `epsg` of one value."""
    if named is None and "epsg" in frame.columns:
        values = frame["epsg"].drop_nulls().unique().to_list()
        if len(values) > 1:
            raise ValueError(f"column epsg: one code for the whole table, found {sorted(map(str, values))}")
        named = str(values[0]) if values else None
    if named is None:
        return RawTable(file, frame)
    digits = named.upper().removeprefix("EPSG:").strip()
    if not digits.isdigit():
        raise ValueError(f"epsg: a number such as 31370, found {named!r}")
    return RawTable(file, frame, int(digits))


def _typed(raw: RawTable, name: str, column: Column, breaches: list[str]) -> pl.Series:
    place = f"{raw.file}: column {name}"
    if name not in raw.frame.columns:
        return pl.Series(name, [column.default] * raw.frame.height, dtype=column.dtype)
    found = raw.frame[name]
    series = _converted(found, column.dtype)
    if series is None:
        breaches.append(f"{place}: found {found.dtype}, expected {column.dtype.__name__}")
        return pl.Series(name, [], dtype=column.dtype)
    unreadable = series.is_null() & found.is_not_null()
    if unreadable.any():
        breaches.append(f"{place}: not a {column.dtype.__name__} in {rows_text(unreadable)}")
    if column.default is not None:
        series = series.fill_null(column.default)
    _check_values(place, series, column, unreadable, breaches)
    return series.alias(name)


def _converted(series: pl.Series, dtype: type[pl.DataType]) -> pl.Series | None:
    """Values in the wanted type, null where one does not convert; none where the type cannot be meant."""
    if series.dtype == dtype or series.dtype == pl.Null:
        return series.cast(dtype)
    if dtype == pl.String:
        plain = series.dtype.is_integer() or isinstance(series.dtype, pl.Categorical | pl.Enum)
        return series.cast(pl.String) if plain else None
    if series.dtype == pl.String:
        stripped = series.str.strip_chars()
        if dtype != pl.Boolean:
            return stripped.cast(dtype, strict=False)
        truth = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}
        return stripped.str.to_lowercase().replace_strict(truth, default=None, return_dtype=pl.Boolean)
    if dtype == pl.Boolean or not series.dtype.is_numeric():
        return None
    whole = series.cast(pl.Float64)
    if dtype == pl.Int64:
        whole = pl.select(pl.when(whole == whole.floor()).then(whole)).to_series()
    return whole.cast(dtype, strict=False)


def _check_values(place: str, series: pl.Series, column: Column, unreadable: pl.Series, breaches: list[str]) -> None:
    empty = series.is_null() & ~unreadable
    if not column.nullable and empty.any():
        breaches.append(f"{place}: empty in {rows_text(empty)}")
    if column.dtype == pl.Float64:
        odd = (~series.is_finite()).fill_null(False)
        if odd.any():
            breaches.append(f"{place}: NaN or infinite in {rows_text(odd)}; leave a value that is not known empty")
    for limit, outside, word in ((column.low, series.__lt__, "below"), (column.high, series.__gt__, "above")):
        mask = outside(limit).fill_null(False) if limit is not None else None
        if mask is not None and mask.any():
            breaches.append(f"{place}: {series.filter(mask)[0]} is {word} {limit:g} in {rows_text(mask)}")
    if column.words is not None:
        allowed = [word.value for word in column.words]
        strange = ~series.is_in(allowed) & series.is_not_null()
        if strange.any():
            value = series.filter(strange)[0]
            breaches.append(f"{place}: {value!r} in {rows_text(strange)}; expected one of {', '.join(allowed)}")
