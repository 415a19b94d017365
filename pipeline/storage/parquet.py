"""Parquet with a checksum over every page: so it is written, and whatever has checksums is held against them.

Polars neither writes nor verifies them (2.1), so both go through pyarrow.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

# Part of "the same bytes": none of these may follow a library's default.
_COMPRESSION_LEVEL = 3
_ROWS_PER_GROUP = 262_144


class ParquetError(ValueError):
    """Content that is no Parquet file, or a damaged one; `str` is one line."""


def parquet_bytes(
    frame: pl.DataFrame,
    metadata: Mapping[str, str] | None = None,
    columns: Mapping[str, Mapping[str, str]] | None = None,
) -> bytes:
    """A frame as Parquet with its metadata; the same content always gives the same bytes.

    `columns`: what stands in the fields beside what polars notes of its own types (enums).
    """
    table = frame.rechunk().to_arrow()
    notes = columns or {}
    fields = [field.with_metadata({**(field.metadata or {}), **notes.get(field.name, {})}) for field in table.schema]
    schema = pa.schema(fields, metadata=dict(sorted((metadata or {}).items())) or None)
    buffer = io.BytesIO()
    pq.write_table(
        table.cast(schema),
        buffer,
        row_group_size=_ROWS_PER_GROUP,
        compression="zstd",
        compression_level=_COMPRESSION_LEVEL,
        use_dictionary=[name for name, kind in frame.schema.items() if kind in (pl.String, pl.Enum, pl.Categorical)],
        write_page_checksum=True,
    )
    return buffer.getvalue()


ColumnTypes = dict[str, pl.DataType]
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

    def add(self, source: bytes | Path) -> None:
        """Read one more. Raises `ParquetError`."""
        with _reading():
            place = pa.BufferReader(source) if isinstance(source, bytes) else source
            file = pq.ParquetFile(place, page_checksum_verification=True)
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
            return pl.DataFrame(pl.from_arrow(whole)).select(self._wanted)

    def _names(self, kind: pa.Schema) -> list[str]:
        names = list(kind.names)
        if len(set(names)) < len(names):
            raise ValueError("two columns have the same name")
        # Not `empty_table()`: through it pyarrow imports pandas, where that is installed, in every process.
        empty = pl.DataFrame(pl.from_arrow(pa.Table.from_batches([], kind)))
        return list(names if self._choose is None else self._choose(dict(empty.schema)))


def metadata_of(content: bytes) -> dict[str, str]:
    """The file's key-value metadata. Raises `ParquetError`."""
    with _reading():
        metadata = pq.read_metadata(pa.BufferReader(content)).metadata or {}
        return {name.decode(errors="replace"): value.decode(errors="replace") for name, value in metadata.items()}


def rows_of(content: bytes) -> int:
    """How many rows the file declares: its size says nothing of that. Raises `ParquetError`."""
    with _reading():
        metadata = pq.read_metadata(pa.BufferReader(content))
        groups = (metadata.row_group(number).num_rows for number in range(metadata.num_row_groups))
        return int(max(metadata.num_rows, sum(groups)))


def without_checksums(content: bytes) -> bool:
    """Whether some column has no checksum, so that damage to it may stay unseen. Raises `ParquetError`."""
    with _reading():
        metadata = pq.read_metadata(pa.BufferReader(content))
        groups = (metadata.row_group(number) for number in range(metadata.num_row_groups) if metadata.num_rows)
        parts = (group.column(number) for group in groups for number in range(metadata.num_columns))
        return not all(_has_crc(content[part.data_page_offset :][:32]) for part in parts)


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
