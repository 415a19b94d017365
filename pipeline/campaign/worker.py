"""One run from its log to its tables on disk: what a worker does, on this machine or another."""

from __future__ import annotations

import contextlib
import os
import resource
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import dataframely as dy
import polars as pl

from pipeline import storage, store
from pipeline.campaign import fetched, lock
from pipeline.campaign.plan import RunJob, digests, software_digest
from pipeline.ingest import read_run
from pipeline.ingest.files import Address, is_url
from pipeline.ingest.site import read_site
from schemas.config import digest_of
from schemas.enums import RunStatus
from schemas.errors import BaliseError, InputError, OutputError, SiteError, UsageError
from schemas.run import RunLog, RunTables, Site
from schemas.tables import CONTRACT_VERSION, TABLES, Runs
from schemas.version import SOFTWARE


@dataclass(frozen=True)
class RunOutcome:
    """What became of one run. `defect` is ours, with its `trace`; everything else is the input's."""

    run_id: str
    status: RunStatus
    error: str | None = None
    skipped: bool = False
    defect: bool = False
    trace: str | None = None
    seconds: float = 0.0
    log_bytes: int = 0
    hazards: int = 0
    missed_detections: int = 0
    peak_memory_bytes: int = 0


@dataclass(frozen=True)
class _Failure:
    error: str
    shown: str
    lasting: bool
    trace: str | None = None


def replay_one(job: RunJob) -> RunOutcome:
    """Replay a run unless its tables are there already, and write them.

    Whatever is wrong with the run becomes a `runs` row of status `failed`; only an output that cannot
    be written, a changed site and an interruption leave this function as an exception.
    """
    begun = time.monotonic()
    files_digest = ""
    try:
        _same_software(job)
        site = _site(job.site, job.site_digest)
        version = _version(job)
        if (known := fetched.known_digest(job, version)) and _is_done(job, known):
            return _earlier(job)
        with _fetched(job, version) as path:
            before, files_digest = _identity(path)
            fetched.remember(job, version, files_digest)
            if _is_done(job, files_digest):
                return _earlier(job)
            run = read_run(path, job.config.ingest)
            tables = _replayed(job, run, site)
            if storage.signature(path) != before:
                raise _changed(path)
    except (OutputError, SiteError, UsageError):
        raise
    except Exception as error:
        failure = _failure(error, lasting=bool(files_digest))
        return fail_run(job, failure.error, files_digest, failure, time.monotonic() - begun)
    metadata = _metadata(job, files_digest, _worst(tables.runs)) | {"log_digest": run.input_digest}
    _write(job, tables, metadata)
    return _outcome(job, tables.runs, sum(entry[1] for entry in before), time.monotonic() - begun)


def replay_within(job: RunJob, limit_s: float) -> RunOutcome:
    """`replay_one` under a time limit that ends the process: for workers that the caller cannot kill."""
    timer = threading.Timer(limit_s, os._exit, args=(1,))
    timer.daemon = True
    timer.start()
    try:
        return replay_one(job)
    finally:
        timer.cancel()


def fail_run(
    job: RunJob, error: str, files_digest: str = "", failure: _Failure | None = None, seconds: float = 0.0
) -> RunOutcome:
    """Write the tables of a run that failed: one `runs` row that says why, the others empty.

    Without `failure` (a worker was lost, a run took too long) the next campaign tries the run again.
    """
    metadata = _metadata(job, files_digest, RunStatus.FAILED)
    if failure is None or not failure.lasting:
        metadata["redo"] = "yes"
    _write(job, _failed_tables(job, error), metadata)
    trace = failure.trace if failure else None
    shown = failure.shown if failure else error
    return RunOutcome(job.run_id, RunStatus.FAILED, shown, defect=trace is not None, trace=trace, seconds=seconds)


def overdue(limit_s: float) -> str:
    """The reason of a run that was given up."""
    return f"took longer than the time limit of {limit_s:g} s"


class _ChangedError(InputError):
    """The log was written to while it was read: trying again may succeed."""


def _changed(address: Address) -> _ChangedError:
    return _ChangedError(f"{address}: changed while it was read. Replay it again when it is complete.")


def _version(job: RunJob) -> str | None:
    """What a store says of the log, before it is fetched."""
    return storage.version(job.address) if is_url(job.address) else None


@contextlib.contextmanager
def _fetched(job: RunJob, version: str | None) -> Iterator[Path]:
    """The log on this machine; errors name it by its own address."""
    with storage.local_copy(job.address) as path, _told_of(job, path):
        if _version(job) != version:
            raise _changed(storage.redacted(job.address))
        yield path


def _write(job: RunJob, tables: RunTables, metadata: Mapping[str, str]) -> None:
    """Write the run, if its campaign is the one that holds the output still."""
    try:
        _write_held(job, tables, metadata)
    except storage.SweptError:
        # The marker may be gone already: without a second go a complete run could be left without.
        _write_held(job, tables, metadata)


def _write_held(job: RunJob, tables: RunTables, metadata: Mapping[str, str]) -> None:
    if job.campaign:
        lock.check_held(job.out, job.campaign)
    store.write_run(tables, job.out, metadata)


@lru_cache(maxsize=2)
def _site(address: str, digest: str) -> Site:
    """The site, read once per worker."""
    site = read_site(address)
    if site.digest != digest:
        raise SiteError(
            "has changed since the campaign began", place=storage.redacted(address), remedy="Start the campaign again."
        )
    return site


def _same_software(job: RunJob) -> None:
    if software_digest() != job.software_digest:
        raise UsageError(
            "this worker runs another version of the program than the campaign",
            found=SOFTWARE,
            remedy="Install the same version on all workers, and restart them.",
        )


def _identity(path: Path) -> tuple[tuple[tuple[str, int, int, int], ...], str]:
    try:
        return storage.signature(path), storage.content_digest(path)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", place=str(path)) from None


@contextlib.contextmanager
def _told_of(job: RunJob, path: Path) -> Iterator[None]:
    """Errors name the log by its own address, not by that of a temporary copy."""
    try:
        yield
    except BaliseError as error:
        if error.place and str(path) != job.address:
            error.place = error.place.replace(str(path), storage.redacted(job.address))
        raise


def _is_done(job: RunJob, files_digest: str) -> bool:
    if job.previous is None or job.previous.get("redo") == "yes":
        return False
    return all(job.previous.get(key) == value for key, value in digests(job, files_digest).items())


def _earlier(job: RunJob) -> RunOutcome:
    """The outcome of a run that is complete already."""
    runs = store.read_table(job.out, "runs", job.run_id).collect()
    outcome = _outcome(job, runs, 0, 0.0)
    return RunOutcome(**{**outcome.__dict__, "skipped": True})


def _replayed(job: RunJob, run: RunLog, site: Site) -> RunTables:
    # Imported here because it takes most of a second, and the parent of a campaign never needs it.
    from pipeline.stages import replay

    return replay(run, site, job.vehicle, job.config)


def _failure(error: Exception, lasting: bool) -> _Failure:
    """How a failure is told, and whether the same input would fail again."""
    if isinstance(error, BaliseError):
        shown = storage.redacted(str(error))
        return _Failure(
            shown, shown, lasting and isinstance(error, InputError) and not isinstance(error, _ChangedError)
        )
    if isinstance(error, MemoryError):
        return _Failure("not enough memory", "not enough memory", lasting=False)
    text = f"defect of the program: {type(error).__name__}: {error}"
    trace = "".join(traceback.format_exception(error))
    return _Failure(text, text, lasting=False, trace=trace)


def _metadata(job: RunJob, files_digest: str, status: RunStatus) -> dict[str, str]:
    return {**digests(job, files_digest), "status": status.value}


def _worst(runs: pl.DataFrame) -> RunStatus:
    found = set(runs["status"].cast(pl.String).to_list())
    return next((s for s in (RunStatus.FAILED, RunStatus.PARTIAL) if s.value in found), RunStatus.OK)


def _outcome(job: RunJob, runs: pl.DataFrame, log_bytes: int, seconds: float) -> RunOutcome:
    errors = runs["error"].drop_nulls().to_list()
    counts = runs.select(pl.sum("hazards_1a", "hazards_1b", "hazards_shift", "missed_detections")).row(0)
    return RunOutcome(
        run_id=job.run_id,
        status=_worst(runs),
        error=errors[0] if errors else None,
        seconds=seconds,
        log_bytes=log_bytes,
        hazards=sum(counts[:3]),
        missed_detections=counts[3],
        peak_memory_bytes=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    )


def _failed_tables(job: RunJob, error: str) -> RunTables:
    """Tables without content but for the row that says why; no path, so that they are the same anywhere."""
    folder = job.address.rstrip("/").rpartition("/")[0]
    known = {
        "status": RunStatus.FAILED.value,
        "error": error.replace(f"{storage.redacted(folder)}/", ""),
        "config_digest": digest_of(job.config, job.vehicle),
        "software": SOFTWARE,
        "contract": CONTRACT_VERSION,
    }
    columns = {name: [known.get(name, _blank(column))] for name, column in Runs.columns().items()}
    row = pl.DataFrame(columns, schema=Runs.create_empty().schema)
    empty = {name: schema.create_empty() for name, schema in TABLES.items() if name != "runs"}
    return RunTables(run_id=job.run_id, runs=row, **empty)


def _blank(column: dy.Column) -> object:
    """Null where the contract allows it, else nothing counted and nothing named."""
    if column.nullable:
        return None
    return 0 if isinstance(column, dy.Int64) else ""
