"""One run from its log to its tables on disk: what a worker does, on this machine or another."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from pipeline import storage
from pipeline.campaign import known_logs, lock
from pipeline.campaign.outcome import (
    Failure,
    RunOutcome,
    changed,
    failed_tables,
    failure_of,
    outcome_of,
    with_faults,
    worst,
)
from pipeline.campaign.plan import RunJob, digests, software_digest
from pipeline.ingest import read_run
from pipeline.results import manifest, store
from pipeline.site.read import read_site
from pipeline.site.route import with_route
from pipeline.storage import files
from pipeline.storage.address import is_url, redacted
from schemas.enums import RunStatus
from schemas.errors import BaliseError, InputError, OutputError, SiteError, UsageError
from schemas.run import RunLog, RunTables, Site
from schemas.version import SOFTWARE


class LogContent(NamedTuple):
    """What a log holds: one digest over it, and the list of its files; empty until it was read."""

    digest: str = ""
    files: str = ""


def replay_one(job: RunJob) -> RunOutcome:
    """Replay a run unless its tables are there already, and write them.

    Whatever is wrong with the run becomes a `runs` row of status `failed`; only an output that cannot
    be written, a changed site and an interruption leave this function as an exception.
    """
    begun = time.monotonic()
    content = LogContent()
    try:
        _same_software(job)
        site = _site(job.site, job.site_digest)
        version = _version(job)
        if (known := known_logs.known_digest(job, version)) and _is_done(job, known):
            return _earlier(job)
        with _fetched(job, version) as path:
            before = _signature(path)
            if job.previous is not None:
                content = _content(job, path, version)
                if _is_done(job, content.digest):
                    return _earlier(job)
            try:
                run = read_run(path, job.config.ingest)
            except Exception:
                content = content if content.digest else _content(job, path, version)
                raise
            content = content if content.digest else _content(job, path, version, run.input_digest)
            site = with_route(site, job.route) if job.route else site
            tables = _replayed(job, run, site)
            if job.write_route:
                _write_found_route(job, run, site)
            if storage.signature(path) != before:
                raise changed(path)
    except (OutputError, SiteError, UsageError):
        raise
    except Exception as error:
        failure = failure_of(error, lasting=bool(content.digest))
        return fail_run(job, failure.error, content, failure, time.monotonic() - begun)
    metadata = _metadata(job, content, worst(tables.runs)) | {"log_digest": run.input_digest}
    _write(job, tables, metadata)
    outcome = outcome_of(job, tables.runs, sum(file.size_bytes for file in before), time.monotonic() - begun)
    return with_faults(outcome, tables.hazards)


def fail_run(
    job: RunJob, error: str, content: LogContent | None = None, failure: Failure | None = None, seconds: float = 0.0
) -> RunOutcome:
    """Write the tables of a run that failed: one `runs` row that says why, the others empty.

    Without `failure` (a worker was lost, a run took too long) the next campaign tries the run again.
    """
    metadata = _metadata(job, content or LogContent(), RunStatus.FAILED)
    if failure is None or not failure.lasting:
        metadata["redo"] = "yes"
    _write(job, failed_tables(job, error), metadata)
    trace = failure.trace if failure else None
    return RunOutcome(job.run_id, RunStatus.FAILED, error, defect=trace is not None, trace=trace, seconds=seconds)


def _version(job: RunJob) -> str | None:
    """What a store says of the log, before it is fetched."""
    return storage.version(job.address) if is_url(job.address) else None


@contextlib.contextmanager
def _fetched(job: RunJob, version: str | None) -> Iterator[Path]:
    """The log on this machine; errors name it by its own address."""
    with storage.local_copy(job.address) as path, _told_of(job, path):
        if _version(job) != version:
            raise changed(redacted(job.address))
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
    storage.reach(address)  # or a worker that the store does not answer would end the campaign, not fail its run
    site = read_site(address)
    if site.digest != digest:
        raise SiteError(
            "has changed since the campaign began", place=redacted(address), remedy="Start the campaign again."
        )
    return site


def _same_software(job: RunJob) -> None:
    if software_digest() != job.software_digest:
        raise UsageError(
            "this worker runs another version of the program than the campaign",
            found=SOFTWARE,
            remedy="Install the same version on all workers, and restart them.",
        )


def _signature(path: Path) -> tuple[storage.FileState, ...]:
    with _as_input_error(path):
        return storage.signature(path)


def _content(job: RunJob, path: Path, version: str | None, known: str = "") -> LogContent:
    """What the log holds, kept for the next campaign; `known`: the SHA-256 of a log of one file that was read."""
    with _as_input_error(path):
        listed = storage.file_digests(path, known)
    content = LogContent(storage.digest_of_files(listed), manifest.listing(listed))
    known_logs.remember(job, version, content.digest)
    return content


@contextlib.contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", place=str(path)) from None


@contextlib.contextmanager
def _told_of(job: RunJob, path: Path) -> Iterator[None]:
    """Errors name the log by its own address, not by that of a temporary copy."""
    try:
        yield
    except BaliseError as error:
        if error.place and str(path) != job.address:
            error.place = error.place.replace(str(path), redacted(job.address))
        raise


def _is_done(job: RunJob, files_digest: str) -> bool:
    if job.previous is None or job.previous.get("redo") == "yes":
        return False
    if job.write_route and not files.exists(job.write_route):
        return False
    return all(job.previous.get(key) == value for key, value in digests(job, files_digest).items())


def _earlier(job: RunJob) -> RunOutcome:
    """The outcome of a run that is complete already."""
    runs = store.read_table(job.out, "runs", job.run_id).collect()
    outcome = replace(outcome_of(job, runs, 0, 0.0), skipped=True)
    if not outcome.hazards:
        return outcome
    return with_faults(outcome, store.read_table(job.out, "hazards", job.run_id).collect())


def _replayed(job: RunJob, run: RunLog, site: Site) -> RunTables:
    # Imported here because it takes most of a second, and the parent of a campaign never needs it.
    from pipeline.stages import replay

    return replay(run, site, job.vehicle, job.config)


def _write_found_route(job: RunJob, run: RunLog, site: Site) -> None:
    # Imported here for the same reason.
    from pipeline.campaign.found_routes import found_route_of

    route = found_route_of(run, site, job.vehicle, job.config)
    storage.write_bytes(job.write_route, route.write_csv().encode())


def _metadata(job: RunJob, content: LogContent, status: RunStatus) -> dict[str, str]:
    listed = {"log_files": content.files, "site_files": job.site_files}
    return {**digests(job, content.digest), **listed, "status": status.value}
