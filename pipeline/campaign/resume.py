"""Which runs are complete and unchanged, known without opening a log or a table.

`OUT/.catalogue/complete` keeps the outcome of each run with a proof: a digest over the states (size, times, inode)
of its log and all that decides its tables, and one over the state of its marker. It may be deleted at any time. A run
whose proof is another one goes to a worker, which holds contents against each other. Local results of local logs only.
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pydantic import TypeAdapter

from pipeline import storage
from pipeline.campaign.plan import Plan, RunJob, run_digests
from pipeline.campaign.waits import WAITS
from pipeline.results import catalogue, packs, store
from pipeline.results.outcome import RunOutcome
from pipeline.results.software import software_digest
from pipeline.storage.address import is_url, join
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
    place = _marker_states(job.out, [job.run_id]).get(job.run_id)
    return "" if place is None else f"{_outcome_key(job, log)} {place}"


def unchanged_outcomes(plan: Plan) -> list[RunOutcome]:
    """The outcomes of the runs of a plan that are complete, and whose log nobody has touched since."""
    known = outcomes_in_place(plan.out)
    candidates = ((job, known[job.run_id]) for job in plan.jobs if job.run_id in known)
    return [replace(outcome, skipped=True) for job, outcome in candidates if _is_still_valid(job, outcome)]


def outcomes_in_place(out: str) -> dict[str, RunOutcome]:
    """The outcomes that are kept of runs whose marker nobody has touched since."""
    known = kept_outcomes(out)
    places = _marker_states(out, list(known))
    return {run: outcome for run, outcome in known.items() if outcome.proof.partition(" ")[2] == places.get(run)}


def keep_in_place(out: str, known: Mapping[str, RunOutcome]) -> None:
    """Keep these outcomes of runs that lie elsewhere now, with the same content."""
    places = _marker_states(out, list(known))
    proofs = {run: outcome.proof.partition(" ")[0] for run, outcome in known.items()}
    _write_outcomes(out, [replace(outcome, proof=f"{proofs[run]} {places[run]}") for run, outcome in known.items()])


def keep_outcomes(plan: Plan, outcomes: Iterable[RunOutcome]) -> None:
    """Keep what can be proved, with what is known of runs that this call did not name."""
    if is_url(plan.out):
        return
    named = {job.run_id for job in plan.jobs}
    others = [outcome for run_id, outcome in kept_outcomes(plan.out).items() if run_id not in named]
    _write_outcomes(plan.out, [replace(outcome, attempts=1) for outcome in (*others, *outcomes) if outcome.proof])


def _write_outcomes(out: str, outcomes: list[RunOutcome]) -> None:
    """Keep the outcomes of a campaign that ends early."""
    # It can be done without, and so must not hide why a campaign ends.
    with contextlib.suppress(OutputError):
        catalogue.keep(out, _NAME, software_digest(), _OUTCOMES.dump_json(outcomes))


def kept_outcomes(out: str) -> dict[str, RunOutcome]:
    """The outcomes that this build of the program kept, by run id."""
    content = None if is_url(out) else catalogue.kept_content(out, _NAME, software_digest())
    try:
        outcomes = _OUTCOMES.validate_json(content or b"[]")
    except ValueError:
        return {}
    return {outcome.run_id: replace(outcome, seconds=0.0) for outcome in outcomes}


def _is_still_valid(job: RunJob, outcome: RunOutcome) -> bool:
    """Whether an outcome kept is still that of the same log, settings and program."""
    if is_url(job.address) or (job.write_route and not Path(job.write_route).exists()):
        return False
    try:
        return _outcome_key(job, storage.signature(Path(job.address))) == outcome.proof.partition(" ")[0]
    except OSError:
        return False


def _outcome_key(job: RunJob, log: tuple[storage.FileState, ...]) -> str:
    """Digest of all that an outcome depends on."""
    return hashlib.sha256(repr((job.address, log, run_digests(job, ""))).encode()).hexdigest()


def _marker_states(out: str, runs: Sequence[str]) -> dict[str, str]:
    """What changes with the marker of each of these runs that is there: with its `runs` file, or its pack's index."""
    packed = store.packed_runs_among(out, runs)
    files = {run: store.table_address(out, "runs", run) for run in runs}
    files |= {run: join(out, packs.file_name(packs.INDEX, place.pack.name)) for run, place in packed.items()}
    states = {file: storage.version(file) for file in set(files.values())}
    return {
        run: hashlib.sha256(state.encode()).hexdigest()
        for run, file in files.items()
        if (state := states[file]) is not None
    }
