"""What became of a run, and failures in words."""

from __future__ import annotations

import errno
import traceback
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Any

import polars as pl

from pipeline.campaign.plan import RunJob
from pipeline.results.figures.hazard_words import hazard_words
from pipeline.results.figures.head import HAZARD_COUNTS, is_judged, worst_verdict
from pipeline.results.outcome import VERDICT_FIGURES, RunOutcome
from pipeline.stages.prepare import Provenance
from pipeline.storage.address import Address, redacted
from schemas.enums import RunStatus
from schemas.errors import BaliseError, InputError
from schemas.frozen import frozen
from schemas.run import RunTables
from schemas.tables import TABLES
from schemas.version import SOFTWARE
from schemas.words import lost_words, reason_words


@frozen
class RunFailure:
    """Why a run failed; a `lasting` reason comes again with the same input, so that the run is not tried again."""

    error: str
    lasting: bool
    trace: str | None = None


Result = Future[RunOutcome]
NO_MEMORY = "not enough memory. Give it more memory or fewer --jobs; the next call tries it again."


class ChangedError(InputError):
    """The log was written to while it was read: trying again may succeed."""


def changed_error(address: Address) -> ChangedError:
    """The error for a log that changed while it was read."""
    return ChangedError("changed while it was read", place=str(address), remedy="Replay it again when it is complete.")


def overdue_text(limit_s: float) -> str:
    """The error text of a run that took too long."""
    return f"took longer than the time limit of {limit_s:g} s"


def lost_text(attempts: int) -> str:
    """The error text of a run whose workers died."""
    return (
        f"its worker died {attempts} times (killed, or out of memory). "
        "Give it more memory or fewer --jobs; the next call tries it again."
    )


def never_begun_text(workers: int) -> str:
    """The error text of a run for which no worker came up."""
    return f"{workers} workers died before they started this run. See the logs of the workers."


def failure_of(error: BaseException, lasting: bool) -> RunFailure:
    """A failure in words, and whether the same input would fail again."""
    if isinstance(error, BaliseError):
        again = isinstance(error, InputError) and not isinstance(error, ChangedError) and not _may_pass(error)
        return RunFailure(redacted(str(error)), lasting and again)
    if _lacks_memory(error):
        return RunFailure(NO_MEMORY, lasting=False)
    text = f"defect of the program: {type(error).__name__}: {error}"
    trace = "".join(traceback.format_exception(error))
    return RunFailure(text, lasting=False, trace=trace)


def _lacks_memory(error: BaseException | None) -> bool:
    """Whether memory ran out; also where a library could not be loaded for want of it."""
    while error is not None:
        without = isinstance(error, OSError) and error.errno == errno.ENOMEM
        unloaded = isinstance(error, ImportError) and ("map segment" in str(error) or "allocate" in str(error))
        if isinstance(error, MemoryError) or without or unloaded:
            return True
        error = error.__cause__ or error.__context__
    return False


def _may_pass(error: BaseException | None) -> bool:
    """A disk or a share that did not give the log may give it the next time; a file that is not there is the log's."""
    while error is not None:
        if isinstance(error, OSError) and error.errno is not None and not isinstance(error, FileNotFoundError):
            return True
        error = error.__cause__ or error.__context__
    return False


def worst_status(runs: pl.DataFrame) -> RunStatus:
    """The status of a run with several solutions: the worst of theirs."""
    statuses = set(runs["status"].cast(pl.String).to_list())
    return next((s for s in (RunStatus.FAILED, RunStatus.PARTIAL) if s.value in statuses), RunStatus.OK)


def outcome_of(
    run_id: str, log: str, low: float, runs: pl.DataFrame, hazards: pl.DataFrame, passages: pl.DataFrame
) -> RunOutcome:
    """The outcome that a run's own tables show; below `low` availability it says what the moving time was lost to."""
    rows = runs.rows(named=True)
    errors = [row["error"] for row in rows if row["error"] is not None]
    judged = [row for row in rows if is_judged(row) and row["missed_detections"] is not None]
    hazard_rows = sum(row[name] for row in judged for name in HAZARD_COUNTS)
    verdict = worst_verdict([row["verdict"] for row in rows])
    # The solutions that have the verdict of the run.
    heads = [row for row in rows if verdict is not None and row["verdict"] == verdict.value]
    return RunOutcome(
        run_id=run_id,
        status=worst_status(runs),
        error=errors[0] if errors else None,
        verdict=verdict,
        hazards=hazard_rows if judged else None,
        missed_detections=sum(row["missed_detections"] for row in judged) if judged else None,
        why=_verdict_reasons(heads, several=len(rows) > 1),
        faults=tuple(hazard_words(hazards, passages)),
        log=redacted(log),
        **(_verdict_figures(heads[0], low) if heads else {}),
    )


def _verdict_figures(row: Mapping[str, Any], low: float) -> dict[str, Any]:
    """Figures next to the verdict, of the solution that heads the run."""
    figures = {name: row[name] for name in VERDICT_FIGURES}
    figures |= {name: tuple(row[name] or ()) for name in ("remedies", "remedies_gain")}
    available = row["availability"]
    if available is None or available >= low:
        return figures
    return figures | {"lost": lost_words(row["lost_to"], row["lost_to_share"], row["lost_to_monitor"], 1.0 - available)}


def _verdict_reasons(rows: Sequence[Mapping[str, Any]], several: bool) -> str:
    """What decides the verdict, of each solution that has it; `several`: of several, so that they are named."""
    return "; ".join((f"{row['solution']}: " if several else "") + reason_words(row) for row in rows)


def failed_tables(job: RunJob, error: str) -> RunTables:
    """Tables without content but for the row that says why; no path, so that they are the same anywhere."""
    # Imported here because it takes a while, and only runs that fail need it.
    from pipeline.stages.run_row.summary import failed_row

    folder = job.address.rstrip("/").rpartition("/")[0]
    made = Provenance(job.config_digest, "", SOFTWARE, job.config.calibration.runs)
    row = failed_row(error.replace(f"{redacted(folder)}/", ""), made)
    empty = {name: schema.create_empty() for name, schema in TABLES.items() if name != "runs"}
    return RunTables(run_id=job.run_id, runs=row, **empty)
