"""Tables of a site from Parquet or CSV: columns found, converted and checked, every breach collected."""

from __future__ import annotations

import dataframely as dy
import polars as pl

from pipeline.read.ingest.conform import Defaults, conform_to, line_of, rows_text, type_name
from pipeline.read.ingest.csv_text import comments_of, epsg_in, read_table
from pipeline.storage.budget import most_unpacked
from pipeline.storage.parquet import metadata_of, read_parquet, unpacked_size
from schemas.config import IngestConfig
from schemas.enums import BaliseDirection, Reaction
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.inputs import SITE_SCHEMAS

EPSG_WGS84 = 4326


@frozen
class RawTable:
    """A table as it stands in the file; `epsg` is what the file names, if it does."""

    file: str
    frame: pl.DataFrame
    epsg: int = EPSG_WGS84


# What a site need not say of a balise (CONTRACT section 2), nor a route of its legs.
_DEFAULTS: Defaults = {
    "location_accuracy_m": 12.0,
    "linked": True,
    "link_reaction": Reaction.SERVICE_BRAKE.value,
    "direction": BaliseDirection.BOTH.value,
    "leg": 0,
}
# As recorded: an element without measures gets those of its geometry, and plane coordinates become degrees later.
_RECORDED: dict[str, dict[str, dy.Column]] = {
    "track": {
        "measure_m": dy.Float64(nullable=True),
        "latitude_deg": dy.Float64(nullable=False),
        "longitude_deg": dy.Float64(nullable=False),
    },
    "route": {"leg": dy.Int64(nullable=False, min=0)},
}
_TRUTH = {"true": True, "1": True, "yes": True, "false": False, "0": False, "no": False}


def load_table(file: str, data: bytes, breaches: list[str]) -> RawTable | None:
    """A Parquet or CSV file as it stands, or a breach."""
    try:
        if not file.endswith(".parquet"):
            return _with_epsg(file, read_table(data, infer=False), epsg_in(comments_of(data)))
        named = {name.lower(): value for name, value in metadata_of(data).items()}.get("epsg")
        if (size := unpacked_size(data)) > most_unpacked(len(data), IngestConfig()):
            raise ValueError(f"{len(data)} bytes unpack to {size // 2**20} MiB")
        return _with_epsg(file, read_parquet(data), named)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, ValueError) as error:
        kind = "Parquet" if file.endswith(".parquet") else "CSV"
        breaches.append(f"{file}: cannot be read as {kind} ({str(error).splitlines()[0]})")
        return None


def typed_table(raw: RawTable, table: str, breaches: list[str]) -> pl.DataFrame | None:
    """The contract's columns with the contract's types (words as text), or breaches and none."""
    columns = SITE_SCHEMAS[table].columns() | _RECORDED.get(table, {})
    errors: list[InputError] = []
    read = {
        name: _read_column(raw, name, column, errors) for name, column in columns.items() if name in raw.frame.columns
    }
    known = {name: column for name, column in columns.items() if name not in read or read[name] is not None}
    recorded = raw.frame.with_columns(series for series in read.values() if series is not None)
    frame = conform_to(known, recorded, raw.file, errors, _DEFAULTS)
    breaches += [line_of(breach) for breach in errors]
    return None if errors else frame.with_columns(pl.col(pl.Enum).cast(pl.String))


def _with_epsg(file: str, frame: pl.DataFrame, named: str | None) -> RawTable:
    """The EPSG code from Parquet metadata or CSV comment, or from a column `epsg` of one value."""
    if named is None and "epsg" in frame.columns:
        values = frame["epsg"].drop_nulls().unique().to_list()
        if len(values) > 1:
            raise ValueError(f"column epsg: found {sorted(map(str, values))}; expected one code for the whole table")
        named = str(values[0]) if values else None
    if named is None:
        return RawTable(file, frame)
    digits = named.upper().removeprefix("EPSG:").strip()
    if not digits.isdigit():
        raise ValueError(f"epsg: found {named!r}; expected a number such as 31370")
    return RawTable(file, frame, int(digits))


def _read_column(raw: RawTable, name: str, column: dy.Column, breaches: list[InputError]) -> pl.Series | None:
    """What stands as text in the type that it spells, identities that are numbers as text; none with a breach."""
    recorded = raw.frame[name]
    if isinstance(column, dy.String) and recorded.dtype.is_integer():
        return recorded.cast(pl.String)
    if recorded.dtype != pl.String or isinstance(column, dy.String | dy.Enum):
        return recorded
    texts = recorded.str.strip_chars()
    if isinstance(column, dy.Bool):
        series = texts.str.to_lowercase().replace_strict(_TRUTH, default=None, return_dtype=pl.Boolean)
    else:
        series = texts.cast(column.dtype, strict=False)
    unreadable = series.is_null() & recorded.is_not_null()
    if not unreadable.any():
        return series
    place = f"{raw.file}: column {name}"
    value = recorded.filter(unreadable)[0]
    where = f"{value!r} in {rows_text(unreadable)}"
    breaches.append(InputError("cannot be read", place=place, found=where, expected=type_name(column)))
    return None
