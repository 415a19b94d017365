"""Which runs are complete and unchanged, known without opening a log or a table.

`OUT/.catalogue/complete` keeps the outcome of each run with a proof: a digest over the states (size, times, inode) of
its log and of its `runs` file, and over all that decides its tables. It may be deleted at any time. A run whose proof
is another one goes to a worker, which holds contents against each other. Local results of local logs only.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from pydantic import TypeAdapter

from pipeline import storage
from pipeline.campaign.plan import Plan, RunJob, digests
from pipeline.campaign.waits import WAITS
from pipeline.results import catalogue, store
from pipeline.results.outcome import RunOutcome
from pipeline.results.software import software_digest
from pipeline.storage.address import is_url
from schemas.arrays import NS_PER_S
from schemas.errors import OutputError

_NAME = "complete"
_OUTCOMES = TypeAdapter(list[RunOutcome])


def proof_of(job: RunJob, log: tuple[storage.FileState, ...]) -> str:
    """The proof that the tables there now were made of the log in this state; empty where there is none."""
    if is_url(job.address) or is_url(job.out) or not log:
        return ""
    if max(file.changed_ns for file in log) > time.time_ns() - WAITS.settled_s * NS_PER_S:
        return ""
    try:
        return _digest(job, log)
    except OSError:
        return ""


def unchanged(plan: Plan) -> list[RunOutcome]:
    """The outcomes of the runs of a plan that are complete, and whose log nobody has touched since."""
    known = kept(plan.out)
    candidates = ((job, known[job.run_id]) for job in plan.jobs if job.run_id in known)
    return [replace(outcome, skipped=True) for job, outcome in candidates if _holds(job, outcome)]


def keep(plan: Plan, outcomes: Iterable[RunOutcome]) -> None:
    """Keep what can be proved, beside what is known of runs that this call did not name."""
    if is_url(plan.out):
        return
    named = {job.run_id for job in plan.jobs}
    others = [outcome for run_id, outcome in kept(plan.out).items() if run_id not in named]
    rows = [replace(outcome, attempts=1) for outcome in (*others, *outcomes) if outcome.proof]
    # It can be done without, and so must not hide why a campaign ends.
    with contextlib.suppress(OutputError):
        catalogue.keep(plan.out, _NAME, software_digest(), _OUTCOMES.dump_json(rows))


def kept(out: str) -> dict[str, RunOutcome]:
    """The outcomes that this build of the program kept, by run id."""
    content = None if is_url(out) else catalogue.kept(out, _NAME, software_digest())
    try:
        outcomes = _OUTCOMES.validate_json(content or b"[]")
    except ValueError:
        return {}
    return {outcome.run_id: replace(outcome, seconds=0.0) for outcome in outcomes}


def _holds(job: RunJob, outcome: RunOutcome) -> bool:
    if is_url(job.address) or (job.write_route and not Path(job.write_route).exists()):
        return False
    try:
        return _digest(job, storage.signature(Path(job.address))) == outcome.proof
    except OSError:
        return False


def _digest(job: RunJob, log: tuple[storage.FileState, ...]) -> str:
    marker = storage.signature(Path(store.table_address(job.out, "runs", job.run_id)))
    return hashlib.sha256(repr((job.address, log, marker, digests(job, ""))).encode()).hexdigest()
