"""The campaign loop: hand out runs, collect outcomes, survive what happens to workers.

A run waits, is handed to the engine (where it may wait for a worker), is begun (from here on its time counts), and
ends: with an outcome; with an error of its own; without its worker, and then it waits again; or overdue, and the
campaign ends its worker. The campaign waits for futures alone: an engine ends each one that it gives, whatever happens.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from dataclasses import dataclass, replace

from pipeline.campaign.engines import Engine
from pipeline.campaign.interruption import ENDING, Interrupted
from pipeline.campaign.outcome import Result, RunFailure, failure_of, lost, never_begun, overdue
from pipeline.campaign.plan import RunJob
from pipeline.campaign.waits import WAITS
from pipeline.campaign.watch import Follower
from pipeline.campaign.worker import fail_run
from pipeline.results.outcome import RunOutcome
from schemas.errors import BaliseError, UsageError
from schemas.frozen import frozen


@frozen
class _Attempt:
    """One attempt at a run, and how often a worker was to begin it."""

    job: RunJob
    number: int = 1
    starts: int = 1


@dataclass
class _RunUnderWay:
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

    def stop(self, signum: int) -> None:
        """End at the next look, because of this signal."""
        self._stop = signum

    @property
    def disturbed(self) -> bool:
        """Whether a worker may have left something half written: lost, ended, or under way still."""
        return self._disturbed or bool(self._under_way)

    def run(self) -> None:
        """Go on until every run has its outcome. Raises `Interrupted` when asked to stop."""
        for outcome in self._known:
            self._note(outcome)
        while self._waiting or self._under_way:
            self._hand_out()
            done, _ = wait(self._under_way, timeout=WAITS.look_s, return_when=FIRST_COMPLETED)
            if self._stop is not None:
                raise Interrupted(self._stop)
            for result in done:
                self._note(self._collect(result))
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

    def _note(self, outcome: RunOutcome | None) -> None:
        """Keep the outcome of a run, and tell all watches."""
        if outcome is not None:
            self.outcomes.append(outcome)
            for watch in self._watches:
                watch.finished(outcome)

    def _collect(self, result: Result) -> RunOutcome | None:
        """The outcome, or none where the run is tried again."""
        item = self._under_way.pop(result)
        attempt = item.attempt
        try:
            error = CancelledError() if result.cancelled() else result.exception()
            if error is None:
                return replace(result.result(), attempts=attempt.number)
            if item.overdue:
                return _failed(attempt, RunFailure(overdue(self._limit_s), lasting=False))
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
            return _failed(attempt, failure_of(error, lasting=False))
        finally:
            self._engine.collected(result)

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
        return _failed(
            attempt, RunFailure(lost(attempt.number) if begun else never_begun(attempt.starts), lasting=False)
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
        lonely_s = self._engine.lonely_s()
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


def _failed(attempt: _Attempt, failure: RunFailure) -> RunOutcome:
    """The outcome of a run that failed."""
    return replace(fail_run(attempt.job, failure), attempts=attempt.number)
