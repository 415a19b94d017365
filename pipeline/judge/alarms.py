"""Alarm episodes and whether they were right (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.epochs.failure_log import AlarmEpisode, FailureLog
from pipeline.judge.bench import Bench
from pipeline.judge.hazards import Draft
from pipeline.judge.suspect import suspect_of
from schemas.arrays import NS_PER_S, Bools, Floats
from schemas.conform import dtypes
from schemas.enums import Verdict
from schemas.tables import Alarms


def alarms_table(bench: Bench, log: FailureLog, healthy: dict[str, Bools], drafts: Sequence[Draft]) -> pl.DataFrame:
    """One row per alarm episode in order of time.

    `healthy`: per axis across the track, epochs whose error by the reference is within its noise.
    """
    rows = [
        {
            "solution": bench.solution.name,
            "alarm_id": number,
            "t_start": span.start_ns,
            "t_end": span.end_ns,
            "monitors": list(span.monitors),
            "peak_ratio": span.peak_ratio,
            "verdict": verdict_of(span, bench, healthy).value,
            "suspect": suspect_of(bench, span.start_ns, span.end_ns).value,
            "hazard_id": _hazard_of(span, drafts),
            "netelement_id": bench.epochs["netelement_id"][span.first],
            "measure_m": bench.epochs["measure_m"][span.first],
        }
        for number, span in enumerate(log.alarms)
    ]
    return pl.DataFrame(rows, schema=dtypes(Alarms))


def verdict_of(span: AlarmEpisode, bench: Bench, healthy: dict[str, Bools]) -> Verdict:
    """True where the whole interval was beyond the margin at some epoch, false where all of it stayed within.

    Only reference or balise reads can say false, and only of every position from 300 s before the alarm to its end; of
    an alarm across the track only a reference, for four metres aside are another track.
    """
    since_ns = span.start_ns - round(bench.config.hazards.false_alarm_lookback_s * NS_PER_S)
    rows = np.arange(int(np.searchsorted(bench.t_ns, since_ns)), span.last + 1)
    rows = rows[bench.positions.known[rows]]
    judged, margin = bench.judged, bench.margin_m[rows]
    can_say_false = judged.by_truth[rows]
    for axis, well in healthy.items():
        if any(monitor.startswith(axis) for monitor in span.monitors):
            can_say_false &= well[rows]
    if judged.wrong_track[rows].any():
        return Verdict.TRUE
    return verdict_within(judged.low_m[rows], judged.high_m[rows], margin, can_say_false)


def verdict_within(low_m: Floats, high_m: Floats, margin_m: Floats, can_say_false: Bools) -> Verdict:
    """By the intervals of the error (NaN: not known) at the positions of an alarm, against their margins."""
    with np.errstate(invalid="ignore"):
        beyond = (low_m > margin_m) | (high_m < -margin_m)
        within = can_say_false & (low_m >= -margin_m) & (high_m <= margin_m)
    if beyond.any():
        return Verdict.TRUE
    return Verdict.FALSE if within.size and within.all() else Verdict.UNKNOWN


def _hazard_of(span: AlarmEpisode, drafts: Sequence[Draft]) -> int | None:
    """The first hazard that lasted during the alarm, or that it detected."""
    for number, episode in enumerate(draft.episode for draft in drafts):
        lasted = span.start_ns <= episode.end_ns and span.end_ns >= episode.onset_ns
        detected = episode.detected_ns is not None and span.start_ns <= episode.detected_ns <= span.end_ns
        if lasted or detected:
            return number
    return None
