"""Result tables on disk: one small Parquet file per run and table, Hive-partitioned (CONTRACT section 3)."""

from __future__ import annotations

import io
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import polars as pl

from pipeline import storage
from pipeline.storage.address import Address, is_url, join, redacted, shown
from pipeline.storage.files import exists, read_bytes
from schemas.config import Configuration, Settings, settings_from, to_toml
from schemas.conform import conform, dtypes
from schemas.errors import ConfigError, UsageError
from schemas.run import RunTables, Site
from schemas.tables import CONTRACT_VERSION, TABLES

PREFIX = "balise."
# Compression is part of "the same bytes": neither level nor row groups may follow a library's default.
_COMPRESSION_LEVEL = 3
_ROWS_PER_GROUP = 262_144
_MARKER = "runs"
# Of 255 bytes that file systems allow, `run_id=` takes seven.
LONGEST_NAME = 248


def table_address(out: Address, table: str, run_id: str) -> Address:
    """`OUT/hazards/run_id=R/hazards.parquet`."""
    return join(join(join(out, table), _partition(run_id)), f"{table}.parquet")


def file_name(run_id: str) -> str:
    """The run id as part of a path; what a path cannot hold is percent-encoded."""
    return quote(run_id, safe=" +,()[]@!~")


def write_run(tables: RunTables, out: Address, metadata: Mapping[str, str]) -> None:
    """Write the five tables of one run; the runs table last, so that it marks the run complete.

    `metadata` (digests, software) goes into every file beside the table's name and contract version.
    The same tables and metadata give the same bytes. A killed process leaves either the complete
    run or one without marker, which does not count.
    """
    contents = [(name, table_bytes(getattr(tables, name), name, metadata)) for name in TABLES]
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
    """A table as Parquet, held to its contract."""
    checked = conform(frame, TABLES[table])
    return parquet_bytes(checked, {"table": table, "contract": CONTRACT_VERSION, **metadata})


def parquet_bytes(frame: pl.DataFrame, metadata: Mapping[str, str]) -> bytes:
    """A frame as Parquet with its metadata; the same content always gives the same bytes."""
    buffer = io.BytesIO()
    frame.rechunk().write_parquet(
        buffer,
        compression="zstd",
        compression_level=_COMPRESSION_LEVEL,
        row_group_size=_ROWS_PER_GROUP,
        metadata={f"{PREFIX}{key}": metadata[key] for key in sorted(metadata)},
    )
    return buffer.getvalue()


def read_run(out: Address, run_id: str) -> RunTables:
    """The five tables of one complete run."""
    frames = {name: read_table(out, name, run_id).drop("run_id").collect() for name in TABLES}
    return RunTables(run_id, **frames)


def read_table(out: Address, table: str, run_id: str | None = None) -> pl.LazyFrame:
    """One table of all complete runs, or of one, with the column `run_id` in front."""
    if table not in TABLES:
        raise UsageError("is no table", place=table, expected=", ".join(TABLES))
    runs = run_ids(out) if run_id is None else [run_id]
    schema = {"run_id": pl.String(), **dtypes(TABLES[table])}
    if not runs:
        return pl.LazyFrame(schema=schema)
    if run_id is not None and not exists(table_address(out, _MARKER, run_id)):
        known = ", ".join(run_ids(out)[:10]) or "no complete run"
        raise UsageError(f"has no run {run_id!r}", place=shown(out), found=known)
    paths = [table_address(out, table, run) for run in runs]
    if is_url(out):
        return _read_remote(table, [str(path) for path in paths], runs).select(list(schema))
    for path, run in zip(paths, runs, strict=True):
        _check_columns(table, run, _schema_of(table, run, Path(path)))
    return scan_runs(out, table, runs).select(list(schema))


def scan_runs(out: Address, table: str, runs: Sequence[str], **options: Any) -> pl.LazyFrame:
    """One table of these runs of a local result as its files hold it, and `run_id`, a condition on which prunes files.

    `options` go to `polars.scan_parquet`.
    """
    files = [Path(table_address(out, table, run)) for run in runs]
    if "=" not in str(out):
        schema = {"run_id": pl.String()}
        return pl.scan_parquet(files, glob=False, hive_partitioning=True, hive_schema=schema, **options)
    # Above the tables, too, polars takes each `key=value` for a partition.
    scans = (pl.scan_parquet(file, glob=False, hive_partitioning=False, **options) for file in files)
    return pl.concat(scan.with_columns(run_id=pl.lit(run)) for scan, run in zip(scans, runs, strict=True))


def check_tables(out: Address, tables: Iterable[str]) -> None:
    """Refuse results of another build of the program, whose tables have other columns; local results only."""
    for table in tables:
        for run in run_ids(out):
            _check_columns(table, run, _schema_of(table, run, Path(table_address(out, table, run))))


def _schema_of(table: str, run_id: str, file: Path) -> Mapping[str, pl.DataType]:
    try:
        # Opened here: given a path, polars takes its brackets for a glob.
        with file.open("rb") as source:
            return pl.read_parquet_schema(source)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise _unreadable(table, run_id, str(error).strip().splitlines()[0]) from None


def _unreadable(table: str, run_id: str, reason: str) -> UsageError:
    return UsageError(
        f"cannot be read: {reason}",
        place=f"run {run_id}, table `{table}`",
        remedy="Replay this run again with --force.",
    )


def _check_columns(table: str, run_id: str, found: Mapping[str, pl.DataType]) -> None:
    expected = dtypes(TABLES[table])
    lost = [name for name in expected if name not in found]
    other = [f"{name} as {found[name]}, not {kind}" for name, kind in expected.items() if found.get(name, kind) != kind]
    if lost or other:
        parts = ([f"no {', '.join(lost)}"] if lost else []) + other
        raise UsageError(
            "was written by another build of the program",
            place=f"run {run_id}, table `{table}`",
            found="; ".join(parts),
            expected=f"the columns of contract {CONTRACT_VERSION} as of this build",
            remedy="Replay this run again into the same output; `balise replay` sees that it is due.",
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


def completed_runs(out: Address) -> dict[str, dict[str, str]]:
    """Metadata of each complete run, without reading any table."""
    runs = run_ids(out)
    if is_url(out):
        addresses = {str(table_address(out, _MARKER, run)): run for run in runs}
        contents = storage.read_many(list(addresses))
        return {run: metadata_of(contents[place]) for place, run in addresses.items() if place in contents}
    return {run: metadata_of(Path(table_address(out, _MARKER, run))) for run in runs}


def metadata_of(source: Path | bytes) -> dict[str, str]:
    """What `write_run` was told about the run; nothing for a file that cannot be read."""
    try:
        found = pl.read_parquet_metadata(source)
    except (pl.exceptions.PolarsError, OSError):
        return {}
    return {key.removeprefix(PREFIX): value for key, value in found.items() if key.startswith(PREFIX)}


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
        return settings_from(tomllib.loads(read_bytes(address).decode()), Configuration, str(address))
    except (ConfigError, tomllib.TOMLDecodeError) as error:
        raise UsageError(
            f"was not written by this build of the program: {error}",
            place=shown(address),
            remedy="Replay the runs again into the same output; `balise replay` sees which are due.",
        ) from None


def write_config(out: Address, settings: Settings) -> None:
    """`OUT/config.toml`: the resolved configuration."""
    storage.write_bytes(join(out, "config.toml"), to_toml(settings).encode())


def _partition(run_id: str) -> str:
    return f"run_id={file_name(run_id)}"


def _read_remote(table: str, paths: list[str], runs: list[str]) -> pl.LazyFrame:
    contents = storage.read_many(paths)
    frames = []
    for path, run in zip(paths, runs, strict=True):
        if path not in contents:
            raise _unreadable(table, run, "no such object")
        try:
            frame = pl.read_parquet(contents[path])
        except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
            raise _unreadable(table, run, str(error).strip().partition("\n")[0]) from None
        _check_columns(table, run, frame.schema)
        frames.append(frame.lazy().with_columns(run_id=pl.lit(run)))
    return pl.concat(frames, how="diagonal")
