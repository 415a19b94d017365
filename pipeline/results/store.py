"""Result tables on disk: one small Parquet file per run and table, Hive-partitioned (CONTRACT section 3).

Runs that `balise compact` has packed are read from their packs; a run with files of its own is read from these.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np
import polars as pl
import pyarrow as pa

from pipeline import storage
from pipeline.results import packed_tables, packs
from pipeline.results.marker import NAME as _MARKER
from pipeline.results.marker import Marker, sha256
from pipeline.results.source import conjuncts, source_of
from pipeline.storage import parquet
from pipeline.storage.address import Address, is_url, join, redacted, shown
from pipeline.storage.described import PREFIX, table_bytes
from pipeline.storage.files import exists, read_bytes
from schemas.config import Configuration, Settings, Vehicle, settings_from, to_toml, toml_of
from schemas.conform import dtypes
from schemas.errors import ConfigError, UsageError
from schemas.run import RunTables, Site
from schemas.tables import CONTRACT_VERSION, TABLES

# Of 255 bytes that file systems allow, `run_id=` takes seven.
LONGEST_NAME = 248
# Files read before they become one frame.
_AT_ONCE = 256


def table_address(out: Address, table: str, run_id: str) -> Address:
    """`OUT/hazards/run_id=R/hazards.parquet`."""
    return join(join(join(out, table), folder_name(run_id)), f"{table}.parquet")


def file_name(run_id: str) -> str:
    """The run id as part of a path; what a path cannot hold is percent-encoded."""
    return quote(run_id, safe=" +,()[]@!~")


def write_run(tables: RunTables, out: Address, metadata: Mapping[str, str]) -> None:
    """Write the five tables of one run; the runs table last, so that it marks the run complete.

    `metadata` (digests, software) goes into every file beside the table's name and contract version; the runs table
    also holds the SHA-256 of the others, so that its own digest stands for the run.
    The same tables and metadata give the same bytes. A killed process leaves either the complete
    run or one without marker, which does not count.
    """
    noted = {"run_id": tables.run_id, **metadata}
    contents: dict[str, bytes] = {}
    for name in (*(name for name in TABLES if name != _MARKER), _MARKER):
        if name == _MARKER:
            noted["tables"] = json.dumps({table: sha256(content) for table, content in contents.items()})
        contents[name] = table_bytes(getattr(tables, name), name, TABLES[name], noted)
    write_files(out, tables.run_id, contents)


def write_files(out: Address, run_id: str, contents: Mapping[str, bytes]) -> None:
    """Write the files of a run by their tables, the marker last."""
    marker = table_address(out, _MARKER, run_id)
    if is_url(out):
        # An object store shows each object as soon as it is staged.
        storage.remove(marker)
    staged: list[tuple[Address, Address]] = []
    try:
        for name in sorted(contents, key=lambda name: name == _MARKER):
            staged.append(storage.stage(table_address(out, name, run_id), contents[name]))
        if not is_url(out):
            storage.remove(marker)
        storage.commit(staged)
    except BaseException:
        storage.discard(staged)
        raise


def read_run(out: Address, run_id: str) -> RunTables:
    """The five tables of one run."""
    frames = {name: read_table(out, name, run_id).drop("run_id").collect() for name in TABLES}
    return RunTables(run_id, **frames)


def read_table(out: Address, table: str, run_id: str | None = None) -> pl.LazyFrame:
    """One table of a result, with the column `run_id` in front.

    Args:
        out: the result of a campaign.
        table: name of the table: `hazards`, `passages`, `alarms`, `epochs` or `runs`.
        run_id: one run; None for all complete ones.

    Returns:
        The rows, read where they are collected.

    Raises:
        UsageError: there is no such table or run.

    Source:
        CONTRACT section 3.
    """
    if table not in TABLES:
        raise UsageError("is not a table", place=table, expected=", ".join(TABLES))
    runs = run_ids(out) if run_id is None else [run_id]
    if run_id is not None and not (_runs_with_files(out, [run_id]) or packs.find_packed(out, [run_id])):
        known = ", ".join(run_ids(out)[:10]) or "no complete run"
        raise UsageError(f"has no run {run_id!r}", place=shown(out), found=known)
    return scan_runs(out, table, runs)


def small_tables(out: Address) -> dict[str, pl.DataFrame]:
    """All tables of all complete runs but `epochs`, which is large."""
    return {name: read_table(out, name).collect() for name in TABLES if name != "epochs"}


def scan_runs(out: Address, table: str, runs: Sequence[str]) -> pl.LazyFrame:
    """One table of these runs, read and checked when a query asks; a condition on `run_id` reads those runs only.

    Collecting it raises `UsageError` for a file that is damaged, gone, or of another build.
    """

    def parts(columns: list[str], predicate: pl.Expr | None) -> Iterator[pl.DataFrame]:
        """Tables of the runs that the condition leaves, some runs at a time."""
        asked = _runs_asked_for(runs, predicate)
        for at in range(0, len(asked), _AT_ONCE):
            yield tables_of(out, table, asked[at : at + _AT_ONCE], columns)

    return source_of({"run_id": pl.String(), **dtypes(TABLES[table])}, parts)


def _runs_asked_for(runs: Sequence[str], predicate: pl.Expr | None) -> list[str]:
    """The runs that the conditions on `run_id` alone leave."""
    frame = pl.DataFrame({"run_id": runs}, schema={"run_id": pl.String})
    for condition in conjuncts(predicate):
        if condition.meta.root_names() == ["run_id"]:
            frame = frame.filter(condition)
    return frame["run_id"].to_list()


def tables_of(out: Address, table: str, runs: Sequence[str], columns: Sequence[str] | None = None) -> pl.DataFrame:
    """Columns (all) of one table of these runs, read now. Raises `UsageError` as `scan_runs`."""
    wanted = ["run_id", *dtypes(TABLES[table])] if columns is None else columns
    if not runs:
        return pl.DataFrame(schema={"run_id": pl.String(), **dtypes(TABLES[table])}).select(wanted)
    of_table = [name for name in wanted if name != "run_id"]
    in_packs = packed_runs_among(out, runs)
    own = [run for run in runs if run not in in_packs]
    check = partial(_check_columns, table)
    parts = [*_read_own(out, table, own, of_table), *packed_tables.read_rows(out, table, in_packs, of_table, check)]
    heights = {run: height for of_part, _ in parts for run, height in of_part.items()}
    names = pl.Series("run_id", runs, pl.String).gather(np.repeat(np.arange(len(runs)), [heights[run] for run in runs]))
    return _order_rows(runs, heights, [frame for _, frame in parts]).with_columns(names).select(wanted)


def _order_rows(runs: Sequence[str], heights: Mapping[str, int], parts: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """The rows of the parts, where the runs come in the order of `heights`, in the order of `runs`."""
    whole = parts[0] if len(parts) == 1 else pl.concat(parts)
    if list(heights) == list(runs):
        return whole
    begins = dict(zip(heights, itertools.accumulate(heights.values(), initial=0), strict=False))
    return pl.concat([whole.slice(begins[run], heights[run]) for run in runs])


def _read_own(
    out: Address, table: str, runs: Sequence[str], columns: Sequence[str]
) -> Iterator[tuple[dict[str, int], pl.DataFrame]]:
    """Rows from the runs' own files, and how many each run has; nothing without runs."""
    run = ""

    def checked(recorded: Mapping[str, pl.DataType]) -> Sequence[str]:
        """The columns to read, once the file is known to have those of the contract."""
        _check_columns(table, run, recorded)
        return columns

    places = [str(table_address(out, table, run)) for run in runs]
    contents = storage.read_many(places) if is_url(out) else {}
    reader = parquet.TableReader(checked)
    try:
        for run, place in zip(runs, places, strict=True):  # noqa: B007 - `checked` and the error name the run
            if is_url(out) and place not in contents:
                raise parquet.ParquetError("no such object")
            reader.add(contents[place] if is_url(out) else Path(place))
        if runs:
            yield dict(zip(runs, reader.heights, strict=True)), reader.frame()
    except parquet.ParquetError as error:
        where = f"run {run}, table `{table}`"
        kind = UsageError if exists(table_address(out, table, run)) else packs.GoneError
        raise kind(f"cannot be read: {error}", place=where, remedy="Replay this run again with --force.") from None


def _check_columns(table: str, run_id: str, recorded: Mapping[str, pl.DataType]) -> None:
    """Refuse a table whose columns are not those of the contract."""
    expected = dtypes(TABLES[table])
    unlike = [name for name, kind in expected.items() if recorded.get(name) != kind]
    if unlike:
        raise UsageError(
            "was written by another build of the program",
            place=f"run {run_id}, table `{table}`",
            found=f"{', '.join(unlike)} missing or of another type",
            expected=f"the columns of contract {CONTRACT_VERSION} as of this build",
            remedy="Repeat `balise replay` with the same --out: it replays this run again.",
        )


def run_ids(out: Address) -> list[str]:
    """The complete runs of a result, sorted."""
    return sorted({*own_runs(out), *packs.find_packed(out)})


def own_runs(out: Address) -> list[str]:
    """Runs with files of their own, sorted."""
    folders = [name for name in storage.folders_in(join(out, _MARKER)) if name.startswith("run_id=")]
    runs = sorted(unquote(name.removeprefix("run_id=")) for name in folders)
    return runs if is_url(out) else _runs_with_files(out, runs)


def _runs_with_files(out: Address, among: Iterable[str]) -> list[str]:
    """The runs of these that have files of their own."""
    return [run for run in among if exists(table_address(out, _MARKER, run))]


def packed_runs_among(out: Address, among: Iterable[str]) -> dict[str, packs.PackedRun]:
    """The runs of these that are read from packs, in order."""
    places = packs.find_packed(out, among)
    # A store lists all of them as fast as it answers for a few.
    own = set(own_runs(out) if is_url(out) and len(places) > 1 else _runs_with_files(out, places))
    return {run: place for run, place in places.items() if run not in own}


def complete_runs(out: Address) -> list[str]:
    """`run_ids` of a result that has some. Raises `UsageError` otherwise."""
    runs = run_ids(out)
    if not runs:
        raise UsageError(
            "holds no complete run", place=redacted(str(out)), expected="the output folder of `balise replay`"
        )
    return runs


def check_site(site: Site | None, replayed_digest: str | None, run_id: str) -> None:
    """Refuse a site that is known to be another one than the run was replayed on."""
    # A run replayed with a route of its own adds the route's digest (`campaign/plan.py`).
    replayed = replayed_digest.split()[0] if replayed_digest else None
    if site is not None and site.digest and replayed and site.digest != replayed:
        raise UsageError("was replayed on another site", place=run_id, found=site.digest, expected=replayed)


def completed_runs(out: Address, among: Sequence[str] | None = None) -> dict[str, dict[str, str]]:
    """Metadata of each complete run, or of those among these, without reading any table."""
    return {marker.run_id: marker.metadata for marker in markers(out, among)}


def markers(out: Address, among: Sequence[str] | None = None) -> Iterator[Marker]:
    """The marker of each complete run in the order of their ids, or of those among these."""
    runs = run_ids(out) if among is None else among
    for first in range(0, len(runs), _AT_ONCE):
        some = runs[first : first + _AT_ONCE]
        in_packs = packed_runs_among(out, some)
        places = {run: str(table_address(out, _MARKER, run)) for run in some if run not in in_packs}
        contents = storage.read_many(list(places.values()))
        found = {marker.run_id: marker for marker in packs.markers(out, in_packs)}
        found |= {run: Marker.of_file(run, contents[place]) for run, place in places.items() if place in contents}
        yield from (found[run] for run in some if run in found)


def packed_frame(out: Address, table: str, run_id: str) -> pl.DataFrame | None:
    """One table of a packed run with whatever columns its build of the program wrote; none of a run with own files."""
    place = packed_runs_among(out, [run_id]).get(run_id)
    return None if place is None else pl.DataFrame(pl.from_arrow(packed_tables.table_of_run(out, table, place)))


def content_of(out: Address, table: str, run_id: str) -> bytes | None:
    """The file of one table of a run, or what was its file before it was packed; none where there is neither."""
    in_packs = packed_runs_among(out, [run_id])
    if not in_packs:
        return storage.content_of(table_address(out, table, run_id))
    (marker,) = packs.markers(out, in_packs)
    return file_bytes(packed_tables.table_of_run(out, table, in_packs[run_id]), table, marker.metadata)


def file_bytes(rows: pa.Table, table: str, of_marker: Mapping[str, str]) -> bytes:
    """The file of one table of a run from its rows and the metadata of its marker, as `write_run` wrote it."""
    noted = {key: value for key, value in of_marker.items() if table == _MARKER or key != "tables"} | {"table": table}
    metadata = {f"{PREFIX}{key}": value for key, value in sorted(noted.items())}
    return parquet.encoded(rows.replace_schema_metadata(metadata))


def remove_own(out: Address, runs: Sequence[str]) -> None:
    """Remove the files of runs that a pack holds too; the markers go first, so that no run is complete in part."""
    for table in (_MARKER, *(name for name in TABLES if name != _MARKER)):
        storage.remove_folders([join(join(out, table), folder_name(run)) for run in runs])


def sweep(out: Address) -> None:
    """Remove what interrupted calls left: tables without a marker, packs that are not listed, and unfinished files."""
    complete = {folder_name(run) for run in own_runs(out)}
    for table in TABLES:
        for folder in storage.folders_in(join(out, table)):
            if folder.startswith("run_id=") and folder not in complete:
                storage.remove_folder(join(join(out, table), folder))
    packs.sweep(out)
    if not is_url(out):
        inside = [f"{out}/{name}" for name in storage.folders_in(out)]
        runs = [f"{folder}/{run}" for folder in inside for run in storage.folders_in(folder)]
        for folder in (str(out), *inside, *runs):
            for name in storage.unfinished_in(folder):
                Path(folder, name).unlink(missing_ok=True)


def read_config(out: Address) -> Configuration | None:
    """The configuration that a result was made with; None where it holds none."""
    address = join(out, "config.toml")
    if not exists(address):
        return None
    try:
        return settings_from(toml_of(read_bytes(address), shown(address)), Configuration, str(address))
    except ConfigError as error:
        raise UsageError(
            f"was not written by this build of the program: {error}",
            place=shown(address),
            remedy="Repeat `balise replay` with the same --out: it replays these runs again.",
        ) from None


def write_config(out: Address, settings: Settings) -> None:
    """`OUT/config.toml`: the resolved configuration."""
    storage.write_bytes(join(out, "config.toml"), to_toml(settings).encode())


def write_vehicle(out: Address, vehicle: Vehicle) -> None:
    """`OUT/vehicle.toml`: what was known of the train; a result without a vehicle file has none."""
    address = join(out, "vehicle.toml")
    if vehicle != Vehicle():
        storage.write_bytes(address, to_toml(vehicle).encode())
    elif exists(address):
        storage.remove(address)


def folder_name(run_id: str) -> str:
    """The hive partition of a run."""
    return f"run_id={file_name(run_id)}"
