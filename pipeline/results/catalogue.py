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

States = Mapping[str, str]
"""What changes with the files of each run."""


def gather(out: Address) -> dict[str, pl.DataFrame]:
    """The small tables of all complete runs with `run_id` in front, in order of the runs; keeps them for later."""
    return {table: _gathered(out, table) for table in CATALOGUED}


def fresh(out: Address, table: str) -> pl.LazyFrame | None:
    """This table of all complete runs from the catalogue; none where it is missing or stale."""
    wanted = states(out, table) if table in CATALOGUED else None
    content = _content(out, table)
    if wanted is None or _states_in(content) != wanted:
        return None
    try:
        frame = parquet.read_parquet(content)
    except parquet.ParquetError:
        return None  # damaged, and only a copy
    return source_of(frame.schema, lambda columns, _: iter([frame.select(columns)]))


def scan(out: Address, table: str) -> pl.LazyFrame:
    """This table of all complete runs: from the catalogue where it is fresh, else from the runs' own files."""
    kept = fresh(out, table)
    return store.read_table(out, table) if kept is None else kept


def states(out: Address, *tables: str) -> States | None:
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


def keep(out: Address, name: str, frame: pl.DataFrame, found: States) -> None:
    """Keep under this name what costs time to find again, and the states of the runs when it was found."""
    storage.write_bytes(_address(out, name), store.parquet_bytes(frame, {"states": json.dumps(found)}))


def kept(out: Address, name: str) -> tuple[pl.DataFrame, States]:
    """What `keep` was given; an empty frame and nothing where it is missing or damaged."""
    content = _content(out, name)
    try:
        return parquet.read_parquet(content), _states_in(content)
    except parquet.ParquetError:
        return pl.DataFrame(), {}


def _gathered(out: Address, table: str) -> pl.DataFrame:
    """From what the catalogue holds of the runs that are as they were, and from the files of the others."""
    wanted = states(out, table)
    if wanted is None:
        return store.read_table(out, table).collect()
    frame, known = kept(out, table)
    if known == wanted:
        return frame
    same = [run for run, state in wanted.items() if known.get(run) == state]
    others = store.scan_runs(out, table, sorted(set(wanted) - set(same))).collect()
    if same:
        others = pl.concat([frame.filter(pl.col("run_id").is_in(same)), others]).sort("run_id", maintain_order=True)
    # Files that changed while they were read must not pass for what was read.
    if wanted == states(out, table):
        keep(out, table, others, wanted)
    return others


def _states_in(content: bytes | Path) -> States:
    found: States = json.loads(store.metadata_of(content).get("states", "{}"))
    return found


def _content(out: Address, table: str) -> bytes | Path:
    address = _address(out, table)
    return storage.content_of(address) or b"" if is_url(out) else Path(address)


def _address(out: Address, table: str) -> Address:
    # Without the ending, so that whoever looks for Parquet files finds those of the result only.
    return join(join(out, _FOLDER), table)
