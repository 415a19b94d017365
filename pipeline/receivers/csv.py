"""CSV logs with a column mapping: the same `[ingest.STREAM]` tables as for MCAP, with columns for fields."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from pipeline.ingest.timescale import utc_from_gps
from schemas.config import IngestConfig, StreamMapping
from schemas.errors import InputError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS

_NS_PER_S = 1_000_000_000


def read_csv(path: Path, config: IngestConfig) -> dict[str, pl.DataFrame]:
    """Streams of a CSV file: each mapping whose `topic` is the file's name, its stem or `*` makes one."""
    try:
        table = pl.read_csv(path, infer_schema_length=None, try_parse_dates=False)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise InputError(f"is not a CSV file: {error}", place=str(path)) from None
    streams: dict[str, pl.DataFrame] = {}
    for name in STREAMS:
        for mapping in getattr(config, name, ()):
            if mapping.topic in (path.name, path.stem, "*"):
                frame = _mapped(table, mapping, name, path)
                streams[name] = pl.concat([streams[name], frame]) if name in streams else frame
    if not streams:
        raise InputError(
            "no mapping for this file",
            place=str(path),
            found="columns " + ", ".join(table.columns),
            expected=f'a table [ingest.gnss] with topic = "{path.name}"',
            remedy='Give --config with time = "field:COLUMN" and fields = {latitude_deg = "COLUMN", ...}.',
        )
    return streams


def _mapped(table: pl.DataFrame, mapping: StreamMapping, stream: str, path: Path) -> pl.DataFrame:
    column = mapping.time.removeprefix("field:")
    wanted = [column, *mapping.fields.values()]
    missing = [name for name in wanted if name not in table.columns]
    if missing or not mapping.time.startswith("field:"):
        raise InputError(
            "columns are missing" if missing else "a CSV has no log time",
            place=str(path),
            found="columns " + ", ".join(table.columns),
            expected=", ".join(missing) if missing else 'time = "field:COLUMN"',
        )
    schema = STREAM_SCHEMAS[stream]  # type: ignore[index]
    columns = [_times(table[column], mapping, path)]
    for name, definition in schema.columns().items():
        if name == "t":
            continue
        if name in mapping.fields:
            columns.append(_values(table[mapping.fields[name]], name, definition.dtype, mapping, path))
        else:
            constant = mapping.constants.get(name, mapping.solution if name == "solution" else None)
            columns.append(pl.Series(name, [constant] * table.height).cast(definition.dtype))
    return pl.DataFrame(columns)


def _values(recorded: pl.Series, name: str, dtype: pl.DataType, mapping: StreamMapping, path: Path) -> pl.Series:
    try:
        values = recorded.cast(dtype).alias(name)
    except pl.exceptions.PolarsError as error:
        raise InputError(f"cannot be {name}: {error}", place=f"{path}: column {recorded.name}") from None
    factor = mapping.factors.get(name)
    return values if factor is None else values * factor


def _times(recorded: pl.Series, mapping: StreamMapping, path: Path) -> pl.Series:
    """ISO 8601 text, or seconds since 1970; without a zone it is taken for UTC, or GPS time if so mapped."""
    try:
        if recorded.dtype == pl.String:
            stamps = recorded.str.to_datetime(time_unit="ns", strict=True).dt.timestamp("ns")
        else:
            stamps = (recorded * _NS_PER_S).round().cast(pl.Int64)
    except pl.exceptions.PolarsError as error:
        raise InputError(f"holds no times: {error}", place=f"{path}: column {recorded.name}") from None
    if mapping.time_scale == "gps":
        stamps = pl.Series(utc_from_gps(stamps.to_numpy()))
    return stamps.cast(pl.Datetime("ns", "UTC")).alias("t")
