"""Episodes: since when and until when a position was wrong, and when that was detected (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import polars as pl

from pipeline.stages.epochs.failure_log import FailureLog
from pipeline.stages.evidence.evidence import NOTHING
from pipeline.stages.judge.failures import Course, Failure, failure_at
from pipeline.stages.judge.judgement import WRONG, Judgements
from pipeline.stages.judge.jumps import Jump
from schemas.arrays import NS_PER_S, Bools, spans_of
from schemas.config import Configuration, HazardConfig

_ODOMETER = "odometer"


@dataclass(frozen=True)
class Detection:
    """First fail of a monitor in an episode; `standing`: the alarm was there before the fault was visible."""

    t_ns: int | None = None
    monitor: str | None = None
    standing: bool = False


@dataclass(frozen=True)
class Episode:
    """A fault from its onset until the position is right again; numbers are of `Course`, `end` is the first after it.

    `mark`: the first position that is wrong or completes a wrong offer; `step`, `jump_back`: the jumps at its ends;
    `failed`: begin of the position failure, possibly since `may_ns`; `failure`: the time wrong in use around it.
    """

    mark: int
    onset: int
    end: int
    begin_ns: int
    onset_ns: int
    end_ns: int
    step: Jump | None
    jump_back: Jump | None
    failed: int | None
    may_ns: int | None
    detection: Detection
    failure: Failure

    @property
    def undetected_ns(self) -> tuple[int, int]:
        """From the begin, that of a step included, to detection or to the end."""
        detected_ns = self.detection.t_ns
        return self.begin_ns, self.end_ns if detected_ns is None else detected_ns


def find_episodes(
    course: Course, failures: Sequence[Failure], log: FailureLog, faults: pl.DataFrame | None, config: Configuration
) -> list[Episode]:
    """One episode for each time that positions left the evidence, or offered a VB wrong."""
    episodes: list[Episode] = []
    floor = 0
    for mark in np.flatnonzero(course.judged.is_wrong | _offered_wrong(course)).tolist():
        if mark >= floor:
            episode = _episode(course, mark, floor, failures, log, faults, config)
            back = episode.jump_back
            episodes.append(episode)
            floor = max(episode.end, mark + 1, 0 if back is None else back.last + 1)
    return episodes


def _offered_wrong(course: Course) -> Bools:
    """Positions that complete an offer judged wrong; balises that a jump passes on its way belong to the jump."""
    marked = np.zeros(course.size, dtype=np.bool_)
    marked[course.offers.number[course.offers.offered & course.offers.judged.is_wrong]] = True
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
    config: Configuration,
) -> Episode:
    hazards = config.hazards
    after_quiet = course.after_quiet(floor, mark)
    step = next(iter(course.jumps_in(after_quiet, mark + 1)), None)
    onset = after_quiet if step is None else max(floor, step.first)
    jump_back, end = _end(course, mark, step, hazards)
    end_ns = int(course.t_ns[end]) if end < course.size else int(course.t_ns[-1]) + 1
    onset_ns, detection = _detected(course, onset, mark, end_ns, step, log, faults, hazards)
    failed = _failed(course, onset, end, step, hazards)
    in_use = (failure for failure in failures if failure.first < end and failure.last >= onset)
    return Episode(
        mark=mark,
        onset=onset,
        end=end,
        begin_ns=onset_ns if step is None else min(onset_ns, int(course.t_ns[step.first - 1]) + 1),
        onset_ns=onset_ns,
        end_ns=end_ns,
        step=step,
        jump_back=jump_back,
        failed=failed,
        may_ns=None if failed is None else _failed_may_ns(course, failed, hazards),
        detection=detection,
        failure=next(in_use, None) or failure_at(course, onset, end, np.zeros(0, dtype=np.int64), config),
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
    """The jump goes against the error before it, and the error after it is within the limit."""
    ends = judged.take(np.array([jump.first - 1, jump.last]))
    back = float(ends.middle_m[0]) * jump.step_m < 0.0
    return back and float(ends.least_m[1]) <= config.failure_limit_m and ends.code[1] != WRONG


def _detected(
    course: Course,
    onset: int,
    mark: int,
    end_ns: int,
    step: Jump | None,
    log: FailureLog,
    faults: pl.DataFrame | None,
    config: HazardConfig,
) -> tuple[int, Detection]:
    """Onset, as a `faults` stream names it, else the first epoch of the step or drift; and detection.

    A drift is visible late: an alarm up to `alarm_lead_s` before its onset becomes the onset, with T_D 0.
    """
    onset_ns = int(course.t_ns[onset])
    alarm_ns = None
    named_ns = named_onset_ns(faults, onset_ns, int(course.t_ns[mark]))
    if named_ns is None and step is None:
        alarm_ns = log.start_within(onset_ns - round(config.alarm_lead_s * NS_PER_S), onset_ns)
    begin_ns = next((t_ns for t_ns in (named_ns, alarm_ns) if t_ns is not None), onset_ns)
    detection = _detection(log, begin_ns, end_ns)
    return begin_ns, detection if alarm_ns is None else replace(detection, standing=True)


def named_onset_ns(faults: pl.DataFrame | None, onset_ns: int, mark_ns: int) -> int | None:
    """Begin of the fault that a `faults` stream names: the last one before the onset as seen, else the first after."""
    if faults is None:
        return None
    of_gnss = ~pl.col("target").str.contains(_ODOMETER)
    begin, end = (pl.col(name).dt.timestamp("ns") for name in ("t_start", "t_end"))
    lasts = of_gnss & (begin <= mark_ns) & (end.is_null() | (end >= onset_ns))
    begins = faults.filter(lasts).select(begin).to_series().sort().to_list()
    before = [t_ns for t_ns in begins if t_ns <= onset_ns]
    return before[-1] if before else next(iter(begins), None)


def _detection(log: FailureLog, onset_ns: int, end_ns: int) -> Detection:
    """First fail of any monitor in the episode; at once where an alarm was standing."""
    standing = log.standing_at(onset_ns)
    if standing is not None:
        return Detection(onset_ns, standing, standing=True)
    first = log.first_in(onset_ns, end_ns)
    return Detection() if first is None else Detection(*first)


def _failed(course: Course, onset: int, end: int, step: Jump | None, config: HazardConfig) -> int | None:
    """First position that stays wrong for `failure_hold_s`, a step at once; else the first wrong one of the episode."""
    spans = [(onset + first, onset + last) for first, last in spans_of(course.judged.is_wrong[onset:end])]
    hold_ns = round(config.failure_hold_s * NS_PER_S)
    for first, last in spans:
        at_once = step is not None and step.first <= first <= step.last
        if at_once or course.t_ns[last] - course.t_ns[first] >= hold_ns:
            return first
    return spans[0][0] if spans else None


def _failed_may_ns(course: Course, failed: int, config: HazardConfig) -> int | None:
    """When the failure may have begun: the first position not proved right whose interval reaches beyond the limit.

    Looked for since the last right position. None where the evidence is silent for some of that time.
    """
    right = np.flatnonzero(course.judged.is_right[:failed])
    run = np.arange(int(right[-1]) + 1 if right.size else 0, failed + 1)
    judged = course.judged.take(run)
    if (judged.kind == NOTHING).any():
        return None
    # Where no place along the track can be compared (NaN), any error may be.
    may = ~(judged.largest_m <= config.failure_limit_m) | judged.is_wrong
    return int(course.t_ns[run[may]][0])
