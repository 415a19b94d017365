"""Runs into packs, and out of them again: nothing is removed before what replaces it is whole and counts."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence

import polars as pl
import pyarrow as pa

from pipeline import storage
from pipeline.results import packed_tables, packs, store
from pipeline.results.manifest import digests_in_marker
from pipeline.results.marker import NAME as MARKER
from pipeline.results.marker import Marker, sha256
from pipeline.results.packs import Pack, PackedRun
from pipeline.results.workers import each_in_processes
from pipeline.storage import parquet
from pipeline.storage.address import Address, join
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.tables import TABLES

RUNS_PER_PACK = 2000
# Of what goes into a pack, as its runs' own files [bytes]: it is written in memory.
_LARGEST_PACK = 256 * 2**20
# Few enough that a run is found in little, many enough that the heads of the groups stay small.
_ROWS_PER_GROUP = 16_384
_RUNS_AT_ONCE = 32
# Hexadecimal digits of the name of a pack.
_NAME = 16


class _UnfitError(Exception):
    """The run cannot be packed; `str` says why."""


@frozen
class _Step:
    """What one pack is made of: runs of one build of the program."""

    out: str
    software_digest: str
    runs: tuple[str, ...]


@frozen
class Packed:
    """A pack that was written, if any, and the runs in it; `left_out`: those that cannot be packed, and why."""

    pack: Pack | None
    runs: tuple[str, ...]
    left_out: Mapping[str, str]


def pack_runs(out: Address, runs_per_pack: int, jobs: int) -> Iterator[tuple[Packed, int]]:
    """Pack all runs that have files of their own: each pack as soon as it counts, and how many runs there are to do.

    A pack with runs that were replayed since, and one that is less than half full, is taken apart first.
    """
    _take_apart(out, runs_per_pack)
    steps = list(_plan_packs(out, runs_per_pack))
    total = sum(len(step.runs) for step in steps)
    for packed in each_in_processes(_write_pack, steps, jobs):
        if packed.pack is not None:
            packs.write_list(out, [*packs.read_list(out), packed.pack])
            store.remove_own(out, packed.runs)
        yield packed, total
    packs.sweep(out)


def _take_apart(out: Address, runs_per_pack: int) -> None:
    """Take packs apart that hold runs replayed since, or are less than half full."""
    listed = packs.read_list(out)
    builds = set(_builds_of_runs(out).values()) if listed else set()
    for pack in listed:
        stale = len(_runs_read_from(out, pack)) < pack.runs
        small = pack.runs < runs_per_pack / 2 and pack.bytes < _LARGEST_PACK / 2
        if stale or (small and pack.software_digest in builds):
            for _ in unpack(out, [pack]):
                pass


def _builds_of_runs(out: Address) -> dict[str, str]:
    """The build of the program that made each run with files of its own."""
    own = store.own_runs(out)
    return {marker.run_id: marker.metadata.get("software_digest", "") for marker in store.markers(out, own)}


def _plan_packs(out: Address, runs_per_pack: int) -> Iterator[_Step]:
    """The packs to write, each of runs of one build: only these are sure to have the same columns."""
    by_build = _builds_of_runs(out)
    size_of = _sizes(out, by_build)
    for build in sorted(set(by_build.values())):
        of_build = sorted(run for run, made_by in by_build.items() if made_by == build)
        for runs in _split_by_size(of_build, size_of, runs_per_pack):
            yield _Step(str(out), build, runs)


def _sizes(out: Address, runs: Iterable[str]) -> dict[str, int]:
    """Size of all tables of each run [bytes]."""
    of_tables = [storage.sizes(join(out, table), f"{table}.parquet") for table in TABLES]
    return {run: sum(sizes.get(store.folder_name(run), 0) for sizes in of_tables) for run in runs}


def _split_by_size(runs: Sequence[str], size_of: Mapping[str, int], most: int) -> Iterator[tuple[str, ...]]:
    """Runs in portions of no more than a size."""
    portion: list[str] = []
    size = 0
    for run in runs:
        if portion and (len(portion) >= most or size + size_of[run] > _LARGEST_PACK):
            yield tuple(portion)
            portion = []
            size = 0
        portion.append(run)
        size += size_of[run]
    if portion:
        yield tuple(portion)


def _write_pack(step: _Step) -> Packed:
    """Write the files of one pack, read them again, and hold each run against what it was."""
    left_out: dict[str, str] = {}
    while True:
        writer = _PackWriter()
        for run in step.runs:
            if run not in left_out:
                try:
                    writer.add(*_read_own_files(step.out, run))
                except (_UnfitError, parquet.ParquetError) as error:
                    left_out[run] = str(error)
        if not writer.run_ids:
            return Packed(None, (), left_out)
        pack = writer.write(step)
        wrong = [marker.run_id for marker, files in _remake_files(step.out, pack) if _changed_tables(marker, files)]
        if not wrong:
            return Packed(pack, tuple(writer.run_ids), left_out)
        left_out |= dict.fromkeys(wrong, "its files cannot be made again byte for byte by this build of the program")


class _PackWriter:
    """Writes the files of one pack, run by run."""

    def __init__(self) -> None:
        self._rows: list[tuple[str | int, ...]] = []
        self._writers: dict[str, parquet.GroupedWriter] = {}

    @property
    def run_ids(self) -> list[str]:
        """Runs written so far."""
        return [str(row[0]) for row in self._rows]

    def add(self, marker: Marker, tables: Mapping[str, pa.Table]) -> None:
        """`tables`: without metadata. Raises `_UnfitError` where their columns are not those of the other runs."""
        named = {name: _with_run_id(marker.run_id, table) for name, table in tables.items()}
        if not self._writers:
            self._writers = {name: parquet.GroupedWriter(of.schema, _ROWS_PER_GROUP) for name, of in named.items()}
        if any(not of.schema.equals(self._writers[name].schema, check_metadata=True) for name, of in named.items()):
            raise _UnfitError("it has other columns than runs of the same build of the program")
        for name, table in named.items():
            self._writers[name].add(table)
        metadata = json.dumps(marker.metadata, ensure_ascii=False)
        self._rows.append((marker.run_id, marker.sha256, metadata, *(named[name].num_rows for name in TABLES)))

    def write(self, step: _Step) -> Pack:
        """Put the files in their places, where nobody looks before they are listed."""
        index = pl.DataFrame(self._rows, schema=packs.INDEX_COLUMNS, orient="row")
        name = hashlib.sha256(repr(index.select("run_id", "sha256").rows()).encode()).hexdigest()[:_NAME]
        contents = {table: writer.content() for table, writer in self._writers.items()}
        contents[packs.INDEX] = parquet.parquet_bytes(index)
        for part, content in contents.items():
            storage.write_bytes(join(step.out, packs.file_name(part, name)), content)
        return Pack(
            name=name,
            runs=index.height,
            bytes=sum(map(len, contents.values())),
            software_digest=step.software_digest,
            sha256={part: sha256(content) for part, content in contents.items()},
            ends={table: sha256(parquet.read_footer(io.BytesIO(contents[table]))) for table in TABLES},
        )


def _with_run_id(run_id: str, table: pa.Table) -> pa.Table:
    """The table with the id of the run in the first column."""
    field = pa.field("run_id", pa.large_string())
    return table.add_column(0, field, pa.repeat(pa.scalar(run_id, field.type), table.num_rows))


def _read_own_files(out: str, run_id: str) -> tuple[Marker, dict[str, pa.Table]]:
    """A run from its own files. Raises `_UnfitError` where they are not what its marker says."""
    places = {name: str(store.table_address(out, name, run_id)) for name in TABLES}
    contents = storage.read_many(list(places.values()))
    files = {name: contents.get(place, b"") for name, place in places.items()}
    marker = Marker.of_file(run_id, files[MARKER])
    for name in _changed_tables(marker, files):
        raise _UnfitError(f"its table `{name}` is not the one that its marker names")
    tables = {name: parquet.as_written(content) for name, content in files.items()}
    return marker, {name: table.replace_schema_metadata(None) for name, table in tables.items()}


def _changed_tables(marker: Marker, files: Mapping[str, bytes]) -> list[str]:
    """The tables whose files are not those that the run has, or had before it was packed."""
    noted = {**digests_in_marker(marker.metadata), MARKER: marker.sha256}
    return [name for name in TABLES if sha256(files[name]) != noted.get(name)]


def _remake_files(out: Address, pack: Pack) -> Iterator[tuple[Marker, dict[str, bytes]]]:
    """Every run of a pack: its marker and its own files, some runs at a time in memory."""
    run_ids = packs.index_of(out, pack).run_ids
    markers = packs.markers(out, {run: PackedRun(pack, row) for row, run in enumerate(run_ids)})
    for first in range(0, len(run_ids), _RUNS_AT_ONCE):
        rows = range(first, min(first + _RUNS_AT_ONCE, len(run_ids)))
        parts = {name: packed_tables.tables_as_written(out, name, pack, rows) for name in TABLES}
        for _ in rows:
            marker = next(markers)
            metadata = marker.metadata
            yield marker, {name: store.file_bytes(next(of), name, metadata) for name, of in parts.items()}


def not_as_marked(out: Address, pack: Pack) -> Iterator[tuple[str, str]]:
    """Runs that are read from a pack, with each table of which this build makes another file than the marker names."""
    here = _runs_read_from(out, pack)
    for marker, files in _remake_files(out, pack):
        if marker.run_id in here:
            yield from ((marker.run_id, name) for name in _changed_tables(marker, files))


def remove_runs(out: Address, runs: Sequence[str]) -> None:
    """Remove the results of these runs; the others of their packs have files of their own then."""
    for _ in unpack(out, [pack for pack in packs.read_list(out) if set(packs.index_of(out, pack).run_ids) & set(runs)]):
        pass
    store.remove_own(out, runs)


def unpack(out: Address, asked: Sequence[Pack]) -> Iterator[int]:
    """Give the runs of these packs files of their own again, the same bytes; of each pack how many runs it held.

    Raises `UsageError` where this build of the program cannot make the same bytes: the pack stays.
    """
    for pack in asked:
        here = _runs_read_from(out, pack)
        for marker, files in _remake_files(out, pack) if here else []:
            if marker.run_id in here:
                if _changed_tables(marker, files):
                    raise _unlike_error(pack, marker.run_id)
                store.write_files(out, marker.run_id, files)
        packs.write_list(out, [other for other in packs.read_list(out) if other != pack])
        packs.sweep(out)
        yield pack.runs


def _runs_read_from(out: Address, pack: Pack) -> set[str]:
    """The runs of a pack that neither a later pack nor files of their own replace."""
    return {run for run, place in packs.find_packed(out).items() if place.pack == pack}.difference(store.own_runs(out))


def _unlike_error(pack: Pack, run_id: str) -> UsageError:
    """The error for rows unlike the pack; also of one that was changed, whose rows would pass for whole."""
    return UsageError(
        "cannot be made again byte for byte by this build of the program",
        place=f"files of run {run_id}",
        found=f"pack {pack.name}",
        remedy="`balise verify` says whether a file was changed. Else use the build that packed it, or replay the run.",
    )
