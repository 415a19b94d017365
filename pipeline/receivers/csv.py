"""CSV logs with a column mapping: the same `[ingest.STREAM]` tables as for MCAP, with columns for fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from pipeline.ingest.breaches import refuse
from pipeline.ingest.csv_text import read_log_table
from pipeline.ingest.mapping import mappings_of
from pipeline.ingest.mcap_model import Channel
from pipeline.ingest.plan import Sample, Source, mapped_source
from pipeline.ingest.stamps import time_source
from pipeline.ingest.timescale import utc_from_gps
from schemas.config import IngestConfig, StreamMapping
from schemas.errors import InputError
from schemas.run import STREAMS, Stream

# Whole numbers below are seconds, above nanoseconds; between them lie milliseconds and microseconds. More seconds
# than these do not fit into nanoseconds.
_MOST_SECONDS, _LEAST_NANOSECONDS = 9 * 10**9, 10**17


# Why a row was left out.
CUT_ROW = "row that breaks off at the end of the file"


def read_csv(path: Path, config: IngestConfig) -> tuple[dict[Stream, pl.DataFrame], dict[str, int]]:
    """Streams of a CSV file, each mapping whose `topic` is the file's name, its stem or `*` makes one; what was left
    out, reason to number.
    """
    table, cut = read_log_table(path, infer=True)
    streams: dict[Stream, pl.DataFrame] = {}
    for name in STREAMS:
        for mapping in mappings_of(config, name):
            if mapping.topic in (path.name, path.stem, "*"):
                frame = _mapped(table, mapping, name, path)
                streams[name] = pl.concat([streams[name], frame], how="diagonal") if name in streams else frame
    if not streams:
        raise InputError(
            "no mapping for this file",
            place=str(path),
            found="columns " + ", ".join(table.columns),
            expected=f'a table [ingest.gnss] with topic = "{path.name}"',
            remedy='Give --config with time = "field:COLUMN" and fields = {latitude_deg = "COLUMN", ...}.',
        )
    return streams, {CUT_ROW: cut} if cut else {}


def _mapped(table: pl.DataFrame, mapping: StreamMapping, stream: Stream, path: Path) -> pl.DataFrame:
    if not mapping.time.startswith("field:"):
        raise InputError("a CSV has no log time", place=str(path), expected='time = "field:COLUMN"')
    kinds = {name: _kind(dtype) for name, dtype in table.schema.items()}
    sample = Sample(Channel(0, path.name, "csv", None, str(path)), kinds)
    source = mapped_source(sample, stream, mapping)
    refuse(source.breaches)
    fields = pl.DataFrame([_typed(table[name], source, path) for name in source.types])
    columns = {name: _not_nan(expression, fields) for name, expression in source.columns.items()}
    if stream in ("gnss", "satellites"):
        columns = {"solution": pl.lit(mapping.solution, dtype=pl.String)} | columns
    times = _times(table[mapping.time.removeprefix("field:")], mapping, path)
    return pl.DataFrame({"t": times}).with_columns(fields.select(pl.lit(0).alias("t"), **columns).drop("t"))


def _kind(dtype: pl.DataType) -> str:
    if dtype.is_integer():
        return "int"
    return "float" if dtype.is_float() else "flag" if dtype == pl.Boolean else "text"


def _typed(recorded: pl.Series, source: Source, path: Path) -> pl.Series:
    try:
        return recorded.cast(source.types[recorded.name])
    except pl.exceptions.PolarsError as error:
        wanted = ", ".join(name for name in source.columns if recorded.name in source.recipe.fields_of(name))
        reason = str(error).splitlines()[0]
        raise InputError(f"cannot be {wanted}: {reason}", place=f"{path}: column {recorded.name}") from None


def _not_nan(expression: pl.Expr, fields: pl.DataFrame) -> pl.Expr:
    """In a text, NaN is how programs write that they have no value."""
    is_float = fields.lazy().select(expression.alias("value")).collect_schema()["value"].is_float()
    return expression.fill_nan(None) if is_float else expression


def _times(recorded: pl.Series, mapping: StreamMapping, path: Path) -> pl.Series:
    """ISO 8601 text, which without a zone is taken for UTC (or GPS time if so mapped), or a number."""
    place = f"{path}: column {recorded.name}"
    try:
        if recorded.dtype != pl.String:
            return _counted(recorded, mapping, place)
        stamps = recorded.str.to_datetime(time_unit="ns", strict=True).dt.timestamp("ns")
    except pl.exceptions.PolarsError as error:
        raise InputError(f"holds no times: {str(error).splitlines()[0]}", place=place) from None
    if mapping.time_scale == "gps":
        stamps = pl.Series(utc_from_gps(stamps.fill_null(0).to_numpy())).set(stamps.is_null(), None)
    return stamps.cast(pl.Datetime("ns", "UTC"))


def _looks_like(count: int) -> str:
    """The unit in which a time since 1970 lies between 1985 and 2065."""
    near = [unit for unit, unit_s in (("milliseconds", 1e-3), ("microseconds", 1e-6)) if 5e8 < count * unit_s < 3e9]
    return f"; looks like {near[0]}" if near else ""


def _counted(recorded: pl.Series, mapping: StreamMapping, place: str) -> pl.Series:
    """Numbers: seconds, whole ones of 18 digits nanoseconds, and of another unit as `factors.t` says."""
    source = time_source((recorded.name,), {recorded.name: _kind(recorded.dtype)}, mapping)
    if recorded.dtype.is_integer() and source.unit_s is None:
        largest = int(np.abs(recorded.drop_nulls().to_numpy().astype(np.float64)).max(initial=0))
        if _MOST_SECONDS < largest < _LEAST_NANOSECONDS:
            raise InputError(
                f"time unit unknown{_looks_like(largest)}",
                place=place,
                found=str(largest),
                expected="seconds or nanoseconds",
                remedy="Give the seconds per unit: factors = { t = 1e-3 } for milliseconds.",
            )
        recorded = recorded * (1 if largest >= _LEAST_NANOSECONDS else 1_000_000_000)
    return source.instants(recorded.to_frame(), recorded.name)
