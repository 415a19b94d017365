"""Parquet with a checksum over every page: so it is written, and whatever has checksums is held against them.

Polars neither writes nor verifies them (2.1), so both go through pyarrow.
"""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

# Part of "the same bytes": none of these may follow a library's default.
_COMPRESSION_LEVEL = 3
_ROWS_PER_GROUP = 262_144
_BYTES_OF_A_VALUE = 8
# The length of the footer, and the four letters.
_TAIL = 8


class ParquetError(ValueError):
    """Content that is no Parquet file, or a damaged one; `str` is one line."""


def parquet_bytes(
    frame: pl.DataFrame,
    metadata: Mapping[str, str] | None = None,
    columns: Mapping[str, pa.KeyValueMetadata] | None = None,
) -> bytes:
    """A frame as Parquet with its metadata; the same content always gives the same bytes.

    `columns`: what stands in the fields beside what polars notes of its own types (enums).
    """
    notes = columns or {}
    group = _row_group(frame, 0)
    fields = [_noted(field, notes.get(field.name)) for field in group.schema]
    writer = GroupedWriter(pa.schema(fields, metadata=dict(sorted((metadata or {}).items())) or None), _ROWS_PER_GROUP)
    writer.add(pa.Table.from_arrays(group.columns, schema=writer.schema))
    # A row group at a time: the table is never there twice.
    for first in range(_ROWS_PER_GROUP, frame.height, _ROWS_PER_GROUP):
        writer.add(pa.Table.from_arrays(_row_group(frame, first).columns, schema=writer.schema))
    return writer.content()


def _noted(field: pa.Field, notes: pa.KeyValueMetadata | None) -> pa.Field:
    """The field with notes added to its metadata."""
    held = field.metadata
    return field if notes is None else field.with_metadata({**held, **notes} if held else notes)


def _row_group(frame: pl.DataFrame, first: int) -> pa.Table:
    """The rows of one row group, from `first` on, as Arrow."""
    return frame.slice(first, _ROWS_PER_GROUP).rechunk().to_arrow()


def encoded(table: pa.Table) -> bytes:
    """A table with its metadata as a file: what `as_written` gives becomes the bytes that it came from."""
    writer = GroupedWriter(table.schema, _ROWS_PER_GROUP)
    writer.add(table)
    return writer.content()


class GroupedWriter:
    """One Parquet file from tables of one schema, one below the other.

    A row group ends with a table, as soon as it has `rows_per_group`; a table that is longer fills several.
    """

    def __init__(self, schema: pa.Schema, rows_per_group: int) -> None:
        self.schema = schema
        self._rows_per_group = rows_per_group
        self._buffer = io.BytesIO()
        self._waiting: list[pa.Table] = []
        self._rows = 0
        self._writer = pq.ParquetWriter(
            self._buffer,
            schema,
            compression="zstd",
            compression_level=_COMPRESSION_LEVEL,
            use_dictionary=[field.name for field in schema if _has_dictionary(field.type)],
            write_page_checksum=True,
        )

    def add(self, table: pa.Table) -> None:
        """Take rows; written once they make a row group."""
        self._waiting.append(table)
        self._rows += table.num_rows
        if self._rows >= self._rows_per_group:
            self._flush()

    def content(self) -> bytes:
        """The whole file; nothing can be added then."""
        self._flush()
        self._writer.close()
        return self._buffer.getvalue()

    def _flush(self) -> None:
        """Write the tables that wait as row groups."""
        if self._waiting:
            self._writer.write_table(pa.concat_tables(self._waiting), self._rows_per_group)
        self._waiting = []
        self._rows = 0


def _has_dictionary(kind: pa.DataType) -> bool:
    """Whether columns of this type are written by dictionary: enums and texts."""
    return bool(pa.types.is_dictionary(kind) or pa.types.is_large_string(kind))


def as_written(source: bytes) -> pa.Table:
    """A whole table with the schema and the metadata that it was written with. Raises `ParquetError`."""
    with _reading():
        file = pq.ParquetFile(pa.BufferReader(source), page_checksum_verification=True)
        return file.read(use_threads=False).cast(written_schema(file.metadata))


def written_schema(metadata: pq.FileMetaData) -> pa.Schema:
    """The schema as its writer had it; reading renames the elements of lists and shuffles metadata."""
    kept = metadata.metadata or {}
    if b"ARROW:schema" not in kept:
        raise ValueError("was not written by this program")
    return pa.ipc.read_schema(pa.BufferReader(base64.b64decode(kept[b"ARROW:schema"])))


ColumnTypes = dict[str, pl.DataType]
Span = tuple[int, int]
"""The first row, and the one after the last."""

# A panic of polars is a BaseException: it has one for metadata of a column that is not UTF-8.
_ERRORS = (
    pa.ArrowException,
    pl.exceptions.PolarsError,
    pl.exceptions.PanicException,
    OSError,
    ValueError,
    OverflowError,
)


@contextmanager
def _reading() -> Iterator[None]:
    """Turns what pyarrow and polars raise into one error of one line."""
    try:
        yield
    except _ERRORS as error:
        raise ParquetError((str(error).strip().splitlines() or [type(error).__name__])[0]) from None


def read_parquet(source: bytes | Path, choose: Callable[[ColumnTypes], Sequence[str]] | None = None) -> pl.DataFrame:
    """The table; of all its columns and their types `choose` says which are read. Raises `ParquetError`."""
    reader = TableReader(choose)
    reader.add(source)
    return reader.frame()


class TableReader:
    """Tables of one kind from many files, one below the other: a frame of each would take most of the time.

    `choose` is asked of each kind of columns that comes which of them are read, in which order, and may refuse them.
    """

    def __init__(self, choose: Callable[[ColumnTypes], Sequence[str]] | None = None) -> None:
        self._choose = choose
        self._tables: list[pa.Table] = []
        self._kind: pa.Schema | None = None
        self._wanted: list[str] = []
        self.heights: list[int] = []

    def add(self, source: bytes | Path, metadata: pq.FileMetaData | None = None) -> None:
        """Read one more; `metadata`: its own, where it was read already. Raises `ParquetError`."""
        with _reading():
            place = pa.BufferReader(source) if isinstance(source, bytes) else source
            file = pq.ParquetFile(place, metadata=metadata, page_checksum_verification=True)
            kind = file.schema_arrow.remove_metadata()
            # What polars makes of a column stands in the field's metadata.
            if self._kind is None or not kind.equals(self._kind, check_metadata=True):
                self._wanted = self._names(kind)
                self._kind = kind
            self.heights.append(file.metadata.num_rows)
            if self._wanted:
                self._tables.append(file.read(columns=self._wanted).replace_schema_metadata(None))

    def frame(self) -> pl.DataFrame:
        """All that was read, in order. Raises `ParquetError`."""
        if not self._tables:
            return pl.DataFrame(height=sum(self.heights))
        with _reading():
            whole = self._tables[0] if len(self._tables) == 1 else pa.concat_tables(self._tables).combine_chunks()
            frame = pl.DataFrame(pl.from_arrow(whole))
            return frame if frame.columns == self._wanted else frame.select(self._wanted)

    def _names(self, kind: pa.Schema) -> list[str]:
        """Names of the columns to read. Raises `ValueError` where two columns have one name."""
        names = list(kind.names)
        if len(set(names)) < len(names):
            raise ValueError("two columns have the same name")
        return list(names if self._choose is None else self._choose(dict(_empty(kind).schema)))


def metadata_of(content: bytes) -> dict[str, str]:
    """The file's key-value metadata. Raises `ParquetError`."""
    return TableFile(content).notes


def unpacked_size(content: bytes) -> int:
    """What the table takes in memory at least, by the numbers of values that it declares [bytes].

    Values that are the same in every row take hardly anything in the file. Raises `ParquetError`.
    """
    file = TableFile(content)
    with _reading():
        return max(file.values, file.rows) * _BYTES_OF_A_VALUE


def read_footer(source: Path | IO[bytes]) -> bytes:
    """The bytes of the footer, which says where all else is and between which values it lies.

    Args:
        source: a Parquet file.

    Returns:
        The end of the file: metadata, their length, and the four letters.

    Raises:
        ParquetError: the file is cut short, or is none.
    """
    with _reading(), source.open("rb") if isinstance(source, Path) else nullcontext(source) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - _TAIL, 0))
        tail = file.read()
        length = int.from_bytes(tail[:4], "little") + _TAIL
        if size < length or tail[4:] != b"PAR1":
            raise ValueError("it is cut short")
        file.seek(size - length)
        return file.read()


def parse_footer(footer: bytes) -> pq.FileMetaData:
    """The metadata of a file by the bytes of its footer, as of `read_footer`. Raises `ParquetError`."""
    with _reading():
        return pq.read_metadata(pa.BufferReader(footer))


def without_checksums(content: bytes) -> bool:
    """Whether some column has no checksum, so that damage to it may go unnoticed. Raises `ParquetError`."""
    return TableFile(content).without_checksums


class TableFile:
    """One file in memory, whose metadata is read once. All of it raises `ParquetError`."""

    def __init__(self, content: bytes) -> None:
        self._content = content
        with _reading():
            self._metadata = pq.read_metadata(pa.BufferReader(content))

    @property
    def notes(self) -> dict[str, str]:
        """The key-value metadata."""
        metadata = self._metadata.metadata or {}
        return {name.decode(errors="replace"): value.decode(errors="replace") for name, value in metadata.items()}

    @property
    def rows(self) -> int:
        """How many rows the file declares: its size says nothing of that."""
        with _reading():
            return int(max(self._metadata.num_rows, sum(group.num_rows for group in self._groups())))

    @property
    def values(self) -> int:
        """How many values the file declares."""
        with _reading():
            return sum(part.num_values for group in self._groups() for part in self._parts(group))

    @property
    def without_checksums(self) -> bool:
        """Whether some column has no checksum, so that damage to it may go unnoticed."""
        if not self._metadata.num_rows:
            return False
        with _reading():
            parts = (part for group in self._groups() for part in self._parts(group))
            return not all(_has_crc(self._content[part.data_page_offset :][:32]) for part in parts)

    def frame(self, choose: Callable[[ColumnTypes], Sequence[str]] | None = None) -> pl.DataFrame:
        """The table; of all its columns and their types `choose` says which are read."""
        reader = TableReader(choose)
        reader.add(self._content, self._metadata)
        return reader.frame()

    def _groups(self) -> Iterator[pq.RowGroupMetaData]:
        """Metadata of each row group."""
        return (self._metadata.row_group(number) for number in range(self._metadata.num_row_groups))

    def _parts(self, group: pq.RowGroupMetaData) -> Iterator[pq.ColumnChunkMetaData]:
        """Metadata of each column in a row group."""
        return (group.column(number) for number in range(self._metadata.num_columns))


def _has_crc(head: bytes) -> bool:
    """Whether a page header (Thrift compact protocol) has its field 4, `crc`, after the three numbers before it."""
    at = 0
    for _ in range(3):  # type, size, compressed size: each the byte of a 32-bit field that follows, and a varint
        if at >= len(head) or head[at] != _NEXT_I32:
            return False
        at += 1
        while at < len(head) and head[at] & 0x80:
            at += 1
        at += 1
    return at < len(head) and head[at] == _NEXT_I32


_NEXT_I32 = 0x15


class GroupedFile:
    """A file of many row groups, of which those are read that hold the rows asked for."""

    def __init__(self, source: Path | IO[bytes], metadata: pq.FileMetaData | None = None) -> None:
        with _reading():
            self._file = pq.ParquetFile(
                source, metadata=metadata, page_checksum_verification=True, pre_buffer=not isinstance(source, Path)
            )
            self.metadata: pq.FileMetaData = self._file.metadata
            heights = [self.metadata.row_group(number).num_rows for number in range(self.metadata.num_row_groups)]
        # The first row of each group, and the one after the last.
        self._starts = np.cumsum([0, *heights])

    def columns(self) -> ColumnTypes:
        """All columns and their types. Raises `ParquetError`."""
        with _reading():
            return dict(_empty(self._file.schema_arrow.remove_metadata()).schema)

    def groups(self, spans: Sequence[Span]) -> list[int]:
        """The numbers of the row groups that hold these rows."""
        return sorted({number for span in spans for number in self._groups(span)})

    def _groups(self, span: Span) -> range:
        """Numbers of the row groups that hold the rows of a span."""
        if span[0] >= span[1]:
            return range(0)
        first, last = np.searchsorted(self._starts, [span[0], span[1] - 1], side="right") - 1
        return range(int(first), int(last) + 1)

    def read(self, groups: Sequence[int], columns: Sequence[str] | None = None) -> pa.Table:
        """Whole row groups, one below the other. Raises `ParquetError`."""
        with _reading():
            return self._file.read_row_groups(list(groups), columns=columns).replace_schema_metadata(None)

    def rows(self, spans: Sequence[Span], table: pa.Table, groups: Sequence[int]) -> pa.Table:
        """Rows of the spans, which are in order and apart, of a table that was read of these groups."""
        begins = np.cumsum([0, *(self._starts[number + 1] - self._starts[number] for number in groups)])
        before = {number: int(self._starts[number] - begins[place]) for place, number in enumerate(groups)}
        asked = [(span, before[self._groups(span)[0]]) for span in _merge_spans(spans)]
        parts = [table.slice(first - left_out, end - first) for (first, end), left_out in asked]
        return pa.concat_tables(parts) if parts else table.slice(0, 0)


def _merge_spans(spans: Sequence[Span]) -> list[Span]:
    """Spans that follow one another without a gap as one; empty ones left out."""
    joined: list[Span] = []
    for first, end in spans:
        if first == end:
            continue
        if joined and joined[-1][1] == first:
            first = joined.pop()[0]
        joined.append((first, end))
    return joined


def _empty(kind: pa.Schema) -> pl.DataFrame:
    """A frame without rows, of the columns and types that polars makes of a schema."""
    # Not `empty_table()`: through it pyarrow imports pandas, where that is installed, in every process.
    return pl.DataFrame(pl.from_arrow(pa.Table.from_batches([], kind)))
