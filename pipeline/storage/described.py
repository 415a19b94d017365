"""Parquet files that say what they are, wherever they are sent."""

from __future__ import annotations

import io
from collections.abc import Mapping
from functools import lru_cache

import dataframely as dy
import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.storage.parquet import GroupedFile, metadata_of, parquet_bytes
from schemas.conform import meanings
from schemas.frozen import frozen
from schemas.tables import CONTRACT_VERSION

PREFIX = "balise."
"""Begins the names of this program's entries in the metadata of a file."""


def table_bytes(frame: pl.DataFrame, table: str, schema: type[dy.Schema], notes: Mapping[str, str]) -> bytes:
    """A table of a contract: its name, the version of the contract and `notes` in the file, meanings in the fields."""
    return noted_bytes(frame, {"table": table, "contract": CONTRACT_VERSION, **notes}, schema)


def noted_bytes(frame: pl.DataFrame, notes: Mapping[str, str], schema: type[dy.Schema] | None = None) -> bytes:
    """A frame as Parquet with notes in the metadata of the file."""
    named = {f"{PREFIX}{key}": value for key, value in notes.items()}
    return parquet_bytes(frame, named, None if schema is None else _of_fields(schema))


@lru_cache(maxsize=64)
def _of_fields(schema: type[dy.Schema]) -> dict[str, pa.KeyValueMetadata]:
    """Unit and meaning of each column of a contract, encoded once for all files."""
    return {name: pa.KeyValueMetadata(notes) for name, notes in meanings(schema).items()}


def notes_of(content: bytes) -> dict[str, str]:
    """What `noted_bytes` noted. Raises `ParquetError`."""
    return noted(metadata_of(content))


def noted(metadata: Mapping[str, str]) -> dict[str, str]:
    """This program's entries among those of a file."""
    return {key.removeprefix(PREFIX): value for key, value in metadata.items() if key.startswith(PREFIX)}


@frozen
class FileDescription:
    """What a file says of itself: rows, key-value metadata, and `column, dtype, unit, meaning` of its columns."""

    rows: int
    metadata: dict[str, str]
    columns: pl.DataFrame


def describe(content: bytes) -> FileDescription:
    """What a Parquet file of this program or another says of itself. Raises `ParquetError`.

    Its first rows are read to see whether they are whole, but not all: equal rows take hardly any room in a file.
    """
    file = GroupedFile(io.BytesIO(content))
    rows = np.cumsum([file.metadata.row_group(number).num_rows for number in range(file.metadata.num_row_groups)])
    file.read(range(int(np.searchsorted(rows, _MOST_READ, side="right"))))
    fields = pq.read_schema(pa.BufferReader(content))
    columns = [
        (name, _kind_text(kind), *_unit_and_meaning(fields.field(name))) for name, kind in file.columns().items()
    ]
    names = ("column", "dtype", "unit", "meaning")
    table = pl.DataFrame(columns, schema=dict.fromkeys(names, pl.String), orient="row")
    # The encoded schema is for programs. What comes first says what the file is.
    notes = {key: value for key, value in metadata_of(content).items() if key != "ARROW:schema"}
    first = [key for key in _FIRST if key in notes]
    metadata = {key: notes[key] for key in [*first, *sorted(notes.keys() - first)]}
    return FileDescription(file.metadata.num_rows, metadata, table)


_MOST_READ = 1_000_000  # rows
_FIRST = tuple(f"{PREFIX}{key}" for key in ("table", "run_id", "contract", "software"))


def _kind_text(kind: pl.DataType) -> str:
    """Kind of a value, as the dictionary says it."""
    if isinstance(kind, pl.Enum):
        return "enum " + " ".join(kind.categories)
    return f"list of {_kind_text(kind.inner)}" if isinstance(kind, pl.List) else str(kind)  # type: ignore[arg-type]


def _unit_and_meaning(field: pa.Field) -> tuple[str, str]:
    """Unit and meaning that a file notes in a field; empty where it notes none."""
    notes = field.metadata or {}
    return notes.get(b"unit", b"").decode(errors="replace"), notes.get(b"meaning", b"").decode(errors="replace")
