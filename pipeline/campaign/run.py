"""A campaign from its plan to the tables over all runs.

Runs are handed out and their outcomes collected, whatever happens to workers; then come the tables over all runs
(CONTRACT section 3), and the manifest.
"""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from dataclasses import dataclass, replace

import polars as pl

from pipeline import storage
from pipeline.campaign.cluster import DaskEngine
from pipeline.campaign.engines import HAS_ALARM, Engine, LocalEngine, SerialEngine
from pipeline.campaign.interruption import ENDING, Interrupted, listen_for_signals
from pipeline.campaign.lock import hold_output
from pipeline.campaign.outcome import Result, RunFailure, failure_of, lost_text, never_begun_text, overdue_text
from pipeline.campaign.plan import Plan, RunJob, with_previous
from pipeline.campaign.resume import keep_outcomes, unchanged_outcomes
from pipeline.campaign.waits import WAITS
from pipeline.campaign.watch import Follower
from pipeline.campaign.worker import fail_run
from pipeline.results import manifest, store
from pipeline.results.manifest import note_settings
from pipeline.results.marker import metadata_of, sha256
from pipeline.results.outcome import CampaignSummary, RunOutcome
from pipeline.results.software import software_digest
from pipeline.storage.address import Address, is_url, join
from pipeline.storage.described import table_bytes
from schemas.campaign import CAMPAIGN_TABLES
from schemas.config import Configuration, digest_of
from schemas.errors import BaliseError, UsageError
from schemas.frozen import frozen
from schemas.version import SOFTWARE


@frozen
class _Attempt:
    """One attempt at a run, and how often a worker was to begin it."""

    job: RunJob
    number: int = 1
    starts: int = 1


@dataclass
class _RunUnderWay:
    """A run that an engine has, and since when."""

    attempt: _Attempt
    since_s: float
    handed_s: float
    overdue: bool = False
    never_started: bool = False


class CampaignLoop:
    """Takes all jobs through an engine; `outcomes` in order of their ends.

    `limit_s`: how long a run may take before it is given up [s]; `known`: the outcomes of runs that are complete.
    """

    def __init__(
        self,
        jobs: Sequence[RunJob],
        engine: Engine,
        limit_s: float,
        watches: Sequence[Follower],
        known: Sequence[RunOutcome] = (),
    ) -> None:
        self.outcomes: list[RunOutcome] = []
        self._engine = engine
        self._limit_s = limit_s
        self._watches = watches
        self._waiting = deque(map(_Attempt, jobs))
        self._under_way: dict[Result, _RunUnderWay] = {}
        self._known = known
        self._planned = len(jobs) + len(known)
        self._stop: int | None = None
        self._said = False
        self._disturbed = False

    def stop_at_next_look(self, signum: int) -> None:
        """End at the next look, because of this signal."""
        self._stop = signum

    @property
    def is_disturbed(self) -> bool:
        """Whether a worker may have left something half written: lost, ended, or under way still."""
        return self._disturbed or bool(self._under_way)

    def run_to_end(self) -> None:
        """Go on until every run has its outcome. Raises `Interrupted` when asked to stop."""
        for outcome in self._known:
            self._note_outcome(outcome)
        while self._waiting or self._under_way:
            self._hand_out()
            done, _ = wait(self._under_way, timeout=WAITS.look_s, return_when=FIRST_COMPLETED)
            if self._stop is not None:
                raise Interrupted(self._stop)
            for result in done:
                self._note_outcome(self._collect_outcome(result))
            self._end_overdue()
            self._look_for_workers()
            now = time.monotonic()
            ages = [(item.attempt.job.run_id, now - item.since_s) for item in self._under_way.values()]
            for watch in self._watches:
                watch.look(ages)

    def _hand_out(self) -> None:
        """Hand runs to the engine, as many as it has capacity for."""
        capacity = self._engine.capacity()
        while self._waiting and len(self._under_way) < capacity and self._stop is None:
            attempt = self._waiting.popleft()
            now = time.monotonic()
            self._under_way[self._engine.submit(attempt.job)] = _RunUnderWay(attempt, now, now)

    def _note_outcome(self, outcome: RunOutcome | None) -> None:
        """Keep the outcome of a run, and tell all watches."""
        if outcome is not None:
            self.outcomes.append(outcome)
            for watch in self._watches:
                watch.finished(outcome)

    def _collect_outcome(self, result: Result) -> RunOutcome | None:
        """The outcome, or none where the run is tried again."""
        item = self._under_way.pop(result)
        attempt = item.attempt
        try:
            error = CancelledError() if result.cancelled() else result.exception()
            if error is None:
                return replace(result.result(), attempts=attempt.number)
            if item.overdue:
                return _failed_outcome(attempt, RunFailure(overdue_text(self._limit_s), lasting=False))
            if item.never_started:
                return self._after_loss(attempt, begun=False)
            if isinstance(error, CancelledError):
                raise UsageError(
                    "the cluster cancelled this campaign", remedy="Repeat the command: complete runs are skipped."
                )
            if self._engine.is_lost_worker(error):
                return self._after_loss(attempt, self._engine.has_begun(result))
            if isinstance(error, (BaliseError, *ENDING)):
                raise error
            # The worker could not even tell what became of the run.
            return _failed_outcome(attempt, failure_of(error, lasting=False))
        finally:
            self._engine.forget_result(result)

    def _after_loss(self, attempt: _Attempt, begun: bool) -> RunOutcome | None:
        """A run that was under way when its worker died has one more attempt; one that waited has lost nothing."""
        if not begun and attempt.starts < WAITS.starts:
            self._waiting.appendleft(replace(attempt, starts=attempt.starts + 1))
            return None
        if begun and attempt.number < WAITS.attempts:
            self._disturbed = True
            for watch in self._watches:
                watch.lost(attempt.job.run_id, attempt.number)
            self._waiting.appendleft(_Attempt(attempt.job, attempt.number + 1))
            return None
        return _failed_outcome(
            attempt, RunFailure(lost_text(attempt.number) if begun else never_begun_text(attempt.starts), lasting=False)
        )

    def _end_overdue(self) -> None:
        """End runs that take too long, or whose worker never comes up."""
        now = time.monotonic()
        for result, item in self._under_way.items():
            if result.done():
                continue
            if not self._engine.has_begun(result):
                item.since_s = now
                if now - item.handed_s > self._engine.start_limit_s and not item.never_started:
                    item.never_started = True
                    self._engine.kill(result)
            if now - item.since_s > self._limit_s and not item.overdue:
                item.overdue = True
                self._disturbed = True
                self._engine.kill(result)

    def _look_for_workers(self) -> None:
        """Say soon that no worker is left, with what is done and what to do; raises `UsageError` in the end."""
        lonely_s = self._engine.time_without_worker_s()
        done = f"{len(self.outcomes)} of {self._planned} runs are done"
        if lonely_s > WAITS.lonely_s:
            raise UsageError(
                f"{self._engine.name} has had no worker for {WAITS.lonely_s:g} s; {done}",
                remedy="Start workers and repeat the command: complete runs are skipped.",
            )
        if lonely_s > WAITS.lonely_said_s and not self._said:
            for watch in self._watches:
                watch.noted(
                    f"{self._engine.name} has no worker left; {done}. Start workers, and the campaign goes on by "
                    f"itself; it ends after {WAITS.lonely_s:g} s without, and the same command then does the rest"
                )
        self._said = lonely_s > WAITS.lonely_said_s


def _failed_outcome(attempt: _Attempt, failure: RunFailure) -> RunOutcome:
    """The outcome of a run that failed."""
    return replace(fail_run(attempt.job, failure), attempts=attempt.number)


TIME_LIMIT_S = 3600.0


def run_campaign(
    plan: Plan,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    force: bool = False,
    time_limit_s: float = TIME_LIMIT_S,
    watches: Sequence[Follower] = (),
) -> CampaignSummary:
    """Replay every run of the plan whose result is not there already.

    Whatever is raised, what is complete stays, and the same call later does the rest. The tables are the same for any
    `jobs`, any `scheduler` and any order of runs.

    Args:
        plan: what to replay, as `make_plan` yields it.
        jobs: number of processes.
        scheduler: address of a Dask scheduler; None: this machine.
        force: replay runs whose result is there already, too.
        time_limit_s: longest time for one run [s].
        watches: what follows the progress.

    Returns:
        What became of each run.

    Raises:
        OutputError: results cannot be written.
        Interrupted: on SIGINT, SIGTERM and SIGHUP.
    """
    _refuse_unusable_plan(plan, scheduler)
    with hold_output(plan.out) as campaign:
        store.sweep(plan.out)
        known = [] if force else unchanged_outcomes(plan)
        left = with_previous(plan, {outcome.run_id for outcome in known}) if not force else plan
        store.write_config(plan.out, plan.config)
        store.write_vehicle(plan.out, plan.vehicle)
        for digest in sorted({job.config_digest for job in plan.jobs}):
            note_settings(plan.out, digest, plan.given_by_digest.get(digest, plan.given))
        engine = _engine_for(jobs, len(left.jobs), scheduler, time_limit_s)
        held = [replace(job, campaign=campaign) for job in left.jobs]
        loop = CampaignLoop(held, engine, time_limit_s, watches, known)
        try:
            summary = _run_watched(plan, loop, watches, at_once=engine.in_process)
        finally:
            engine.close()
            # Of a cluster's workers one that is still at its run writes it again.
            if loop.is_disturbed and not is_url(plan.out):
                store.sweep(plan.out)
            if left.jobs:
                keep_outcomes(plan, loop.outcomes)
        _write_tables(plan, loop, summary)
        return summary


def _engine_for(jobs: int, runs: int, scheduler: str | None, limit_s: float) -> Engine:
    """The engine that suits a number of runs and processes."""
    if scheduler is not None and runs:
        return DaskEngine(scheduler, limit_s)
    return SerialEngine(limit_s) if runs <= 1 and HAS_ALARM else LocalEngine(max(1, min(jobs, runs)))


def _refuse_unusable_plan(plan: Plan, scheduler: str | None) -> None:
    """Raise `UsageError` where a plan has no run, or its result lies where no worker of the cluster can write.

    Whether workers can write to any other place they find out themselves.
    """
    if not plan.jobs:
        raise UsageError("no run is given")
    if scheduler is not None and is_url(plan.out) and plan.out.startswith("memory://"):
        raise UsageError("workers cannot write into this process's memory", place=plan.out)


def _run_watched(plan: Plan, loop: CampaignLoop, watches: Sequence[Follower], at_once: bool) -> CampaignSummary:
    """Take the jobs of a plan through the loop, watched; all that became of them.

    `at_once`: the work is in this process, so that the loop's next look may be a whole run away.
    """
    begun = time.monotonic()
    for watch in watches:
        watch.begin(len(plan.jobs), plan.out)
    stopped: Interrupted | None = None
    with listen_for_signals(loop.stop_at_next_look, at_once):
        try:
            loop.run_to_end()
        except Interrupted as interrupted:
            stopped = interrupted
        finally:
            outcomes = sorted(loop.outcomes, key=lambda outcome: outcome.run_id)
            summary = CampaignSummary(len(plan.jobs), tuple(outcomes), time.monotonic() - begun)
            for watch in watches:
                watch.end(summary)
    if stopped is not None:
        raise Interrupted(stopped.signum, summary)
    return summary


def _write_tables(plan: Plan, loop: CampaignLoop, summary: CampaignSummary) -> None:
    """The tables over all runs; they too are given up when somebody asks to stop."""
    from pipeline.campaign.run import write_campaign  # statistics, which take long to load

    made = [outcome.run_id for outcome in summary.outcomes if not outcome.skipped]
    with listen_for_signals(loop.stop_at_next_look, at_once=True):
        try:
            write_campaign(plan.out, plan.config, made)
        except Interrupted as interrupted:
            raise Interrupted(interrupted.signum, summary) from None


_MADE_FROM = "made_from"


def write_campaign(out: Address, config: Configuration, made: Collection[str] = ()) -> None:
    """Derive the tables of `OUT/campaign/` from all complete runs, write the manifest; `made`: runs replayed now."""
    found = manifest.runs_found(out)
    key = campaign_key(config, found.digests)
    if not _is_current(out, key):
        for name, content in campaign_files(store.small_tables(out), config, key):
            storage.write_bytes(join(out, name), content)
    manifest.write_manifest(out, made, found)


def campaign_files(tables: Mapping[str, pl.DataFrame], config: Configuration, key: str) -> Iterator[tuple[str, bytes]]:
    """Name and content of each of these tables, from the small tables of all runs."""
    from pipeline.results.figures.campaign_figures import derived_tables  # statistics, which take long to load

    derived = derived_tables(tables["runs"], tables["hazards"], tables["passages"], tables["alarms"], config)
    made = {"software": SOFTWARE, "config_digest": digest_of(config), _MADE_FROM: key}
    for name, table in derived.items():
        schema = CAMPAIGN_TABLES[f"campaign_{name}"]
        yield f"campaign/{name}.parquet", table_bytes(table, f"campaign/{name}", schema, made)


def _is_current(out: Address, key: str) -> bool:
    """Whether all of these tables are there, made from these runs, and as the manifest has them."""
    names = [f"campaign/{name.removeprefix('campaign_')}.parquet" for name in CAMPAIGN_TABLES]
    contents = {name: storage.content_of(join(out, name)) for name in names}
    expected = manifest.earlier_manifest(out)["files"]
    return all(
        content is not None
        and metadata_of(content).get(_MADE_FROM) == key
        and expected.get(name, {}).get("sha256") == sha256(content)
        for name, content in contents.items()
    )


def campaign_key(config: Configuration, runs: list[tuple[str, str]]) -> str:
    """The digest of all that decides these tables: program, configuration and every marker, which names its tables."""
    return hashlib.sha256(repr((software_digest(), digest_of(config), runs)).encode()).hexdigest()
