"""Episodes: since when and until when a position was wrong, and when that was seen (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.epochs.failure_log import FailureLog
from pipeline.stages.evidence.evidence import NOTHING
from pipeline.stages.judge.failures import Course, Failure, numbers_of
from pipeline.stages.judge.judgement import WRONG, Judgements
from pipeline.stages.judge.jumps import Jump
from schemas.arrays import NS_PER_S, Bools, flags, spans_of
from schemas.config import HazardConfig

_ODOMETER = "odometer"


@dataclass(frozen=True)
class Episode:
    """A fault from its onset until the position is right again; numbers are of `Course`, `end` is the first after it.

    `step`: the jump that began it; `jump_back`: the one that ended it. `t_failure_ns`: begin of the position failure;
    `t_failure_may_ns`: since when it may have been one. `failure`: the time wrong in use that the episode belongs to.
    """

    mark: int
    onset: int
    end: int
    onset_ns: int
    end_ns: int
    step: Jump | None
    jump_back: Jump | None
    begin_ns: int
    failure_number: int | None
    t_failure_ns: int | None
    t_failure_may_ns: int | None
    detected_ns: int | None
    monitor: str | None
    alarm_before_onset: bool
    failure: Failure | None

    @property
    def undetected_ns(self) -> tuple[int, int]:
        """From the begin to detection, or to the end; what a step offers on its way lies before its first position."""
        return self.begin_ns, self.end_ns if self.detected_ns is None else self.detected_ns


def find_episodes(
    course: Course,
    offers: pl.DataFrame,
    failures: Sequence[Failure],
    log: FailureLog,
    faults: pl.DataFrame | None,
    config: HazardConfig,
) -> list[Episode]:
    """One episode for each time that positions left the evidence, or offered a VB wrong."""
    marks = np.flatnonzero(course.judged.is_wrong | _offered_wrong(course, offers))
    episodes: list[Episode] = []
    until = 0
    for mark in marks.tolist():
        if mark < until:
            continue
        episode = _episode(course, mark, until, failures, log, faults, config)
        episodes.append(episode)
        until = max(episode.end, mark + 1, 0 if episode.jump_back is None else episode.jump_back.last + 1)
    return episodes


def _offered_wrong(course: Course, offers: pl.DataFrame) -> Bools:
    """Positions that complete an offer judged wrong; what a jump offers on its way is the jump's."""
    marked = np.zeros(course.size, dtype=np.bool_)
    wrong = flags(offers, "offered") & Judgements.of(offers).is_wrong
    marked[numbers_of(offers, course.positions)[wrong]] = True
    for jump in course.jumps:
        marked[jump.first : jump.last + 1] = False
    return marked


def _episode(
    course: Course,
    mark: int,
    floor: int,
    failures: Sequence[Failure],
    log: FailureLog,
    faults: pl.DataFrame | None,
    config: HazardConfig,
) -> Episode:
    after_quiet = course.after_quiet(floor, mark)
    step = next(iter(course.jumps_in(after_quiet, mark + 1)), None)
    onset = max(floor, step.first) if step is not None else after_quiet
    jump_back, end = _end(course, mark, step, config)
    onset_ns = _onset_ns(course, onset, mark, step, log, faults, config)
    end_ns = int(course.t_ns[end]) if end < course.size else int(course.t_ns[-1]) + 1
    detected_ns, monitor, before = _detection(log, onset_ns, end_ns)
    failed = _failure(course, onset, end, step, config)
    own = (failure for failure in failures if failure.meets(onset, end))
    return Episode(
        mark=mark,
        onset=onset,
        end=end,
        onset_ns=onset_ns,
        end_ns=end_ns,
        step=step,
        jump_back=jump_back,
        begin_ns=onset_ns if step is None else min(onset_ns, int(course.t_ns[step.first - 1]) + 1),
        failure_number=failed,
        t_failure_ns=None if failed is None else int(course.t_ns[failed]),
        t_failure_may_ns=None if failed is None else _failure_may_ns(course, failed, config),
        detected_ns=detected_ns,
        monitor=monitor,
        alarm_before_onset=before,
        failure=next(own, None),
    )


def _end(course: Course, mark: int, step: Jump | None, config: HazardConfig) -> tuple[Jump | None, int]:
    """The jump back that ends the episode, and the first position after it."""
    calm = int(course.calm_from[mark])
    for jump in course.jumps_in(mark + 1, calm + 1):
        after_step = jump.first > mark and (step is None or jump.first > step.last)
        if after_step and _is_back(course.judged, jump, config):
            return jump, jump.first
    return None, calm


def _is_back(judged: Judgements, jump: Jump, config: HazardConfig) -> bool:
    """Against the error before it, and no longer beyond the limit after it."""
    ends = judged.take(np.array([jump.first - 1, jump.last]))
    back = float(ends.middle_m[0]) * jump.step_m < 0.0
    return back and float(ends.least_m[1]) <= config.failure_limit_m and ends.code[1] != WRONG


def _onset_ns(
    course: Course,
    onset: int,
    mark: int,
    step: Jump | None,
    log: FailureLog,
    faults: pl.DataFrame | None,
    config: HazardConfig,
) -> int:
    """As a `faults` stream names it; else the first epoch of the step or drift, or an alarm up to 30 s before."""
    onset_ns, mark_ns = int(course.t_ns[onset]), int(course.t_ns[mark])
    named = _named_onset_ns(faults, onset_ns, mark_ns)
    if named is not None:
        return named
    if step is None:
        began = log.start_within(onset_ns - round(config.alarm_lead_s * NS_PER_S), onset_ns)
        return onset_ns if began is None else began
    return onset_ns


def _named_onset_ns(faults: pl.DataFrame | None, onset_ns: int, mark_ns: int) -> int | None:
    """Begin of the fault that a `faults` stream names: the last one before the onset as seen, else the first after."""
    if faults is None:
        return None
    of_gnss = ~pl.col("target").str.contains(_ODOMETER)
    begin, end = (pl.col(name).dt.timestamp("ns") for name in ("t_start", "t_end"))
    lasts = of_gnss & (begin <= mark_ns) & (end.is_null() | (end >= onset_ns))
    begins = faults.filter(lasts).select(begin).to_series().sort().to_list()
    before = [t_ns for t_ns in begins if t_ns <= onset_ns]
    return before[-1] if before else next(iter(begins), None)


def _detection(log: FailureLog, onset_ns: int, end_ns: int) -> tuple[int | None, str | None, bool]:
    """First fail of any monitor in the episode; at once where an alarm was standing."""
    standing = log.standing_at(onset_ns)
    if standing is not None:
        return onset_ns, standing, True
    found = log.first_in(onset_ns, end_ns)
    return (None, None, False) if found is None else (*found, False)


def _failure(course: Course, onset: int, end: int, step: Jump | None, config: HazardConfig) -> int | None:
    """First position of a second of `wrong`; a step counts at once; else the first wrong one of the episode."""
    spans = spans_of(course.judged.is_wrong[onset:end])
    hold_ns = round(config.failure_hold_s * NS_PER_S)
    for first, last in spans:
        begin, until = onset + first, onset + last
        at_once = step is not None and step.first <= begin <= step.last
        if at_once or course.t_ns[until] - course.t_ns[begin] >= hold_ns:
            return begin
    return onset + spans[0][0] if spans else None


def _failure_may_ns(course: Course, failed: int, config: HazardConfig) -> int | None:
    """First of the unbroken run of unknown or wrong positions before a failure at which it may have been one.

    That is where the interval reaches beyond the limit. None where the evidence is silent in that run: a failure may
    have begun at any time of it.
    """
    right = np.flatnonzero(course.judged.is_right[:failed])
    run = slice(int(right[-1]) + 1 if right.size else 0, failed + 1)
    if (course.judged.kind[run] == NOTHING).any():
        return None
    # Where no place along the track can be compared, any error may be.
    may = np.flatnonzero(~(course.judged.largest_m[run] <= config.failure_limit_m) | course.judged.is_wrong[run])
    return int(course.t_ns[run][may[0]])
