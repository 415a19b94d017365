"""Episodes of a wrong position, with onset and detection; verdict and suspect of each alarm (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from pipeline.stages.epochs.verdicts import AlarmEpisode, FailureLog
from pipeline.stages.evidence.evidence import NOTHING
from pipeline.stages.judge.failures import ErrorHistory, Failure, Jump, failure_between
from pipeline.stages.judge.judged import ODOMETER, WRONG, JudgedEpochs
from pipeline.stages.judge.judgement import healthy_margins_m
from schemas.arrays import NS_PER_S, Bools, Floats, spans_of
from schemas.config import Configuration, HazardConfig
from schemas.conform import table_of_rows
from schemas.enums import Suspect, Verdict
from schemas.frozen import frozen
from schemas.monitors import ALL_MONITORS
from schemas.stages import MatchedEpochs
from schemas.tables import Alarms

_ODOMETER = "odometer"


@frozen
class Detection:
    """First fail of a monitor in an episode; `standing`: the alarm was there before the fault was visible."""

    t_ns: int | None = None
    monitor: str | None = None
    standing: bool = False


@frozen
class Extent:
    """Positions of an episode, numbered as in `ErrorHistory`, from the onset on; `end` is the first after it.

    `mark`: the first that is wrong or completes a wrong offer; `step`, `jump_back`: the jumps at its ends.
    """

    mark: int
    onset: int
    end: int
    step: Jump | None
    jump_back: Jump | None


@frozen
class Episode(Extent):
    """A fault from its onset until the position is right again; `begin_ns`: that of a step included.

    `failed`: begin of the position failure, possibly since `may_ns`; `failure`: the time wrong in use around it.
    """

    begin_ns: int
    onset_ns: int
    end_ns: int
    failed: int | None
    may_ns: int | None
    detection: Detection
    failure: Failure

    @property
    def undetected_span_ns(self) -> tuple[int, int]:
        """Begin and end [ns] of the time in which the fault was there unnoticed: up to its detection, or to its end."""
        return self.begin_ns, self.end_ns if self.detection.t_ns is None else self.detection.t_ns


def find_episodes(
    history: ErrorHistory, failures: Sequence[Failure], log: FailureLog, faults: pl.DataFrame | None
) -> list[Episode]:
    """One episode for each time that positions left the evidence, or offered a VB wrong.

    Args:
        history: the positions, judged, with their jumps and offers.
        failures: of the same positions.
        log: which monitor failed when.
        faults: those injected (`t_start`, `t_end`, `target`), which name an onset better than positions can; or None.

    Returns:
        Episodes in order of time; none overlap.

    Source:
        DOMAIN section 5.3.
    """
    episodes: list[Episode] = []
    floor = 0
    for mark in np.flatnonzero(history.judged.is_wrong | _complete_wrong_offer(history)).tolist():
        if mark >= floor:
            extent = _extent_about(history, mark, floor)
            episodes.append(_episode_of(history, extent, failures, log, faults))
            floor = max(extent.end, mark + 1, 0 if extent.jump_back is None else extent.jump_back.last + 1)
    return episodes


def _complete_wrong_offer(history: ErrorHistory) -> Bools:
    """Positions that complete an offer judged wrong, without those inside a jump, which stands for them."""
    marked = np.zeros(history.size, dtype=np.bool_)
    marked[history.completing[history.offers.offered & history.offers.judged.is_wrong]] = True
    for jump in history.jumps:
        marked[jump.first : jump.last + 1] = False
    return marked


def _extent_about(history: ErrorHistory, mark: int, floor: int) -> Extent:
    """The extent of the fault that position `mark` belongs to, not before position `floor`."""
    onset = history.after_noise(floor, mark)
    step = next(iter(history.jumps_in(onset, mark + 1)), None)
    settled = int(history.settled_from[mark])
    after_step = mark if step is None else max(mark, step.last)
    later = history.jumps_in(mark + 1, settled + 1)
    back = next((jump for jump in later if jump.first > after_step and _leads_back(history, jump)), None)
    return Extent(
        mark=mark,
        onset=onset if step is None else max(floor, step.first),
        end=settled if back is None else back.first,
        step=step,
        jump_back=back,
    )


def _leads_back(history: ErrorHistory, jump: Jump) -> bool:
    """Whether a jump goes against the error before it and leaves an error within the failure limit."""
    judged = history.judged
    back = float(judged.middle_m[jump.first - 1]) * jump.step_m < 0.0
    within = float(judged.least_m[jump.last]) <= float(judged.limit_m[jump.last])
    return back and within and judged.code[jump.last] != WRONG


def _episode_of(
    history: ErrorHistory, extent: Extent, failures: Sequence[Failure], log: FailureLog, faults: pl.DataFrame | None
) -> Episode:
    """The episode of an extent, with its instants, its detection and the failure that it overlaps."""
    step = extent.step
    end_ns = int(history.t_ns[extent.end]) if extent.end < history.size else int(history.t_ns[-1]) + 1
    onset_ns, detection = _onset_and_detection(history, extent, end_ns, log, faults)
    failed = _failure_begin(history, extent)
    in_use = (failure for failure in failures if failure.first < extent.end and failure.last >= extent.onset)
    no_use = np.zeros(0, dtype=np.int64)
    return Episode(
        **vars(extent),
        begin_ns=onset_ns if step is None else min(onset_ns, int(history.t_ns[step.first - 1]) + 1),
        onset_ns=onset_ns,
        end_ns=end_ns,
        failed=failed,
        may_ns=None if failed is None else _earliest_failure_ns(history, failed),
        detection=detection,
        failure=next(in_use, None) or failure_between(history, extent.onset, extent.end, no_use),
    )


def _onset_and_detection(
    history: ErrorHistory, extent: Extent, end_ns: int, log: FailureLog, faults: pl.DataFrame | None
) -> tuple[int, Detection]:
    """Onset [ns] (from the `faults` stream, else the first epoch of the step or drift), and the first detection.

    A drift is visible late: an alarm up to `alarm_lead_s` before its onset becomes the onset, with T_D 0. Detection is
    the first fail of any monitor from the onset on; at once where an alarm was standing.
    """
    onset_ns = int(history.t_ns[extent.onset])
    named_ns = injected_onset_ns(faults, onset_ns, int(history.t_ns[extent.mark]))
    alarm_ns = None
    if named_ns is None and extent.step is None:
        lead_ns = round(history.config.hazards.alarm_lead_s * NS_PER_S)
        alarm_ns = log.start_within(onset_ns - lead_ns, onset_ns)
    begin_ns = next((t_ns for t_ns in (named_ns, alarm_ns) if t_ns is not None), onset_ns)
    standing = log.standing_at(begin_ns)
    if standing is not None:
        return begin_ns, Detection(begin_ns, standing, standing=True)
    detection = Detection(*(log.first_in(begin_ns, end_ns) or ()))
    return begin_ns, replace(detection, standing=alarm_ns is not None)


def injected_onset_ns(faults: pl.DataFrame | None, onset_ns: int, mark_ns: int) -> int | None:
    """Begin [ns] of the injected fault of an episode: the last one before the onset as seen, else the first after it.

    `mark_ns`: first wrong position. None where no fault of the `faults` stream lasted then.
    """
    if faults is None:
        return None
    of_gnss = ~pl.col("target").str.contains(_ODOMETER)
    begin, end = (pl.col(name).dt.timestamp("ns") for name in ("t_start", "t_end"))
    lasts = of_gnss & (begin <= mark_ns) & (end.is_null() | (end >= onset_ns))
    begins = faults.filter(lasts).select(begin).to_series().sort().to_list()
    before = [t_ns for t_ns in begins if t_ns <= onset_ns]
    return before[-1] if before else next(iter(begins), None)


def _failure_begin(history: ErrorHistory, extent: Extent) -> int | None:
    """Number of the first position that stays wrong for `failure_hold_s`, else of the first wrong one.

    Within a step at once.
    """
    onset = extent.onset
    step = extent.step
    spans = [(onset + first, onset + last) for first, last in spans_of(history.judged.is_wrong[onset : extent.end])]
    hold_ns = round(history.config.hazards.failure_hold_s * NS_PER_S)
    for first, last in spans:
        at_once = step is not None and step.first <= first <= step.last
        if at_once or history.t_ns[last] - history.t_ns[first] >= hold_ns:
            return first
    return spans[0][0] if spans else None


def _earliest_failure_ns(history: ErrorHistory, failed: int) -> int | None:
    """Earliest instant at which the failure may have begun [ns]: the first position whose interval exceeds the limit.

    Counted are the positions since the last one proved right. None where the evidence is silent for some of that time.
    """
    judged = history.judged
    right = np.flatnonzero(judged.is_right[:failed])
    since = slice(int(right[-1]) + 1 if right.size else 0, failed + 1)
    if (judged.kind[since] == NOTHING).any():
        return None
    # Where no place along the track can be compared (NaN), any error may be.
    may = ~(judged.largest_m <= judged.limit_m) | judged.is_wrong
    return int(history.t_ns[since][may[since]][0])


Healthy = dict[str, Bools]
"""Epochs whose error is within the noise, by axis of the monitors."""


def alarms_table(
    name: str, epochs: JudgedEpochs, log: FailureLog, hazards: Sequence[Episode], config: Configuration
) -> pl.DataFrame:
    """One row per alarm episode, with its verdict and who is suspected.

    Args:
        name: of the solution.
        epochs: its epochs as judged.
        log: its alarms.
        hazards: the episode of each row of hazards.
        config: margins, look-back and Doppler gap.

    Returns:
        Rows of `schemas.tables.Alarms`.

    Source:
        DOMAIN section 5.3; CONTRACT section 3.
    """
    healthy = within_noise_across(epochs, config.hazards)
    rows = [
        {
            "solution": name,
            "alarm_id": number,
            "t_start": alarm.start_ns,
            "t_end": alarm.end_ns,
            "monitors": list(alarm.monitors),
            "peak_ratio": alarm.peak_ratio,
            "verdict": alarm_verdict(alarm, epochs, healthy, config.hazards).value,
            "suspect": suspected_source(epochs, alarm.start_ns, alarm.end_ns, config).value,
            "hazard_id": next((number for number, episode in enumerate(hazards) if _is_alarm_of(alarm, episode)), None),
            **_place_columns(epochs, alarm.first),
        }
        for number, alarm in enumerate(log.alarms)
    ]
    return table_of_rows(rows, Alarms)


def _place_columns(epochs: MatchedEpochs, epoch: int) -> dict[str, object]:
    """Columns of the net element and measure [m] that an epoch was matched to."""
    element, measure_m = int(epochs.element[epoch]), float(epochs.measure_m[epoch])
    return {
        "netelement_id": epochs.elements[element] if element >= 0 else None,
        "measure_m": None if np.isnan(measure_m) else measure_m,
    }


def within_noise_across(epochs: JudgedEpochs, config: HazardConfig) -> Healthy:
    """Per axis across the track the epochs whose error against the reference is within the noise of both."""
    reference_m = np.nan_to_num(epochs.judgements.half_m / config.evidence_factor)
    axes = {
        "cross": (epochs.error_cross_m, epochs.sigma_cross_m),
        "up": (epochs.error_up_m, epochs.sigma_up_m),
    }
    return {
        axis: np.abs(error_m) <= config.evidence_factor * np.hypot(np.nan_to_num(sigma_m), reference_m)
        for axis, (error_m, sigma_m) in axes.items()
    }


def alarm_verdict(alarm: AlarmEpisode, epochs: JudgedEpochs, healthy: Healthy, config: HazardConfig) -> Verdict:
    """Verdict of an alarm: true if the whole interval exceeded the margin at some epoch, false if all stayed within.

    Only reference or balise reads can say false, and only of every position from 300 s before the alarm to its end; of
    an alarm across the track only a reference, for four metres aside are another track.
    """
    since_ns = alarm.start_ns - round(config.false_alarm_lookback_s * NS_PER_S)
    first = int(np.searchsorted(epochs.t_ns, since_ns))
    part = first + np.flatnonzero(epochs.positioned[first : alarm.last + 1])
    judged = epochs.judgements.at(part)
    can_say_false = judged.rests_on_truth
    axes = {monitor.axis for monitor in ALL_MONITORS if monitor.name in alarm.monitors}
    for axis in healthy.keys() & axes:
        can_say_false = can_say_false & healthy[axis][part]
    if judged.wrong_track.any():
        return Verdict.TRUE
    margin_m = healthy_margins_m(epochs.sigma_along_m[part], judged.limit_m, config)
    return verdict_of_intervals(judged.low_m, judged.high_m, margin_m, can_say_false)


def verdict_of_intervals(low_m: Floats, high_m: Floats, margin_m: Floats, can_say_false: Bools) -> Verdict:
    """Verdict by the intervals of the error at the positions of an alarm (NaN: not known) against their margins [m]."""
    beyond = (low_m > margin_m) | (high_m < -margin_m)
    within = can_say_false & (low_m >= -margin_m) & (high_m <= margin_m)
    if beyond.any():
        return Verdict.TRUE
    return Verdict.FALSE if within.size and within.all() else Verdict.UNKNOWN


def _is_alarm_of(alarm: AlarmEpisode, episode: Episode) -> bool:
    """Whether the fault of the episode lasted during the alarm, or the alarm detected it."""
    lasted = alarm.start_ns <= episode.end_ns and alarm.end_ns >= episode.onset_ns
    detected_ns = episode.detection.t_ns
    return lasted or (detected_ns is not None and alarm.start_ns <= detected_ns <= alarm.end_ns)


def suspected_source(epochs: JudgedEpochs, begin_ns: int, end_ns: int, config: Configuration) -> Suspect:
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
    first = int(np.searchsorted(epochs.t_ns, begin_ns - round(config.hazards.suspect_lookback_s * NS_PER_S)))
    part = slice(first, max(first, int(np.searchsorted(epochs.t_ns, end_ns, side="right"))))
    judged = epochs.judgements.at(part)
    margin_m = healthy_margins_m(epochs.sigma_along_m[part], judged.limit_m, config.hazards)
    left = (judged.least_m > margin_m) | judged.wrong_track
    if (left & (judged.kind != ODOMETER)).any():
        return Suspect.GNSS
    contradicted = epochs.odometer_standing[part] | epochs.odometer_wrong[part]
    if contradicted.any() or _leave_odometer_together(epochs, part, margin_m, config):
        return Suspect.ODOMETER
    if left.any():
        return Suspect.GNSS
    ambiguous = epochs.positioned[part] & ~epochs.unambiguous[part]
    return Suspect.TRACK if ambiguous.any() else Suspect.UNKNOWN


def _leave_odometer_together(epochs: JudgedEpochs, part: slice, margin_m: Floats, config: Configuration) -> bool:
    """Whether position and Doppler agree at some epoch at which both have left the odometer by half the margin."""
    columns = np.array([epochs.path_m[part], epochs.odometer_m[part], epochs.velocity_along_mps[part]])
    known = np.isfinite(columns).all(axis=0)
    if known.sum() < 2:
        return False
    path_m, odometer_m, velocity_mps = columns[:, known]
    dt_s = np.diff(epochs.t_ns[part][known]) / NS_PER_S
    mean_mps = 0.5 * (velocity_mps[1:] + velocity_mps[:-1])
    near = dt_s <= config.monitors.doppler_gap_s
    doppler_m = np.concatenate([[0.0], np.cumsum(np.where(near, mean_mps * dt_s, 0.0))])
    position_m = path_m - path_m[0]
    counted_m = odometer_m - odometer_m[0]
    limit_m = 0.5 * margin_m[known]
    both = (np.abs(position_m - counted_m) > limit_m) & (np.abs(doppler_m - counted_m) > limit_m)
    return bool((both & (np.abs(position_m - doppler_m) <= limit_m)).any())
