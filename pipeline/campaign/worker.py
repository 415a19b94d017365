"""One run from its log to its tables on disk: what a worker does, on this machine or another."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import polars as pl

from pipeline import storage
from pipeline.campaign import lock
from pipeline.campaign.interruption import ENDING
from pipeline.campaign.outcome import (
    RunFailure,
    failed_tables,
    failure_of,
    outcome_of,
    worst_status,
)
from pipeline.campaign.plan import RunJob, run_digests, site_at
from pipeline.campaign.recorded_log import RecordedLog
from pipeline.campaign.resume import proof_of
from pipeline.read.site.route import with_route
from pipeline.results import store
from pipeline.results.manifest import digests_in_marker
from pipeline.results.marker import sha256
from pipeline.results.outcome import RunOutcome
from pipeline.results.software import software_digest
from pipeline.storage import files
from schemas.enums import RunStatus
from schemas.errors import OutputError, SiteError, UsageError
from schemas.run import RunLog, RunTables, Site
from schemas.version import SOFTWARE

# Tables that an outcome is read from, beside the marker.
_OUTCOME = ("hazards", "passages")


def replay_one(job: RunJob) -> RunOutcome:
    """Replay a run unless its tables are there already, and write them.

    Whatever is wrong with the run, a panic of a decoder included, becomes a `runs` row of status `failed`; only an
    output that cannot be written, a changed site and an interruption leave this function as an exception.
    """
    log = RecordedLog(job)
    begun = time.monotonic()
    try:
        outcome = _replay_one(job, log)
    except (OutputError, SiteError, UsageError, *ENDING):
        raise
    except BaseException as error:
        outcome = fail_run(job, failure_of(error, lasting=bool(log.digest)), log)
    return outcome if outcome.skipped else replace(outcome, seconds=time.monotonic() - begun)


def _replay_one(job: RunJob, log: RecordedLog) -> RunOutcome:
    """Replay a run, unless its results are there already."""
    _require_same_software(job)
    site = site_at(job.site, job.site_digest, job.config.site)
    if (known := log.known_digest()) and _is_done(job, known):
        return _earlier_outcome(job, log)
    with log.local_copy() as path:
        if job.previous is not None and _is_done(job, log.digest_at(path)):
            return _earlier_outcome(job, log)
        run = log.read(path)
        site = with_route(site, job.route, job.config.site) if job.route else site
        tables = _replay(job, run, site)
        if job.write_route:
            _write_travelled_route(job, run, site)
    _write_if_held(job, tables, _run_metadata(job, log, worst_status(tables.runs)) | {"log_digest": run.input_digest})
    return _with_proof(job, log, _outcome_of_tables(job, tables.runs, tables.hazards, tables.passages))


def fail_run(job: RunJob, failure: RunFailure, log: RecordedLog | None = None) -> RunOutcome:
    """Write the tables of a run that failed: one `runs` row that says why, the others empty.

    Unless the reason is lasting (a worker was lost, a run took too long) the next campaign tries the run again.
    """
    metadata = _run_metadata(job, log, RunStatus.FAILED) | ({} if failure.lasting else {"redo": "yes"})
    _write_if_held(job, failed_tables(job, failure.error), metadata)
    outcome = RunOutcome(job.run_id, RunStatus.FAILED, failure.error, trace=failure.trace)
    return _with_proof(job, log, outcome) if failure.lasting and log is not None else outcome


def _with_proof(job: RunJob, log: RecordedLog, outcome: RunOutcome) -> RunOutcome:
    """An outcome with what proves of which log it is."""
    return replace(outcome, proof=proof_of(job, log.state))


def _write_if_held(job: RunJob, tables: RunTables, metadata: Mapping[str, str]) -> None:
    """Write the run, if its campaign is the one that holds the output still."""
    try:
        _write_held(job, tables, metadata)
    except storage.SweptError:
        # The marker may be gone already: without a second go a complete run could be left without.
        _write_held(job, tables, metadata)


def _write_held(job: RunJob, tables: RunTables, metadata: Mapping[str, str]) -> None:
    """Write the results of a run, while the lock of the campaign is still held."""
    if job.campaign:
        lock.check_held(job.out, job.campaign)
    store.write_run(tables, job.out, metadata)


def _require_same_software(job: RunJob) -> None:
    """Refuse to replay with another version of the program than the campaign's."""
    if software_digest() != job.software_digest:
        raise UsageError(
            "this worker runs another version of the program than the campaign",
            found=SOFTWARE,
            remedy="Install the same version on all workers, and restart them.",
        )


def _is_done(job: RunJob, files_digest: str) -> bool:
    """Whether the results of a run are there, and of the same log, settings and program."""
    if job.previous is None or job.previous.get("redo") == "yes":
        return False
    if job.write_route and not files.exists(job.write_route):
        return False
    made = run_digests(job, files_digest)
    return all(job.previous.get(key) == value for key, value in made.items()) and _is_whole(job, job.previous)


def _is_whole(job: RunJob, marker: Mapping[str, str]) -> bool:
    """The tables that the outcome is read from are those that the marker was written with."""
    expected = digests_in_marker(marker)
    return all(sha256(store.content_of(job.out, name, job.run_id)) == expected.get(name) for name in _OUTCOME)


def _earlier_outcome(job: RunJob, log: RecordedLog) -> RunOutcome:
    """The outcome of a run that is complete already."""
    runs, hazards, passages = (store.tables_of(job.out, name, [job.run_id]) for name in ("runs", *_OUTCOME))
    return _with_proof(job, log, replace(_outcome_of_tables(job, runs, hazards, passages), skipped=True))


def _outcome_of_tables(job: RunJob, *tables: pl.DataFrame) -> RunOutcome:
    """The outcome of a run, of its tables."""
    return outcome_of(job.run_id, job.address, job.config.advice.low_availability, *tables)


def _replay(job: RunJob, run: RunLog, site: Site) -> RunTables:
    """Replay a run."""
    # Imported here because it takes most of a second, and the parent of a campaign never needs it.
    from pipeline.one_run import replay

    return replay(run, site, job.vehicle, job.config)


def _write_travelled_route(job: RunJob, run: RunLog, site: Site) -> None:
    """The route by the run's `primary` solution, or the first by name: all of them were on the same train."""
    # Imported here for the same reason.
    from pipeline.stages.matching.match import travelled_route
    from pipeline.stages.prepare import prepare

    prepared = prepare(run, site, job.vehicle, job.config)
    match = prepared.match(prepared.run.main_solution())
    route = travelled_route(match)
    storage.write_bytes(job.write_route, route.write_csv().encode())


def _run_metadata(job: RunJob, log: RecordedLog | None, status: RunStatus) -> dict[str, str]:
    """What the results of a run say about their origin."""
    digest, listed = ("", "") if log is None else (log.digest, log.files)
    raw = {"raw_files": log.raw_files} if log is not None and log.raw_files else {}
    return {
        **run_digests(job, digest),
        "log_files": listed,
        **raw,
        "site_files": job.site_files,
        "status": status.value,
    }
