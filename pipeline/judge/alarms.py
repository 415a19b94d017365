"""Alarm episodes and whether they were right (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.failure_log import AlarmEpisode, FailureLog
from pipeline.evidence.evidence import KINDS
from pipeline.judge.judgement import Judgements
from pipeline.judge.suspect import Witnesses, suspect_of
from schemas.arrays import NS_PER_S, Bools, Floats
from schemas.config import HazardConfig
from schemas.conform import dtypes
from schemas.enums import Evidence, Verdict
from schemas.tables import Alarms


@dataclass(frozen=True)
class Fault:
    """When a fault lasted [ns], and the hazard row that it made, if any."""

    onset_ns: int
    end_ns: int
    detected_ns: int | None
    hazard_id: int | None


def margins_m(sigma_m: Floats, config: HazardConfig) -> Floats:
    """Errors of a healthy position: max(5 m, min(3 sigma, failure limit))."""
    noise = np.minimum(config.evidence_factor * np.nan_to_num(sigma_m, nan=np.inf), config.failure_limit_m)
    return np.maximum(config.false_alarm_margin_m, noise)


def alarms_table(
    solution: str,
    log: FailureLog,
    witnesses: Witnesses,
    positioned: Bools,
    places: pl.DataFrame,
    faults: Sequence[Fault],
    config: HazardConfig,
) -> pl.DataFrame:
    """One row per alarm episode in order of time; `places`: `netelement_id, measure_m` of the epochs."""
    rows = [
        {
            "solution": solution,
            "alarm_id": number,
            "t_start": span.start_ns,
            "t_end": span.end_ns,
            "monitors": list(span.monitors),
            "peak_ratio": span.peak_ratio,
            "verdict": verdict_of(span, witnesses, positioned, config).value,
            "suspect": suspect_of(witnesses, span.start_ns, span.end_ns).value,
            "hazard_id": _hazard_of(span, faults),
            "netelement_id": places["netelement_id"][span.first],
            "measure_m": places["measure_m"][span.first],
        }
        for number, span in enumerate(log.alarms)
    ]
    return pl.DataFrame(rows, schema=dtypes(Alarms))


def verdict_of(span: AlarmEpisode, w: Witnesses, positioned: Bools, config: HazardConfig) -> Verdict:
    """True where the whole interval was beyond the margin at some epoch, false where all of it stayed within.

    Only reference or balise reads can say false, and only of every position from 300 s before the alarm to its end.
    """
    since_ns = span.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    rows = np.arange(int(np.searchsorted(w.t_ns, since_ns)), span.last + 1)
    rows = rows[positioned[rows]]
    judged, margin = w.judged, w.margin_m[rows]
    with np.errstate(invalid="ignore"):
        beyond = (judged.least_m[rows] > margin) | judged.wrong_track[rows]
        within = _by_truth(judged)[rows] & (judged.largest_m[rows] <= margin)
    if beyond.any():
        return Verdict.TRUE
    return Verdict.FALSE if rows.size and within.all() else Verdict.UNKNOWN


def _by_truth(judged: Judgements) -> Bools:
    return np.isin(judged.kind, [KINDS.index(kind) for kind in (Evidence.REFERENCE, Evidence.BALISE)])


def _hazard_of(span: AlarmEpisode, faults: Sequence[Fault]) -> int | None:
    """The first hazard that lasted during the alarm, or that it detected."""
    for fault in faults:
        lasted = span.start_ns <= fault.end_ns and span.end_ns >= fault.onset_ns
        detected = fault.detected_ns is not None and span.start_ns <= fault.detected_ns <= span.end_ns
        if fault.hazard_id is not None and (lasted or detected):
            return fault.hazard_id
    return None
