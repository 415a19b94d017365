"""The rows of packed runs: of each file of a pack the row groups that hold the runs asked for, and no others."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.results import packs
from pipeline.results.marker import sha256
from pipeline.results.packs import Pack, PackedRun
from pipeline.storage import files, parquet
from pipeline.storage.address import Address, join
from pipeline.storage.parquet import ColumnTypes, GroupedFile, ParquetError, Span, written_schema
from schemas.errors import InputError


class _File(NamedTuple):
    """One table of a pack, and the digest of the end of its file; a pack never changes."""

    out: str
    table: str
    name: str
    end: str


def read_rows(
    out: Address,
    table: str,
    runs: Mapping[str, PackedRun],
    columns: Sequence[str],
    check: Callable[[str, ColumnTypes], object],
) -> Iterator[tuple[dict[str, int], pl.DataFrame]]:
    """Columns of one table, pack by pack: how many rows each run has, and the rows, one run after the other.

    `check`, given a run, may refuse the columns that there are. Raises `UsageError` for a file that cannot be read.
    """
    for pack, rows in packs.by_pack(runs):
        file = _file_of(out, table, pack)
        spans = packs.index_of(out, pack).spans(table, rows.values())
        heights = {run_id: end - first for run_id, (first, end) in zip(rows, spans, strict=True)}
        check(next(iter(rows)), _column_types(file))
        if columns:
            yield heights, pl.DataFrame(pl.from_arrow(_read_rows(file, spans, columns))).select(columns)
        else:
            yield heights, pl.DataFrame(height=sum(heights.values()))


def table_of_run(out: Address, table: str, place: PackedRun) -> pa.Table:
    """The table of one run as `as_written` gives it."""
    return next(tables_as_written(out, table, place.pack, [place.row]))


def tables_as_written(out: Address, table: str, pack: Pack, rows: Sequence[int]) -> Iterator[pa.Table]:
    """The table of each of these runs with the schema that its own file had, without metadata."""
    file = _file_of(out, table, pack)
    spans = packs.index_of(out, pack).spans(table, rows)
    schema = written_schema(_read_footer(file)).remove_metadata()
    begin = 0
    whole = _read_rows(file, spans, None).cast(schema).drop_columns("run_id")
    for first, end in spans:
        yield whole.slice(begin, end - first)
        begin += end - first


def _file_of(out: Address, table: str, pack: Pack) -> _File:
    """The file of a table within a pack."""
    return _File(str(out), table, pack.name, pack.ends[table])


def _read_rows(file: _File, spans: Sequence[Span], columns: Sequence[str] | None) -> pa.Table:
    """Rows of a packed table."""
    try:
        source = _open_by_footer(file, _read_footer(file))
        numbers = source.groups(spans)
        if len(numbers) > 1:
            return source.rows(spans, source.read(numbers, columns), numbers)
        # Whoever asks for one run after the other finds the next ones in the same group.
        kept = _read_group(file, numbers[0], None if columns is None else tuple(columns)) if numbers else None
        return source.read([], columns) if kept is None else source.rows(spans, kept, numbers)
    except (ParquetError, InputError) as error:
        raise packs.unusable_error(file.out, packs.file_name(file.table, file.name), str(error)) from None


def _open_by_footer(file: _File, footer: pq.FileMetaData) -> GroupedFile:
    """A packed table, opened by its footer."""
    return GroupedFile(files.in_parts(join(file.out, packs.file_name(file.table, file.name))), footer)


@lru_cache(maxsize=32)
def _read_footer(file: _File) -> pq.FileMetaData:
    """What the end of the file says. Refuses the file of another result under the name of this one."""
    try:
        end = parquet.read_footer(files.in_parts(join(file.out, packs.file_name(file.table, file.name))))
        if sha256(end) != file.end:
            raise ParquetError("it is not the one that was packed")
        return parquet.parse_footer(end)
    except (ParquetError, InputError) as error:
        raise packs.unusable_error(file.out, packs.file_name(file.table, file.name), str(error)) from None


@lru_cache(maxsize=32)
def _column_types(file: _File) -> ColumnTypes:
    """Columns of a packed table, with their types."""
    return _open_by_footer(file, _read_footer(file)).columns()


@lru_cache(maxsize=16)
def _read_group(file: _File, number: int, columns: tuple[str, ...] | None) -> pa.Table:
    """One row group of a packed table."""
    return _open_by_footer(file, _read_footer(file)).read([number], columns)
