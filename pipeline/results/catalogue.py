"""The small tables of all runs of a result in one file each: `OUT/.catalogue`, which saves opening thousands of files.

It is a copy that may be deleted at any time, no part of the result. It is believed only while it names exactly the
files that are there: each file's version (`storage.versions`) goes into one digest, so that a run that was added,
removed, replayed or touched since makes it stale, and the runs' own files are read instead.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import polars as pl

from pipeline import storage
from pipeline.results import store
from pipeline.results.source import source_of
from pipeline.storage import parquet
from pipeline.storage.address import Address, is_url, join
from schemas.conform import dtypes
from schemas.tables import TABLES

# Not `epochs`: it is no small table, and its files are large enough to be read one by one.
CATALOGUED = ("runs", "hazards", "passages", "alarms")
_FOLDER = ".catalogue"
_MARKER = "runs"


def gather(out: Address) -> dict[str, pl.DataFrame]:
    """The small tables of all complete runs with `run_id` in front, in order of the runs; keeps them for later."""
    return {table: _gathered(out, table) for table in CATALOGUED}


def fresh(out: Address, table: str) -> pl.LazyFrame | None:
    """This table of all complete runs from the catalogue; none where it is missing or stale."""
    found = digest(out, table) if table in CATALOGUED else None
    return None if found is None else _kept(out, table, found)


def digest(out: Address, table: str) -> str | None:
    """SHA-256 over the contract and the versions of this table's files; none where files have no version."""
    markers = storage.versions(join(out, _MARKER), f"{_MARKER}.parquet")
    files = markers if table == _MARKER else storage.versions(join(out, table), f"{table}.parquet")
    if not markers or files is None:
        return None
    lines = [f"{name} {dtype}\n" for name, dtype in dtypes(TABLES[table]).items()]
    lines += [f"{run} {marker} {files.get(run)}\n" for run, marker in sorted(markers.items())]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _gathered(out: Address, table: str) -> pl.DataFrame:
    before = digest(out, table)
    kept = None if before is None else _kept(out, table, before)
    if kept is not None:
        return kept.collect()
    frame = store.read_table(out, table).collect()
    # Files that changed while they were read must not pass for what was read.
    if before is not None and before == digest(out, table):
        storage.write_bytes(_address(out, table), store.parquet_bytes(frame, {"table": table, "files": before}))
    return frame


def _kept(out: Address, table: str, wanted: str) -> pl.LazyFrame | None:
    """What the catalogue holds, if it was made of these very files."""
    address = _address(out, table)
    content: bytes | Path = storage.read_many([str(address)]).get(str(address), b"") if is_url(out) else Path(address)
    if store.metadata_of(content).get("files") != wanted:
        return None
    try:
        frame = parquet.read_parquet(content)
    except parquet.ParquetError:
        return None  # damaged, and only a copy
    return source_of(frame.schema, lambda columns, _: iter([frame.select(columns)]))


def _address(out: Address, table: str) -> Address:
    # Without the ending, so that whoever looks for Parquet files finds those of the result only.
    return join(join(out, _FOLDER), table)
