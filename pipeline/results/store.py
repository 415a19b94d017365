"""Result tables on disk: one small Parquet file per run and table, Hive-partitioned (CONTRACT section 3)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from urllib.parse import quote, unquote

import polars as pl

from pipeline import storage
from pipeline.results.source import conjuncts, source_of
from pipeline.storage import parquet
from pipeline.storage.address import Address, is_url, join, redacted, shown
from pipeline.storage.files import exists, read_bytes
from schemas.config import Configuration, Settings, Vehicle, settings_from, to_toml, toml_of
from schemas.conform import conform, dtypes, meanings
from schemas.errors import ConfigError, UsageError
from schemas.run import RunTables, Site
from schemas.tables import CONTRACT_VERSION, TABLES

PREFIX = "balise."
_MARKER = "runs"
# Of 255 bytes that file systems allow, `run_id=` takes seven.
LONGEST_NAME = 248
# Files read before they become one frame.
_AT_ONCE = 256


def table_address(out: Address, table: str, run_id: str) -> Address:
    """`OUT/hazards/run_id=R/hazards.parquet`."""
    return join(join(join(out, table), _partition(run_id)), f"{table}.parquet")


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
    others = {name: table_bytes(getattr(tables, name), name, noted) for name in TABLES if name != _MARKER}
    digests = json.dumps({name: hashlib.sha256(content).hexdigest() for name, content in others.items()})
    last = table_bytes(tables.runs, _MARKER, {**noted, "tables": digests})
    contents = [*others.items(), (_MARKER, last)]
    marker = table_address(out, _MARKER, tables.run_id)
    if is_url(out):
        # An object store shows each object as soon as it is staged.
        storage.remove(marker)
    staged: list[tuple[Address, Address]] = []
    try:
        for name, content in contents:
            staged.append(storage.stage(table_address(out, name, tables.run_id), content))
        if not is_url(out):
            storage.remove(marker)
        storage.commit(staged)
    except BaseException:
        storage.discard(staged)
        raise


def table_bytes(frame: pl.DataFrame, table: str, metadata: Mapping[str, str]) -> bytes:
    """A table as Parquet, held to its contract, with unit and meaning in the field of each column."""
    checked = conform(frame, TABLES[table])
    return parquet_bytes(checked, {"table": table, "contract": CONTRACT_VERSION, **metadata}, meanings(TABLES[table]))


def parquet_bytes(
    frame: pl.DataFrame, metadata: Mapping[str, str], columns: Mapping[str, Mapping[str, str]] | None = None
) -> bytes:
    """A frame as Parquet with its metadata; the same content always gives the same bytes."""
    named = {f"{PREFIX}{key}": value for key, value in metadata.items()}
    return parquet.parquet_bytes(frame, named, columns)


def read_run(out: Address, run_id: str) -> RunTables:
    """The five tables of one complete run."""
    frames = {name: read_table(out, name, run_id).drop("run_id").collect() for name in TABLES}
    return RunTables(run_id, **frames)


def read_table(out: Address, table: str, run_id: str | None = None) -> pl.LazyFrame:
    """One table of all complete runs, or of one, with the column `run_id` in front."""
    if table not in TABLES:
        raise UsageError("is not a table", place=table, expected=", ".join(TABLES))
    runs = run_ids(out) if run_id is None else [run_id]
    if run_id is not None and not exists(table_address(out, _MARKER, run_id)):
        known = ", ".join(run_ids(out)[:10]) or "no complete run"
        raise UsageError(f"has no run {run_id!r}", place=shown(out), found=known)
    return scan_runs(out, table, runs)


def scan_runs(out: Address, table: str, runs: Sequence[str]) -> pl.LazyFrame:
    """One table of these runs, read and checked when a query asks; a condition on `run_id` reads those runs only.

    Collecting it raises `UsageError` for a file that is damaged, gone, or of another build.
    """

    def parts(columns: list[str], predicate: pl.Expr | None) -> Iterator[pl.DataFrame]:
        asked = _asked(runs, predicate)
        for at in range(0, len(asked), _AT_ONCE):
            yield tables_of(out, table, asked[at : at + _AT_ONCE], columns)

    return source_of({"run_id": pl.String(), **dtypes(TABLES[table])}, parts)


def _asked(runs: Sequence[str], predicate: pl.Expr | None) -> list[str]:
    """The runs that the conditions on `run_id` alone leave."""
    frame = pl.DataFrame({"run_id": runs}, schema={"run_id": pl.String})
    for condition in conjuncts(predicate):
        if condition.meta.root_names() == ["run_id"]:
            frame = frame.filter(condition)
    return frame["run_id"].to_list()


def tables_of(out: Address, table: str, runs: Sequence[str], columns: Sequence[str] | None = None) -> pl.DataFrame:
    """These columns (all) of one table of these runs, read now. Raises `UsageError` as `scan_runs`."""
    wanted = ["run_id", *dtypes(TABLES[table])] if columns is None else columns
    run = ""

    def own(recorded: Mapping[str, pl.DataType]) -> list[str]:
        _check_columns(table, run, recorded)
        return [name for name in wanted if name != "run_id"]

    places = [str(table_address(out, table, run)) for run in runs]
    contents = storage.read_many(places) if is_url(out) else {}
    reader = parquet.TableReader(own)
    try:
        for run, place in zip(runs, places, strict=True):
            if is_url(out) and place not in contents:
                raise _unreadable(table, run, "no such object")
            reader.add(contents[place] if is_url(out) else Path(place))
        frame = reader.frame()
    except parquet.ParquetError as error:
        raise _unreadable(table, run, str(error)) from None
    names = pl.Series("run_id", [run for run, height in zip(runs, reader.heights, strict=True) for _ in range(height)])
    return frame.with_columns(names.cast(pl.String)).select(wanted)


def _unreadable(table: str, run_id: str, reason: str) -> UsageError:
    return UsageError(
        f"cannot be read: {reason}",
        place=f"run {run_id}, table `{table}`",
        remedy="Replay this run again with --force.",
    )


def _check_columns(table: str, run_id: str, recorded: Mapping[str, pl.DataType]) -> None:
    expected = dtypes(TABLES[table])
    lost = [name for name in expected if name not in recorded]
    retyped = [
        f"{name} as {recorded[name]}, not {kind}" for name, kind in expected.items() if recorded.get(name, kind) != kind
    ]
    if lost or retyped:
        parts = ([f"no {', '.join(lost)}"] if lost else []) + retyped
        raise UsageError(
            "was written by another build of the program",
            place=f"run {run_id}, table `{table}`",
            found="; ".join(parts),
            expected=f"the columns of contract {CONTRACT_VERSION} as of this build",
            remedy="Repeat `balise replay` with the same --out: it replays this run again.",
        )


def run_ids(out: Address) -> list[str]:
    """The complete runs of a result, sorted."""
    folders = [name for name in storage.folders_in(join(out, _MARKER)) if name.startswith("run_id=")]
    runs = [unquote(name.removeprefix("run_id=")) for name in folders]
    if not is_url(out):
        runs = [run for run in runs if Path(table_address(out, _MARKER, run)).exists()]
    return sorted(runs)


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
    return {run: metadata_of(content) for run, content in markers(out, among)}


def markers(out: Address, among: Sequence[str] | None = None) -> Iterator[tuple[str, bytes]]:
    """The `runs` table of each complete run, or of those among these, as it lies there."""
    runs = run_ids(out) if among is None else among
    for first in range(0, len(runs), _AT_ONCE):
        some = {str(table_address(out, _MARKER, run)): run for run in runs[first : first + _AT_ONCE]}
        yield from ((some[place], content) for place, content in storage.read_many(list(some)).items())


def metadata_of(source: Path | bytes) -> dict[str, str]:
    """The metadata that `write_run` was given; nothing for a file that cannot be read."""
    try:
        metadata = pl.read_parquet_metadata(source)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError):
        return {}
    return {key.removeprefix(PREFIX): value for key, value in metadata.items() if key.startswith(PREFIX)}


def sweep(out: Address) -> None:
    """Remove what interrupted campaigns left: tables without a marker, and unfinished files."""
    complete = {_partition(run) for run in run_ids(out)}
    for table in TABLES:
        for folder in storage.folders_in(join(out, table)):
            if folder.startswith("run_id=") and folder not in complete:
                storage.remove_folder(join(join(out, table), folder))
    if not is_url(out):
        for folder in _folders(Path(out)):
            _remove_unfinished(folder)


def _folders(out: Path) -> Iterator[str]:
    """The folders of a result, runs and all."""
    yield str(out)
    for table in storage.folders_in(out):
        yield f"{out}/{table}"
        yield from (f"{out}/{table}/{run}" for run in storage.folders_in(out / table))


def sweep_run(out: Path, run_id: str) -> None:
    """`sweep` for one run of a local result, whose worker is known to have ended."""
    complete = Path(table_address(out, _MARKER, run_id)).exists()
    for table in TABLES:
        folder = Path(table_address(out, table, run_id)).parent
        if complete:
            _remove_unfinished(folder)
        else:
            storage.remove_folder(folder)


def _remove_unfinished(folder: Path | str) -> None:
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


def _partition(run_id: str) -> str:
    return f"run_id={file_name(run_id)}"
