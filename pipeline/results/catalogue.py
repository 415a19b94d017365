"""The small tables of all runs of a result in one file each: `OUT/.catalogue`, which saves opening thousands of files.

It is a copy that may be deleted at any time, no part of the result. It is believed only while it names exactly the
files that are there: each file's version (`storage.versions`) goes into one digest, so that a run that was added,
removed, replayed or touched since makes it stale, and the runs' own files are read instead.
"""

from __future__ import annotations

import contextlib
import hashlib
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

import polars as pl

from pipeline import storage
from pipeline.results import store
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


def scan(out: Address, table: str, runs: Iterable[str]) -> pl.LazyFrame:
    """A table of complete runs of a local result, from their own files.

    The contract's columns are expected, not looked for in each file: a file that has others makes the query fail.
    """
    contract = dtypes(TABLES[table])
    frame = store.scan_runs(out, table, list(runs), schema=contract, extra_columns="ignore")
    return frame.select("run_id", *contract)


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
    frame = _collected(out, table)
    # Files that changed while they were read must not pass for what was read.
    if before is not None and before == digest(out, table):
        storage.write_bytes(_address(out, table), store.parquet_bytes(frame, {"table": table, "files": before}))
    return frame


def _collected(out: Address, table: str) -> pl.DataFrame:
    runs = store.run_ids(out)
    if is_url(out) or not runs:
        return store.read_table(out, table).collect()
    try:
        with patient():
            return scan(out, table, runs).collect()
    except (pl.exceptions.PolarsError, OSError):
        store.check_tables(out, [table])
        raise


@contextlib.contextmanager
def patient() -> Iterator[None]:
    """Thousands of small files are read by as many waiting threads; polars takes it for a deadlock and warns."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="POLARS_MAX_BLOCKING_THREAD_COUNT")
        yield


def _kept(out: Address, table: str, wanted: str) -> pl.LazyFrame | None:
    """What the catalogue holds, if it was made of these very files."""
    address = str(_address(out, table))
    if is_url(out):
        content = storage.read_many([address]).get(address, b"")
        same = store.metadata_of(content).get("files") == wanted
        return pl.read_parquet(content).lazy() if same else None
    same = Path(address).exists() and store.metadata_of(Path(address)).get("files") == wanted
    return pl.scan_parquet(address, glob=False) if same else None


def _address(out: Address, table: str) -> Address:
    # Without the ending, so that whoever looks for Parquet files finds those of the result only.
    return join(join(out, _FOLDER), table)
