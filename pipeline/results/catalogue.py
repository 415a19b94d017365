"""The small tables of all runs of a result in one file each: `OUT/.catalogue`, which saves opening thousands of files.

It is a copy that may be deleted at any time, no part of the result. It is believed only while it names exactly the
files that are there: each file's version (`storage.versions`) goes into one digest, so that a run that was added,
removed, replayed or touched since makes it stale, and the runs' own files are read instead. Gathering again reads those
of the runs that changed only.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

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
# Hexadecimal digits that tell one state of a run's files from another.
_STATE = 20


def gather(out: Address) -> dict[str, pl.DataFrame]:
    """The small tables of all complete runs with `run_id` in front, in order of the runs; keeps them for later."""
    return {table: _gathered(out, table) for table in CATALOGUED}


def fresh(out: Address, table: str) -> pl.LazyFrame | None:
    """This table of all complete runs from the catalogue; none where it is missing or stale."""
    found = digest(out, table) if table in CATALOGUED else None
    return None if found is None else _kept(out, table, found)


def scan(out: Address, table: str) -> pl.LazyFrame:
    """This table of all complete runs: from the catalogue where it is fresh, else from the runs' own files."""
    kept = fresh(out, table)
    return store.read_table(out, table) if kept is None else kept


def digest(out: Address, table: str) -> str | None:
    """SHA-256 over the contract and the versions of this table's files; none where files have no version."""
    found = states(out, table)
    return None if found is None else _digest_of(found)


def states(out: Address, *tables: str) -> dict[str, str] | None:
    """What changes with the content of these tables, per complete run in order; none where files have no version."""
    versions = [storage.versions(join(out, name), f"{name}.parquet") for name in (_MARKER, *tables)]
    markers, *others = [found for found in versions if found is not None]
    if not markers or len(others) < len(tables):
        return None
    contract = "".join(f"{name} {dtype}\n" for table in tables for name, dtype in dtypes(TABLES[table]).items())
    begun = hashlib.sha256(contract.encode())
    found = {}
    for folder, marker in markers.items():
        if folder.startswith("run_id="):
            own = begun.copy()
            own.update(repr((marker, [files.get(folder) for files in others])).encode())
            found[unquote(folder.removeprefix("run_id="))] = own.hexdigest()[:_STATE]
    return dict(sorted(found.items()))


def keep(out: Address, name: str, found: Mapping[str, Any]) -> None:
    """Keep under this name what costs time to find again."""
    storage.write_bytes(_address(out, name), json.dumps(found).encode())


def kept(out: Address, name: str) -> dict[str, Any]:
    """What `keep` was given; nothing where it is missing or damaged."""
    try:
        found = json.loads(storage.content_of(_address(out, name)) or b"{}")
    except ValueError:
        return {}
    return dict(found) if isinstance(found, dict) else {}


def keep_frame(out: Address, name: str, frame: pl.DataFrame, metadata: Mapping[str, str]) -> None:
    """The same for a frame and what should be known of it."""
    storage.write_bytes(_address(out, name), store.parquet_bytes(frame, metadata))


def kept_frame(out: Address, name: str) -> tuple[pl.DataFrame, dict[str, str]]:
    """What `keep_frame` was given; an empty frame and nothing where it is missing or damaged."""
    content = _content(out, name)
    try:
        return parquet.read_parquet(content), store.metadata_of(content)
    except parquet.ParquetError:
        return pl.DataFrame(), {}


def _digest_of(found: Mapping[str, str]) -> str:
    return hashlib.sha256(json.dumps(found).encode()).hexdigest()


def _gathered(out: Address, table: str) -> pl.DataFrame:
    before = states(out, table)
    if before is None:
        return store.read_table(out, table).collect()
    kept = _kept(out, table, _digest_of(before))
    if kept is not None:
        return kept.collect()
    frame = _with_changed(out, table, before)
    # Files that changed while they were read must not pass for what was read.
    if before == states(out, table):
        metadata = {"table": table, "files": _digest_of(before), "states": json.dumps(before)}
        storage.write_bytes(_address(out, table), store.parquet_bytes(frame, metadata))
    return frame


def _with_changed(out: Address, table: str, wanted: Mapping[str, str]) -> pl.DataFrame:
    """The table from what the catalogue holds of the runs that are as they were, and from the files of the others."""
    kept, metadata = kept_frame(out, table)
    known = json.loads(metadata.get("states", "{}"))
    same = [run for run, state in wanted.items() if known.get(run) == state]
    others = store.scan_runs(out, table, sorted(set(wanted) - set(same))).collect()
    if not same:
        return others
    return pl.concat([kept.filter(pl.col("run_id").is_in(same)), others]).sort("run_id", maintain_order=True)


def _kept(out: Address, table: str, wanted: str) -> pl.LazyFrame | None:
    """What the catalogue holds, if it was made of these very files."""
    content = _content(out, table)
    if store.metadata_of(content).get("files") != wanted:
        return None
    try:
        frame = parquet.read_parquet(content)
    except parquet.ParquetError:
        return None  # damaged, and only a copy
    return source_of(frame.schema, lambda columns, _: iter([frame.select(columns)]))


def _content(out: Address, table: str) -> bytes | Path:
    address = _address(out, table)
    return storage.content_of(address) or b"" if is_url(out) else Path(address)


def _address(out: Address, table: str) -> Address:
    # Without the ending, so that whoever looks for Parquet files finds those of the result only.
    return join(join(out, _FOLDER), table)
