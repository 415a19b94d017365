"""Faults that hit no VB: errors beyond the limits, and true alarms, between the hazards.

They make no row of their own, but a VB accepted between their onset and their detection is as
suspect as one accepted in a hazard (DOMAIN section 4).
"""

from __future__ import annotations

import numpy as np

from pipeline.hazards.arrays import runs_of
from pipeline.hazards.case import Case
from pipeline.hazards.episodes import Calm, Draft
from pipeline.hazards.jumps import Jump
from pipeline.hazards.rows import Judged
from pipeline.hazards.series import Series
from pipeline.hazards.timing import Timing, time_hazard
from schemas.arrays import NS_PER_S
from schemas.enums import Hazard


def faulty_spans(case: Case, judged: list[Judged], jumps: list[Jump]) -> list[tuple[int, int]]:
    """When each fault was on without being detected [ns]: from onset to detection, or to its end.

    A step begins after the last epoch before it: the offers of its own movement are interpolated to before it.
    """
    series = case.series
    spans = [_span(item.timing, series) for item in judged]
    marks = _marks(case)
    if not marks:
        return spans
    calm = Calm.of(series, case.config.hazards.episode_end_s)
    covered = [(item.timing.onset_ns, item.timing.end_ns) for item in judged]
    for mark in marks:
        at_ns = int(series.t_ns[mark])
        if any(begin <= at_ns <= end for begin, end in covered):
            continue
        draft = Draft(Hazard.VB_SHIFT, calm.last_before(mark), end=calm.first_from(mark), mark=mark)
        timing = time_hazard(draft, jumps, case)
        covered.append((timing.onset_ns, timing.end_ns))
        spans.append(_span(timing, series))
    return spans


def _span(timing: Timing, series: Series) -> tuple[int, int]:
    begin = timing.onset_ns
    if timing.is_step and timing.onset_epoch > 0:
        begin = min(begin, int(series.t_ns[timing.onset_epoch - 1]) + 1)
    return begin, timing.end_ns if timing.detected_ns is None else timing.detected_ns


def _marks(case: Case) -> list[int]:
    """First epochs of errors beyond the failure limit, and of errors that make an alarm true."""
    series, config = case.series, case.config.hazards
    size = np.abs(series.error_m)
    beyond = (size > config.failure_limit_m) & (size > series.bound_m)
    marks = set(runs_of(beyond)[0].tolist())
    for alarm in case.fails.alarms:
        since_ns = alarm.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
        begin, end = np.searchsorted(series.t_ns, (since_ns, alarm.end_ns + 1))
        wrong = size[begin:end] > np.maximum(config.false_alarm_margin_m, series.quiet_m[begin:end])
        marks.update((begin + np.flatnonzero(wrong)[:1]).tolist())
    return sorted(marks)
