"""Alarm episodes and whether they were right (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.stages.epochs.failure_log import AlarmEpisode, FailureLog
from pipeline.stages.judge.attribution import suspect_of
from pipeline.stages.judge.episodes import Episode
from pipeline.stages.judge.judgement import Judgements, margins_m
from schemas.arrays import NS_PER_S, Bools, Floats, floats, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.conform import dtypes
from schemas.enums import Verdict
from schemas.tables import Alarms


def alarms_table(
    name: str, epochs: pl.DataFrame, log: FailureLog, hazards: Sequence[Episode], config: Configuration
) -> pl.DataFrame:
    """One row per alarm episode; `name`: of the solution, `epochs`: judged, `hazards`: the episode of each row."""
    healthy = healthy_across(epochs, config.hazards)
    rows = [
        {
            "solution": name,
            "alarm_id": number,
            "t_start": alarm.start_ns,
            "t_end": alarm.end_ns,
            "monitors": list(alarm.monitors),
            "peak_ratio": alarm.peak_ratio,
            "verdict": verdict_of(alarm, epochs, healthy, config.hazards).value,
            "suspect": suspect_of(epochs, alarm.start_ns, alarm.end_ns, config).value,
            "hazard_id": next((number for number, episode in enumerate(hazards) if _belongs(alarm, episode)), None),
            "netelement_id": epochs["netelement_id"][alarm.first],
            "measure_m": epochs["measure_m"][alarm.first],
        }
        for number, alarm in enumerate(log.alarms)
    ]
    return pl.DataFrame(rows, schema=dtypes(Alarms))


def healthy_across(epochs: pl.DataFrame, config: HazardConfig) -> dict[str, Bools]:
    """Per axis of the monitors, epochs whose error by the reference is within the noise of both."""
    factor = config.evidence_factor
    healthy = {}
    reference_m = np.nan_to_num(Judgements.of(epochs).half_m / factor)
    for axis in ("cross", "up"):
        noise_m = np.hypot(np.nan_to_num(floats(epochs, f"sigma_{axis}_m")), reference_m)
        with np.errstate(invalid="ignore"):
            healthy[f"{axis}_"] = np.abs(floats(epochs, f"error_{axis}_m")) <= factor * noise_m
    return healthy


def verdict_of(alarm: AlarmEpisode, epochs: pl.DataFrame, healthy: dict[str, Bools], config: HazardConfig) -> Verdict:
    """True where the whole interval was beyond the margin at some epoch, false where all of it stayed within.

    Only reference or balise reads can say false, and only of every position from 300 s before the alarm to its end; of
    an alarm across the track only a reference, for four metres aside are another track.
    """
    since_ns = alarm.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    rows = np.arange(int(np.searchsorted(times_ns(epochs), since_ns)), alarm.last + 1)
    part = epochs[rows]
    positioned = part["path_m"].is_not_null().to_numpy()
    judged = Judgements.of(part)
    can_say_false = judged.by_truth
    for axis, within in healthy.items():
        if any(monitor.startswith(axis) for monitor in alarm.monitors):
            can_say_false = can_say_false & within[rows]
    if (judged.wrong_track & positioned).any():
        return Verdict.TRUE
    margin_m = margins_m(floats(part, "sigma_along_m"), config)
    low_m = judged.low_m[positioned]
    high_m = judged.high_m[positioned]
    return verdict_within(low_m, high_m, margin_m[positioned], can_say_false[positioned])


def verdict_within(low_m: Floats, high_m: Floats, margin_m: Floats, can_say_false: Bools) -> Verdict:
    """By the intervals of the error (NaN: not known) at the positions of an alarm, against their margins."""
    with np.errstate(invalid="ignore"):
        beyond = (low_m > margin_m) | (high_m < -margin_m)
        within = can_say_false & (low_m >= -margin_m) & (high_m <= margin_m)
    if beyond.any():
        return Verdict.TRUE
    return Verdict.FALSE if within.size and within.all() else Verdict.UNKNOWN


def _belongs(alarm: AlarmEpisode, episode: Episode) -> bool:
    """The fault lasted during the alarm, or the alarm detected it."""
    lasted = alarm.start_ns <= episode.end_ns and alarm.end_ns >= episode.onset_ns
    detected_ns = episode.detection.t_ns
    return lasted or (detected_ns is not None and alarm.start_ns <= detected_ns <= alarm.end_ns)
