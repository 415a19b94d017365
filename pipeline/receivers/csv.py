"""CSV logs with a column mapping: the same `[ingest.STREAM]` tables as for MCAP, with columns for fields."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from pipeline.ingest.breaches import refuse
from pipeline.ingest.csv_text import LogTable, read_log_table
from pipeline.ingest.mapping import mappings_of
from pipeline.ingest.mcap_model import Channel
from pipeline.ingest.plan import Sample, Source, mapped_source
from pipeline.receivers.csv_times import instants, time_columns
from schemas.config import IngestConfig, StreamMapping
from schemas.errors import InputError
from schemas.run import STREAMS, Stream

# Why a row was left out.
CUT_ROW = "row that breaks off at the end of the file"
TABLES = (".csv", ".txt", ".tsv", ".dat", ".log")
_UNITS_ROW = "row of units"
_COMMA_NUMBER = r"^\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*$"
_WHOLE_NUMBER = r"^\s*[+-]?\d+\s*$"
_THOUSANDS = r"^\s*[+-]?\d{1,3},\d{3}\s*$"


def names_file(config: IngestConfig, path: Path) -> bool:
    """Whether a mapping is for this file: tables do not always end in `.csv`."""
    named = {mapping.topic for stream in STREAMS for mapping in mappings_of(config, stream)}
    return path.suffix.lower() in TABLES and bool(named & {path.name, path.stem})


def read_csv(path: Path, config: IngestConfig) -> tuple[dict[Stream, pl.DataFrame], dict[str, int]]:
    """Streams of a CSV file, each mapping whose `topic` is the file's name, its stem or `*` makes one; what was left
    out, reason to number.
    """
    log = read_log_table(path, infer=True)
    table = with_points(log)
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
            remedy="Give a mapping by --config; `balise inspect` of the file prints a draft.",
        )
    left = {CUT_ROW: log.cut, _UNITS_ROW: int(bool(log.units))}
    return streams, {reason: count for reason, count in left.items() if count}


def with_points(log: LogTable) -> pl.DataFrame:
    """The table with decimal commas read as such: where no number of the file has a decimal point.

    Between commas, 1,234 in quotes is rather a thousand and more than one: such a file must have other fractions too.
    """
    texts = [name for name, dtype in log.table.schema.items() if dtype == pl.String]
    fractions = [name for name in texts if _all_numbers(log.table[name])]
    written = (
        pl.concat([log.table[name].drop_nulls() for name in fractions]) if fractions else pl.Series(dtype=pl.String)
    )
    with_comma = written.filter(written.str.contains(","))
    doubtful = log.separator == "," and with_comma.str.contains(_THOUSANDS).all()
    if any(dtype.is_float() for dtype in log.table.schema.values()) or doubtful:
        return log.table
    return log.table.with_columns(
        pl.col(fractions).replace("", None).str.replace(",", ".", literal=True).cast(pl.Float64)
    )


def _all_numbers(column: pl.Series) -> bool:
    """Whether every cell is a number, some of them with a comma."""
    cells = column.replace("", None).drop_nulls()
    with_comma = cells.str.contains(_COMMA_NUMBER)
    return bool(with_comma.any()) and bool((with_comma | cells.str.contains(_WHOLE_NUMBER)).all())


def _mapped(table: pl.DataFrame, mapping: StreamMapping, stream: Stream, path: Path) -> pl.DataFrame:
    if not mapping.time.startswith("field:"):
        raise InputError("a CSV has no log time", place=str(path), expected='time = "field:COLUMN"')
    kinds = {name: _kind(dtype) for name, dtype in table.schema.items()}
    sample = Sample(Channel(0, path.name, "csv", None, str(path)), kinds)
    absent = [name for name in time_columns(table, mapping) if name not in table.columns]
    first = mapping.time if absent else f"field:{time_columns(table, mapping)[0]}"
    source = mapped_source(sample, stream, mapping.model_copy(update={"time": first}))
    refuse(source.breaches)
    fields = pl.DataFrame([_typed(table[name], source, path) for name in source.types])
    columns = {name: _not_nan(expression, fields) for name, expression in source.columns.items()}
    if stream in ("gnss", "satellites"):
        columns = {"solution": pl.lit(mapping.solution, dtype=pl.String)} | columns
    times = instants(table, mapping, path)
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
