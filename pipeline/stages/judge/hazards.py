"""Hazards: jumps, shifts and wrong tracks, judged on offered virtual balises (DOMAIN section 5.3), and their rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import reactions_ns
from pipeline.stages.evidence.evidence import KINDS
from pipeline.stages.judge.episodes import Episode, suspected_source
from pipeline.stages.judge.epochs import speed_at_mps
from pipeline.stages.judge.failures import ErrorHistory, Jump
from pipeline.stages.judge.judged import JudgedEpochs, JudgedOffers
from pipeline.stages.judge.judgement import JudgeInput
from schemas.arrays import NS_PER_S
from schemas.conform import table_of_rows
from schemas.enums import Evidence, FailureMode, Hazard, Timing
from schemas.tables import Hazards

Row = dict[str, Any]
_JUMPS = {Hazard.VB_JUMP_1A, Hazard.VB_JUMP_1B}


@dataclass
class HazardRow:
    """A row before it is written: the offers that it hits, in order, and of these the ones that a jump crosses."""

    hazard: Hazard
    episode: Episode
    jump: Jump | None = None
    hits: list[int] = field(default_factory=list)
    crossed: list[int] = field(default_factory=list)
    caused_by: HazardRow | None = None


def hazard_rows(episodes: Iterable[Episode], history: ErrorHistory) -> list[HazardRow]:
    """At most one row per episode and class, and one for VBs that the jump back crosses.

    Args:
        episodes: faults in order of time.
        history: the positions and offers that they are of.

    Returns:
        Rows in order of time.

    Source:
        DIAG, VB Jump and VB Shift; DOMAIN section 5.3.
    """
    return [row for episode in episodes for row in _rows_of_episode(episode, history)]


def _rows_of_episode(episode: Episode, history: ErrorHistory) -> list[HazardRow]:
    """Rows of one episode: of each class of jump, of shifts, of wrong tracks, and of the jump back."""
    by_class = _jump_rows(episode, history)
    crossed = {hit for row in by_class.values() for hit in row.crossed}
    for hit in _wrong_offers(episode, history):
        if hit not in crossed:
            on_other_track = history.offers.judged.wrong_track[hit]
            hazard = Hazard.VB_WRONG_TRACK if on_other_track else min(by_class.keys() & _JUMPS, default=Hazard.VB_SHIFT)
            by_class.setdefault(hazard, HazardRow(hazard, episode)).hits.append(hit)
    rows = sorted(by_class.values(), key=lambda row: hazard_instant_ns(row, history))
    back = episode.jump_back
    crossed_back = [] if back is None else crossed_by_jump(back, history)
    if crossed_back:
        hazard = _jump_class(crossed_back, history.offers)
        rows.append(HazardRow(hazard, episode, back, crossed_back, crossed_back, next(iter(rows), None)))
    return rows


def _jump_rows(episode: Episode, history: ErrorHistory) -> dict[Hazard, HazardRow]:
    """A row per class of jump; VBs crossed later by a jump of the same class are appended."""
    rows: dict[Hazard, HazardRow] = {}
    for jump in history.jumps_in(episode.onset, episode.end):
        crossed = crossed_by_jump(jump, history)
        if crossed:
            hazard = _jump_class(crossed, history.offers)
            row = rows.setdefault(hazard, HazardRow(hazard, episode, jump))
            row.hits += crossed
            row.crossed += crossed
    return rows


def _wrong_offers(episode: Episode, history: ErrorHistory) -> list[int]:
    """Numbers of the offers judged wrong in the episode that lie beyond the shift limit or on another track."""
    offers = history.offers
    beyond = (offers.judged.least_m > history.config.hazards.limits.shift_m) | offers.judged.wrong_track
    wrong = offers.offered & offers.judged.is_wrong & history.offers_between(episode.onset, episode.end)
    return np.flatnonzero(beyond & wrong).tolist()


def crossed_by_jump(jump: Jump, history: ErrorHistory) -> list[int]:
    """Numbers of the virtual balises between the ends of a jump that the train's own step does not cross."""
    offers = history.offers
    between = np.flatnonzero(offers.virtual & history.offers_between(jump.first, jump.last + 1))
    if between.size == 0:
        return []
    positions = history.positions
    before, after = jump.first - 1, jump.last
    step_m = jump.step_m * int(positions.direction[after])
    train_m = float(positions.train_m[before])
    # Where the train was is better known by the evidence than by the position before the jump.
    path_m = [float(positions.path_m[number]) for number in (before, after)]
    start_m = path_m[0] if np.isnan(train_m) else train_m
    low_m, high_m = sorted((start_m, start_m + (path_m[1] - path_m[0]) - step_m))
    return [hit for hit in between.tolist() if not low_m <= offers.path_m[hit] <= high_m]


def _jump_class(crossed: list[int], offers: JudgedOffers) -> Hazard:
    """1A where a jump crosses several balises, 1B where it crosses one."""
    return Hazard.VB_JUMP_1A if len(_balise_names(crossed, offers)) > 1 else Hazard.VB_JUMP_1B


def _balise_names(hits: list[int], offers: JudgedOffers) -> list[str]:
    """Balises of some offers in order, each once."""
    return list(dict.fromkeys(offers.balise_id[hit] for hit in hits))


def hazard_instant_ns(row: HazardRow, history: ErrorHistory) -> int:
    """Instant of the hazard [ns]: the jump, or the offered crossing of the first VB hit."""
    return int(history.offers.t_ns[row.hits[0]] if row.jump is None else history.t_ns[row.jump.first])


def hazard_size_m(row: HazardRow, history: ErrorHistory) -> float | None:
    """Error [m], with its sign, of largest size in the episode; of a jump back the error that it ended.

    By the middle of the interval. Where no place along the track can be compared with the evidence, the step of the
    jump.
    """
    episode = row.episode
    jump = row.jump
    of_positions = history.judged.middle_m[episode.onset : episode.end]
    error_m = np.concatenate([of_positions, history.offers.judged.middle_m[row.hits]])
    error_m = error_m[np.isfinite(error_m)]
    if jump is not None and jump is episode.jump_back:
        return -jump.step_m
    if jump is not None and error_m.size == 0:
        return jump.step_m
    return float(error_m[np.argmax(np.abs(error_m))]) if error_m.size else None


def error_growth_mps(row: HazardRow, history: ErrorHistory) -> float | None:
    """Slope of the error from onset to failure [m/s], by the interval's centre; None for a step."""
    episode = row.episode
    if episode.step is not None or row.jump is not None:
        return None
    until = episode.mark if episode.failed is None else episode.failed
    part = slice(episode.onset, until + 1)
    error_m = history.judged.middle_m[part]
    t_s = (history.t_ns[part] - episode.onset_ns) / NS_PER_S
    known = np.isfinite(error_m)
    if known.sum() < 2 or np.ptp(t_s[known]) == 0.0:
        return None
    return float(np.polyfit(t_s[known], error_m[known], 1)[0])


def hazards_table(
    rows: Sequence[HazardRow], given: JudgeInput, epochs: JudgedEpochs, history: ErrorHistory
) -> pl.DataFrame:
    """The hazards of a solution as a table.

    Args:
        rows: hazards in order of time; `hazard_id` is the place among them.
        given: the solution.
        epochs: its epochs as judged.
        history: the positions and offers that the rows are of.

    Returns:
        Rows of `schemas.tables.Hazards`.
    """
    ids = {id(row): number for number, row in enumerate(rows)}
    values = [
        {
            "solution": given.solution.name,
            "hazard_id": number,
            "caused_by": ids.get(id(row.caused_by)),
            "suspect": suspected_source(epochs, row.episode.onset_ns, row.episode.end_ns, given.config).value,
            "size_m": hazard_size_m(row, history),
            "rate_mps": error_growth_mps(row, history),
            "evidence": _evidence_of_row(row, history).value,
            "hazardous_s": row.episode.failure.hazardous_s,
            "hazardous_may_s": row.episode.failure.hazardous_may_s,
            "budget_s": given.config.budget_s,
            "within_budget": row.episode.failure.within_budget,
            **_class_columns(row, history.offers),
            **instant_columns(row, history),
            **_place_columns(row, given, epochs, history),
        }
        for number, row in enumerate(rows)
    ]
    return table_of_rows(values, Hazards)


def _class_columns(row: HazardRow, offers: JudgedOffers) -> Row:
    """Columns of class, failure mode, timing, and of the VBs hit and accepted."""
    error_m = float(offers.judged.middle_m[row.hits[0]])
    timing = Timing.EARLY if error_m > 0.0 else Timing.LATE if error_m < 0.0 else Timing.NONE
    mode = FailureMode.INSERTION
    if row.hazard is Hazard.VB_SHIFT and timing is not Timing.EARLY:
        mode = FailureMode.DELETION if offers.beyond_window[row.hits].any() else FailureMode.NONE
    names = _balise_names(row.hits, offers)
    accepted = {offers.balise_id[hit] for hit in row.hits if offers.accepted[hit]}
    return {
        "hazard": row.hazard.value,
        "failure_mode": mode.value,
        "timing": timing.value,
        "balise_ids": names,
        "accepted_ids": [name for name in names if name in accepted],
    }


def _evidence_of_row(row: HazardRow, history: ErrorHistory) -> Evidence:
    """Evidence behind the judgement of the first VB hit, else of the first wrong position; else the odometer."""
    kinds = (history.offers.judged.kind[row.hits[0]], history.judged.kind[row.episode.mark])
    return next((KINDS[kind] for kind in kinds if kind >= 0), Evidence.ODOMETER)


def instant_columns(row: HazardRow, history: ErrorHistory) -> Row:
    """Columns of onset, hazard, failure, detection, negation and end, and the times between (DIAG, T_D and T_dsf)."""
    episode = row.episode
    detected_ns = episode.detection.t_ns
    failed_ns = None if episode.failed is None else int(history.t_ns[episode.failed])
    return {
        "t_onset": episode.onset_ns,
        "t_hazard": hazard_instant_ns(row, history),
        "t_failure": failed_ns,
        "t_failure_may": episode.may_ns,
        "t_detected": detected_ns,
        "t_negated": None if detected_ns is None else _negation_ns(detected_ns, history),
        "t_end": episode.end_ns,
        "monitor": episode.detection.monitor,
        "detected": detected_ns is not None,
        "alarm_before_onset": episode.detection.standing,
        "time_to_detect_s": _seconds_between(episode.onset_ns, detected_ns),
        "time_since_failure_s": _seconds_between(failed_ns, detected_ns),
        "time_since_failure_may_s": _seconds_between(episode.may_ns, detected_ns),
    }


def _negation_ns(detected_ns: int, history: ErrorHistory) -> int:
    """Instant of negation [ns]: detection and the time to react."""
    return detected_ns + int(reactions_ns(np.array([detected_ns]), history.t_ns, history.config)[0])


def _seconds_between(begin_ns: int | None, end_ns: int | None) -> float | None:
    """Time from one instant to another [s]; None where either is not known."""
    return None if begin_ns is None or end_ns is None else (end_ns - begin_ns) / NS_PER_S


def _place_columns(row: HazardRow, given: JudgeInput, epochs: JudgedEpochs, history: ErrorHistory) -> Row:
    """Columns of the train's place and speed at the hazard; None where not known."""
    number = int(history.completing[row.hits[0]]) if row.jump is None else row.jump.first
    positions = history.positions
    away_m = int(positions.direction[number]) * float(positions.judgements.middle_m[number])
    path_m = float(positions.path_m[number]) - away_m
    names, measures_m = given.solution.path.locate(max(int(positions.leg[number]), 0), path_m)
    speed_mps = speed_at_mps(epochs, np.array([hazard_instant_ns(row, history)]))
    figures = {"measure_m": measures_m[0], "path_m": path_m, "speed_mps": speed_mps[0]}
    known = {name: None if np.isnan(value) else float(value) for name, value in figures.items()}
    return {"netelement_id": names[0], **known}
