"""Alarm episodes and whether they were right; which component is suspected (DOMAIN sections 5.3 and 5.5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.stages.epochs.failure_log import AlarmEpisode, FailureLog
from pipeline.stages.judge.episodes import Episode
from pipeline.stages.judge.judgement import ODOMETER, Judgements, margins_m
from schemas.arrays import NS_PER_S, Bools, Floats, floats, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.conform import dtypes, table_of_rows
from schemas.enums import Suspect, Verdict
from schemas.tables import ALL_MONITORS, Alarms

Healthy = dict[str | None, Bools]
"""Epochs whose error is within the noise, by axis of the monitors."""


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
    return table_of_rows(rows, dtypes(Alarms))


def healthy_across(epochs: pl.DataFrame, config: HazardConfig) -> Healthy:
    """Per axis across the track, epochs whose error by the reference is within the noise of both."""
    reference_m = np.nan_to_num(Judgements.of(epochs).half_m / config.evidence_factor)
    noise_m = {
        axis: config.evidence_factor * np.hypot(np.nan_to_num(floats(epochs, f"sigma_{axis}_m")), reference_m)
        for axis in ("cross", "up")
    }
    return {axis: np.abs(floats(epochs, f"error_{axis}_m")) <= limit_m for axis, limit_m in noise_m.items()}


def verdict_of(alarm: AlarmEpisode, epochs: pl.DataFrame, healthy: Healthy, config: HazardConfig) -> Verdict:
    """True where the whole interval was beyond the margin at some epoch, false where all of it stayed within.

    Only reference or balise reads can say false, and only of every position from 300 s before the alarm to its end; of
    an alarm across the track only a reference, for four metres aside are another track.
    """
    since_ns = alarm.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    first = int(np.searchsorted(times_ns(epochs), since_ns))
    part = epochs[first : alarm.last + 1]
    can_say_false = Judgements.of(part).by_truth
    for axis in {monitor.axis for monitor in ALL_MONITORS if monitor.name in alarm.monitors} & healthy.keys():
        can_say_false = can_say_false & healthy[axis][first : alarm.last + 1]
    positioned = part["path_m"].is_not_null().to_numpy()
    judged = Judgements.of(part.filter(positioned))
    if judged.wrong_track.any():
        return Verdict.TRUE
    margin_m = margins_m(floats(part, "sigma_along_m"), config)[positioned]
    return verdict_within(judged.low_m, judged.high_m, margin_m, can_say_false[positioned])


def verdict_within(low_m: Floats, high_m: Floats, margin_m: Floats, can_say_false: Bools) -> Verdict:
    """By the intervals of the error (NaN: not known) at the positions of an alarm, against their margins."""
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


def suspect_of(epochs: pl.DataFrame, begin_ns: int, end_ns: int, config: Configuration) -> Suspect:
    """An opinion, on which only its column depends; from `suspect_lookback_s` before an alarm or hazard to its end.

    The first row that applies; the map is found over several runs (`pipeline/results/figures/map_errors.py`).

    | row | evidence | suspect |
    |---|---|---|
    | 1 | the position left what reference or reads leave | gnss |
    | 2 | the odometer is contradicted, or position and Doppler part from it together | odometer |
    | 3 | the position left the odometer since a VB | gnss |
    | 4 | the match was ambiguous | track |
    | 5 | else | unknown |
    """
    t_ns = times_ns(epochs)
    first = int(np.searchsorted(t_ns, begin_ns - round(config.hazards.suspect_lookback_s * NS_PER_S)))
    part = epochs[first : max(first, int(np.searchsorted(t_ns, end_ns, side="right")))]
    judged = Judgements.of(part)
    margin_m = margins_m(floats(part, "sigma_along_m"), config.hazards)
    left = (judged.least_m > margin_m) | judged.wrong_track
    if (left & (judged.kind != ODOMETER)).any():
        return Suspect.GNSS
    if (part["stood"] | part["odometer_wrong"]).any() or _parted_together(part, margin_m, config):
        return Suspect.ODOMETER
    if left.any():
        return Suspect.GNSS
    ambiguous = part["path_m"].is_not_null() & ~part["unambiguous"]
    return Suspect.TRACK if ambiguous.any() else Suspect.UNKNOWN


def _parted_together(part: pl.DataFrame, margin_m: Floats, config: Configuration) -> bool:
    """Position and Doppler agree with each other where both left the odometer, by half the margin of the position."""
    columns = part.select("path_m", "odometer_m", "velocity_along_mps").cast(pl.Float64).to_numpy()
    known = np.isfinite(columns).all(axis=1)
    if known.sum() < 2:
        return False
    path_m, odometer_m, velocity_mps = columns[known].T
    dt_s = np.diff(times_ns(part)[known]) / NS_PER_S
    mean_mps = 0.5 * (velocity_mps[1:] + velocity_mps[:-1])
    near = dt_s <= config.monitors.doppler_gap_s
    doppler_m = np.concatenate([[0.0], np.cumsum(np.where(near, mean_mps * dt_s, 0.0))])
    position_m = path_m - path_m[0]
    counted_m = odometer_m - odometer_m[0]
    limit_m = 0.5 * margin_m[known]
    both = (np.abs(position_m - counted_m) > limit_m) & (np.abs(doppler_m - counted_m) > limit_m)
    return bool((both & (np.abs(position_m - doppler_m) <= limit_m)).any())
