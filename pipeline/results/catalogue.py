"""`OUT/.catalogue`: copies that save time, no part of the result. It may be deleted at any time.

An entry is its SHA-256, the key of what it was made from, and its content. Whatever is damaged, unreadable or made from
something else counts as not there, and the tables of the runs are read. `balise verify` makes the entries again.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from urllib.parse import unquote

import polars as pl

from pipeline import storage
from pipeline.results import packs, store
from pipeline.results.source import source_of
from pipeline.storage import parquet
from pipeline.storage.address import Address, join
from schemas.conform import dtypes
from schemas.errors import OutputError
from schemas.tables import TABLES

# Not `epochs`: its files are large enough to be read one by one.
CATALOGUED = ("runs", "hazards", "passages", "alarms")
FOLDER = ".catalogue"
_MARKER = "runs"
# Hexadecimal digits that tell one state of a run's files from another.
_STATE = 20

RunStates = Mapping[str, str]
"""What changes with the files of each run."""


def keep(out: Address, name: str, key: str, content: bytes) -> None:
    """Keep content that was made from what `key` stands for."""
    entry = f"{key}\n".encode() + content
    storage.write_bytes(address_of(out, name), hashlib.sha256(entry).hexdigest().encode() + b"\n" + entry)


def kept(out: Address, name: str, key: str) -> bytes | None:
    """The content kept under this name and key; None where it is missing, damaged or made from something else."""
    try:
        digest, _, entry = (storage.content_of(address_of(out, name)) or b"").partition(b"\n")
    except OutputError:
        return None
    made_from, _, content = entry.partition(b"\n")
    is_whole = digest.decode(errors="replace") == hashlib.sha256(entry).hexdigest()
    return content if is_whole and made_from == key.encode() else None


def address_of(out: Address, name: str) -> Address:
    # Without the ending, so that whoever looks for Parquet files finds those of the result only.
    return join(join(out, FOLDER), name)


def states(out: Address, tables: Sequence[str]) -> RunStates | None:
    """What changes with the content of these tables, per complete run in order; None where files have no version."""
    versions = [storage.versions(join(out, name), f"{name}.parquet") for name in (_MARKER, *tables)]
    known = [of_runs for of_runs in versions if of_runs is not None]
    of_packs = _states_of_packs(out, tables)
    if of_packs is None or len(known) < len(versions):
        return None
    markers, *others = known
    of_files = {
        unquote(folder.removeprefix("run_id=")): repr((marker, [files.get(folder) for files in others]))
        for folder, marker in markers.items()
        if folder.startswith("run_id=")
    }
    contract = "".join(f"{name} {dtype}\n" for table in tables for name, dtype in dtypes(TABLES[table]).items())
    return {
        run: hashlib.sha256(f"{contract}{state}".encode()).hexdigest()[:_STATE]
        for run, state in sorted((of_packs | of_files).items())
    }


def _states_of_packs(out: Address, tables: Sequence[str]) -> dict[str, str] | None:
    """What changes with the files of the pack of each packed run; None where they have no version."""
    of_runs: dict[str, str] = {}
    for pack, rows in packs.by_pack(packs.find(out)):
        versions = [storage.version(join(out, packs.file_name(part, pack.name))) for part in (packs.INDEX, *tables)]
        if None in versions:
            return None
        of_runs |= {run: repr((versions, row)) for run, row in rows.items()}
    return of_runs


def gather(out: Address) -> dict[str, pl.DataFrame]:
    """The small tables of all complete runs from the runs' own files, with `run_id` in front; keeps them for `scan`."""
    return {table: _gathered(out, table) for table in CATALOGUED}


def scan(out: Address, table: str) -> pl.LazyFrame:
    """This table of all complete runs: from the catalogue where it is fresh, else from the runs' own files."""
    frame = fresh(out, table)
    if frame is None:
        return store.read_table(out, table)
    return source_of(frame.schema, lambda columns, _: iter([frame.select(columns)]))


def fresh(out: Address, table: str) -> pl.DataFrame | None:
    """This table from the catalogue; None where it is missing or stale."""
    key = _key(out, table) if table in CATALOGUED else ""
    content = kept(out, table, key) if key else None
    try:
        return None if content is None else parquet.read_parquet(content)
    except parquet.ParquetError:
        return None


def _gathered(out: Address, table: str) -> pl.DataFrame:
    key = _key(out, table)
    frame = store.read_table(out, table).collect()
    # Runs that changed while they were read must not pass for what was read.
    if key and key == _key(out, table):
        keep(out, table, key, parquet.parquet_bytes(frame))
    return frame


def _key(out: Address, table: str) -> str:
    """What changes with this table of any run; empty where files have no version."""
    of_runs = states(out, [table])
    return hashlib.sha256(repr(sorted(of_runs.items())).encode()).hexdigest() if of_runs else ""
