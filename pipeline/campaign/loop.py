"""The campaign loop: hand out runs, collect outcomes, survive what happens to workers."""

from __future__ import annotations

import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Protocol

from pipeline.campaign.engines import Engine, engine_for
from pipeline.campaign.finish import write_campaign
from pipeline.campaign.lock import locked
from pipeline.campaign.outcome import Result, RunOutcome, lost, never_begun, overdue
from pipeline.campaign.plan import Plan, RunJob, held_by, with_previous
from pipeline.campaign.worker import fail_run
from pipeline.results import store
from pipeline.storage.files import is_url
from schemas.enums import RunStatus
from schemas.errors import UsageError

_LOOK_S = 0.2
_STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_ATTEMPTS = 2
_STARTS = 10
TIME_LIMIT_S = 3600.0


class Interrupted(BaseException):
    """The user or the system asked to stop; `summary` tells what is complete."""

    def __init__(self, signum: int, summary: Summary | None = None) -> None:
        super().__init__(signal.Signals(signum).name)
        self.signum = signum
        self.summary = summary


@dataclass(frozen=True)
class Summary:
    """A campaign in figures."""

    planned: int
    outcomes: tuple[RunOutcome, ...]
    seconds: float

    def count(self, status: RunStatus) -> int:
        return sum(outcome.status == status for outcome in self.outcomes)

    @property
    def skipped(self) -> int:
        return sum(outcome.skipped for outcome in self.outcomes)

    @property
    def defects(self) -> int:
        return sum(outcome.defect for outcome in self.outcomes)

    @property
    def left(self) -> int:
        """Runs that were not reached."""
        return self.planned - len(self.outcomes)


class Watch(Protocol):
    """Whoever wants to see a campaign go on."""

    def begin(self, plan: Plan) -> None: ...

    def look(self, under_way: Sequence[tuple[str, float]]) -> None:
        """Called several times a second with the runs under way and their age [s]."""

    def lost(self, run_id: str, attempt: int) -> None:
        """The worker died that was at this attempt of a run; it is tried again."""

    def finished(self, outcome: RunOutcome) -> None: ...

    def end(self, summary: Summary) -> None: ...


@dataclass(frozen=True)
class _Attempt:
    """One attempt at a run, and how often a worker was to begin it."""

    job: RunJob
    number: int = 1
    starts: int = 1


@dataclass
class _UnderWay:
    attempt: _Attempt
    since_s: float
    overdue: bool = False


@dataclass
class _State:
    """What the loop keeps between two looks."""

    waiting: deque[_Attempt]
    under_way: dict[Result, _UnderWay] = field(default_factory=dict)
    outcomes: list[RunOutcome] = field(default_factory=list)
    stop: int | None = None


def run_campaign(
    plan: Plan,
    *,
    jobs: int = 1,
    scheduler: str | None = None,
    force: bool = False,
    time_limit_s: float = TIME_LIMIT_S,
    watches: Sequence[Watch] = (),
) -> Summary:
    """Replay every run of the plan whose result is not there already.

    Raises `OutputError` where results cannot be written, `Interrupted` on SIGINT, SIGTERM and SIGHUP; either way
    what is complete stays, and the same call later does the rest. The tables are the same for any `jobs`,
    any `scheduler` and any order of runs.
    """
    _check_shared(plan, scheduler)
    with locked(plan.out) as campaign:
        store.sweep(plan.out)
        plan = held_by(plan if force else with_previous(plan), campaign)
        store.write_config(plan.out, plan.config)
        state = _State(deque(map(_Attempt, plan.jobs)))
        engine = engine_for(jobs, len(plan.jobs), scheduler, time_limit_s)
        try:
            summary = _watched(plan, state, engine, time_limit_s, watches)
        finally:
            engine.close()
            _tidy(plan, state, scheduler)
        _finish(plan, state, summary)
        return summary


def _finish(plan: Plan, state: _State, summary: Summary) -> None:
    """The tables over all runs; they too are given up when somebody asks to stop."""
    with _listening(state, at_once=True):
        try:
            write_campaign(plan.out, plan.config)
        except Interrupted as interrupted:
            raise Interrupted(interrupted.signum, summary) from None


def _check_shared(plan: Plan, scheduler: str | None) -> None:
    """Whether a cluster can write there is found out by its workers; that nothing is to do, here."""
    if not plan.jobs:
        raise UsageError("no run is named")
    if scheduler is not None and is_url(plan.out) and plan.out.startswith("memory://"):
        raise UsageError("workers cannot write into this process's memory", place=plan.out)


def _tidy(plan: Plan, state: _State, scheduler: str | None) -> None:
    """Remove what ended workers left half done; those of a cluster may be at it still."""
    if scheduler is None and not is_url(plan.out):
        for item in state.under_way.values():
            store.sweep_run(Path(plan.out), item.attempt.job.run_id)


def _watched(plan: Plan, state: _State, engine: Engine, limit_s: float, watches: Sequence[Watch]) -> Summary:
    begun = time.monotonic()
    for watch in watches:
        watch.begin(plan)
    stopped: Interrupted | None = None
    with _listening(state, at_once=engine.in_process):
        try:
            _loop(state, engine, limit_s, watches)
        except Interrupted as interrupted:
            stopped = interrupted
        finally:
            summary = Summary(len(plan.jobs), tuple(_in_order(state.outcomes)), time.monotonic() - begun)
            for watch in watches:
                watch.end(summary)
    if stopped is not None:
        raise Interrupted(stopped.signum, summary)
    return summary


def _in_order(outcomes: list[RunOutcome]) -> list[RunOutcome]:
    return sorted(outcomes, key=lambda outcome: outcome.run_id)


def _loop(state: _State, engine: Engine, limit_s: float, watches: Sequence[Watch]) -> None:
    while state.waiting or state.under_way:
        _hand_out(state, engine)
        done, _ = wait(state.under_way, timeout=_LOOK_S, return_when=FIRST_COMPLETED)
        if state.stop is not None:
            raise Interrupted(state.stop)
        for result in done:
            outcome = _collect(state, engine, result, limit_s, watches)
            if outcome is not None:
                state.outcomes.append(outcome)
                for watch in watches:
                    watch.finished(outcome)
        _end_overdue(state, engine, limit_s)
        now = time.monotonic()
        ages = [(item.attempt.job.run_id, now - item.since_s) for item in state.under_way.values()]
        for watch in watches:
            watch.look(ages)


def _hand_out(state: _State, engine: Engine) -> None:
    capacity = engine.capacity()
    while state.waiting and len(state.under_way) < capacity and state.stop is None:
        attempt = state.waiting.popleft()
        state.under_way[engine.submit(attempt.job)] = _UnderWay(attempt, time.monotonic())


def _collect(
    state: _State, engine: Engine, result: Result, limit_s: float, watches: Sequence[Watch]
) -> RunOutcome | None:
    """The outcome, or none where the run is tried again."""
    item = state.under_way.pop(result)
    attempt = item.attempt
    try:
        error = CancelledError() if result.cancelled() else result.exception()
        if error is None:
            return replace(result.result(), attempts=attempt.number)
        if item.overdue:
            return replace(fail_run(attempt.job, overdue(limit_s)), attempts=attempt.number)
        if isinstance(error, CancelledError):
            raise UsageError(
                "the cluster dropped the campaign", remedy="Repeat the command: complete runs are skipped."
            )
        if not engine.is_lost_worker(error):
            raise error
        return _after_loss(state, attempt, engine.has_begun(result), watches)
    finally:
        engine.collected(result)


def _after_loss(state: _State, attempt: _Attempt, begun: bool, watches: Sequence[Watch]) -> RunOutcome | None:
    """A run that was under way when its worker died has one more attempt; one that waited there has lost nothing."""
    if not begun and attempt.starts < _STARTS:
        state.waiting.appendleft(replace(attempt, starts=attempt.starts + 1))
        return None
    if begun and attempt.number < _ATTEMPTS:
        for watch in watches:
            watch.lost(attempt.job.run_id, attempt.number)
        state.waiting.appendleft(_Attempt(attempt.job, attempt.number + 1))
        return None
    reason = lost(attempt.number) if begun else never_begun(attempt.starts)
    return replace(fail_run(attempt.job, reason), attempts=attempt.number)


def _end_overdue(state: _State, engine: Engine, limit_s: float) -> None:
    now = time.monotonic()
    for result, item in state.under_way.items():
        if not engine.has_begun(result):
            item.since_s = now
        if now - item.since_s > limit_s and not item.overdue:
            item.overdue = True
            engine.kill(result)


@contextmanager
def _listening(state: _State, at_once: bool) -> Iterator[None]:
    """Answer SIGINT, SIGTERM and SIGHUP: at the loop's next look, or at once where the work is in this process.

    What the caller ignores (`nohup`) is ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def answer(signum: int, frame: FrameType | None) -> None:
        state.stop = signum
        if at_once:
            raise Interrupted(signum)

    signals = [signum for signum in _STOPPING if signal.getsignal(signum) is not signal.SIG_IGN]
    before = {signum: signal.signal(signum, answer) for signum in signals}
    try:
        yield
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
