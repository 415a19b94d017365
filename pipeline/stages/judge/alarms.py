"""Alarm episodes and whether they were right (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.stages.epochs.failure_log import AlarmEpisode, FailureLog
from pipeline.stages.judge.hazards import HazardRow
from pipeline.stages.judge.judgement import Judgements, margins_m
from pipeline.stages.judge.suspect import suspect_of
from schemas.arrays import NS_PER_S, Bools, Floats, floats, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.conform import dtypes
from schemas.enums import Verdict
from schemas.tables import Alarms


def alarms_table(
    name: str, epochs: pl.DataFrame, log: FailureLog, rows: Sequence[HazardRow], config: Configuration
) -> pl.DataFrame:
    """One row per alarm episode in order of time; `name`: of the solution; `epochs`: judged."""
    healthy = healthy_across(epochs, config.hazards)
    found = [
        {
            "solution": name,
            "alarm_id": number,
            "t_start": span.start_ns,
            "t_end": span.end_ns,
            "monitors": list(span.monitors),
            "peak_ratio": span.peak_ratio,
            "verdict": verdict_of(span, epochs, healthy, config.hazards).value,
            "suspect": suspect_of(epochs, span.start_ns, span.end_ns, config).value,
            "hazard_id": _hazard_of(span, rows),
            "netelement_id": epochs["netelement_id"][span.first],
            "measure_m": epochs["measure_m"][span.first],
        }
        for number, span in enumerate(log.alarms)
    ]
    return pl.DataFrame(found, schema=dtypes(Alarms))


def healthy_across(epochs: pl.DataFrame, config: HazardConfig) -> dict[str, Bools]:
    """Per axis of the monitors, epochs whose error by the reference is within the noise of both."""
    factor, healthy = config.evidence_factor, {}
    reference_m = np.nan_to_num(Judgements.of(epochs).half_m / factor)
    for axis in ("cross", "up"):
        noise_m = np.hypot(np.nan_to_num(floats(epochs, f"sigma_{axis}_m")), reference_m)
        with np.errstate(invalid="ignore"):
            healthy[f"{axis}_"] = np.abs(floats(epochs, f"error_{axis}_m")) <= factor * noise_m
    return healthy


def verdict_of(span: AlarmEpisode, epochs: pl.DataFrame, healthy: dict[str, Bools], config: HazardConfig) -> Verdict:
    """True where the whole interval was beyond the margin at some epoch, false where all of it stayed within.

    Only reference or balise reads can say false, and only of every position from 300 s before the alarm to its end; of
    an alarm across the track only a reference, for four metres aside are another track.
    """
    since_ns = span.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    first = int(np.searchsorted(times_ns(epochs), since_ns))
    part = epochs[first : span.last + 1]
    positioned = part["path_m"].is_not_null().to_numpy()
    judged = Judgements.of(part)
    can_say_false = judged.by_truth
    for axis, well in healthy.items():
        if any(monitor.startswith(axis) for monitor in span.monitors):
            can_say_false = can_say_false & well[first : span.last + 1]
    if (judged.wrong_track & positioned).any():
        return Verdict.TRUE
    margin_m = margins_m(floats(part, "sigma_along_m"), config)
    low_m, high_m = judged.low_m[positioned], judged.high_m[positioned]
    return verdict_within(low_m, high_m, margin_m[positioned], can_say_false[positioned])


def verdict_within(low_m: Floats, high_m: Floats, margin_m: Floats, can_say_false: Bools) -> Verdict:
    """By the intervals of the error (NaN: not known) at the positions of an alarm, against their margins."""
    with np.errstate(invalid="ignore"):
        beyond = (low_m > margin_m) | (high_m < -margin_m)
        within = can_say_false & (low_m >= -margin_m) & (high_m <= margin_m)
    if beyond.any():
        return Verdict.TRUE
    return Verdict.FALSE if within.size and within.all() else Verdict.UNKNOWN


def _hazard_of(span: AlarmEpisode, rows: Sequence[HazardRow]) -> int | None:
    """The first hazard that lasted during the alarm, or that it detected."""
    for number, episode in enumerate(row.episode for row in rows):
        lasted = span.start_ns <= episode.end_ns and span.end_ns >= episode.onset_ns
        detected = episode.detected_ns is not None and span.start_ns <= episode.detected_ns <= span.end_ns
        if lasted or detected:
            return number
    return None
