"""CSV logs with a column mapping: the same `[ingest.STREAM]` tables as for MCAP, with columns for fields."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import dataframely as dy
import numpy as np
import polars as pl

from pipeline.make.receivers.csv_times import parse_instants, time_columns
from pipeline.read.ingest.conform import refuse
from pipeline.read.ingest.csv_text import CUT_ROW, read_log_table, with_decimal_points
from pipeline.read.ingest.mapping import mappings_of
from pipeline.read.ingest.mcap_records import Channel
from pipeline.read.ingest.parts import LogPart, mappings_for, parts_of_table
from pipeline.read.ingest.plan import Sample, Source, mapped_source
from pipeline.read.ingest.wraps import with_whole_counts, wrap_remarks
from pipeline.stages.epochs.clock import GAP_PERIODS
from schemas.config import IngestConfig, StreamMapping
from schemas.errors import InputError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, Stream

TABLES = (".csv", ".txt", ".tsv", ".dat", ".log")
_UNITS_ROW = "row of units"
_BEFORE = "line above the header"
_SHORT_ROW = "end of a row, which is missing (taken as empty)"
# What rows of a stream are for.
_VALUES: dict[Stream, tuple[str, ...]] = {
    "gnss": ("latitude_deg", "longitude_deg"),
    "odometer": ("distance_m", "speed_mps"),
    "reference": ("latitude_deg", "longitude_deg"),
    "balise_reads": ("balise_id",),
}
_FEWEST = 3  # positions that show a usual step


def maps_file(config: IngestConfig, path: Path) -> bool:
    """Whether some mapping is for this file; tables do not always end in `.csv`."""
    named = {mapping.topic for stream in STREAMS for mapping in mappings_of(config, stream)}
    return path.suffix.lower() in TABLES and bool(named & {path.name, path.stem})


class CsvLog(NamedTuple):
    """Streams of a table, what was left out, reason to number, and its columns."""

    streams: dict[Stream, pl.DataFrame]
    left: dict[str, int]
    parts: list[LogPart]


def read_csv(path: Path, config: IngestConfig) -> CsvLog:
    """A CSV file; each mapping whose `topic` is the file's name, its stem or `*` makes a stream, or a part of it."""
    log = read_log_table(path, infer=True)
    table = with_decimal_points(log)
    mappings = mappings_for(path, config)
    if not mappings:
        raise InputError(
            "no mapping for this file",
            place=str(path),
            found="columns " + ", ".join(table.columns),
            expected=f'a table [ingest.gnss] with topic = "{path.name}"',
            remedy="Give a mapping by --config; `balise inspect` of the file prints a draft.",
        )
    table = _with_ids(table, mappings, path)
    streams: dict[Stream, pl.DataFrame] = {}
    left = Counter({CUT_ROW: log.cut, _UNITS_ROW: int(bool(log.units)), _SHORT_ROW: log.short, _BEFORE: log.before})
    for name, mapping in mappings:
        mapped = _map_columns(table, mapping, name, path, left, config)
        frame = mapped.filter(_have_values(mapped, name, "fix" in mapping.fields))
        left[f"row without a value of {name}"] += mapped.height - frame.height
        streams[name] = pl.concat([streams[name], frame], how="diagonal") if name in streams else frame
    parts = parts_of_table(path.name, table.height, table.columns, mappings)
    return CsvLog(streams, {reason: count for reason, count in left.items() if count}, parts)


def _with_ids(table: pl.DataFrame, mappings: Sequence[tuple[Stream, StreamMapping]], path: Path) -> pl.DataFrame:
    """The table with ids as they are written: 007 is no number."""
    named = {
        recorded
        for stream, mapping in mappings
        for column, recorded in mapping.fields.items()
        if recorded in table.columns and isinstance(STREAM_SCHEMAS[stream].columns().get(column), dy.String)
    }
    ids = [name for name in table.columns if name in named and table[name].dtype != pl.String]
    if not ids:
        return table
    texts = read_log_table(path, infer=False).table
    return table.with_columns(texts[name].replace("", None) for name in ids)


def _have_values(frame: pl.DataFrame, stream: Stream, has_fix: bool) -> pl.Series:
    """Rows that hold something of a stream: tables of several recorders leave cells empty.

    An empty position may as well be an outage, which a kind of fix would say. Without one it is none where the
    positions around it follow each other.
    """
    every = pl.repeat(True, frame.height, eager=True)
    names = [name for name in _VALUES.get(stream, ()) if name in frame.columns]
    if not names:
        return every
    filled = frame.select(pl.any_horizontal(pl.col(names).is_not_null())).to_series()
    if stream != "gnss":
        return filled
    if filled.sum() < _FEWEST or filled.all():
        return every
    t_ns = frame["t"].to_physical().fill_null(0).to_numpy()
    at = np.sort(t_ns[filled.to_numpy()])
    steps = np.diff(at)
    after = at.searchsorted(t_ns).clip(1, at.size - 1)
    between = (t_ns > at[0]) & (t_ns < at[-1]) & (steps[after - 1] <= GAP_PERIODS * np.median(steps))
    return filled | has_fix | pl.Series(~between)


def _map_columns(
    table: pl.DataFrame, mapping: StreamMapping, stream: Stream, path: Path, left: Counter[str], config: IngestConfig
) -> pl.DataFrame:
    """A table in the columns of a stream, by its mapping."""
    if not mapping.time.startswith("field:"):
        raise InputError("a CSV has no log time", place=str(path), expected='time = "field:COLUMN"')
    kinds = {name: _kind_of_values(dtype) for name, dtype in table.schema.items()}
    sample = Sample(Channel(0, path.name, "csv", None, str(path)), kinds)
    absent = [name for name in time_columns(table, mapping) if name not in table.columns]
    first = mapping.time if absent else f"field:{time_columns(table, mapping)[0]}"
    source = mapped_source(sample, stream, mapping.model_copy(update={"time": first}))
    refuse(source.breaches)
    fields = pl.DataFrame([_cast_texts(table[name], source, path) for name in source.types])
    times = parse_instants(table, mapping, path)
    counter = mapping.fields.get("distance_m") if stream == "odometer" else None
    if counter in fields.columns:
        sensors = fields[mapping.fields["sensor"]] if "sensor" in mapping.fields else None
        t_ns = times.to_physical().fill_null(0).to_numpy()
        whole, found = with_whole_counts(fields[counter], t_ns, mapping.wrap, sensors, config.wraps)
        fields = fields.with_columns(whole) if found else fields
        left.update(wrap_remarks(found, counter))
    columns = {name: _without_nan(expression, fields) for name, expression in source.columns.items()}
    if stream in ("gnss", "satellites"):
        columns = {"solution": pl.lit(mapping.solution, dtype=pl.String)} | columns
    return pl.DataFrame({"t": times}).with_columns(fields.select(pl.lit(0).alias("t"), **columns).drop("t"))


def _kind_of_values(dtype: pl.DataType) -> str:
    """Kind of the values of a column, in the words of mappings."""
    if dtype.is_integer():
        return "int"
    return "float" if dtype.is_float() else "flag" if dtype == pl.Boolean else "text"


def _cast_texts(recorded: pl.Series, source: Source, path: Path) -> pl.Series:
    """Texts of a column in the type that its recipe names."""
    try:
        return recorded.cast(source.types[recorded.name])
    except pl.exceptions.PolarsError:
        wanted = ", ".join(name for name in source.columns if recorded.name in source.recipe.fields_of(name))
        unfit = recorded.cast(source.types[recorded.name], strict=False).is_null() & (recorded != "")
        row = int(unfit.arg_max() or 0)
        raise InputError(
            f"cannot be {wanted}",
            place=f"{path}: column {recorded.name}",
            found=f"{recorded[row]} in row {row + 1}, {unfit.sum()} rows of this kind",
            expected="numbers" if source.types[recorded.name].is_numeric() else "true or false",
            remedy="Correct these cells, or empty them where nothing is known.",
        ) from None


def _without_nan(expression: pl.Expr, fields: pl.DataFrame) -> pl.Expr:
    """The values without NaN: in a text that is how programs write that they have no value."""
    is_float = fields.lazy().select(expression.alias("value")).collect_schema()["value"].is_float()
    return expression.fill_nan(None) if is_float else expression
