"""Hazards: jumps, shifts and wrong tracks, judged on offered virtual balises (DOMAIN section 5.3), and their rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.evidence.evidence import KINDS
from pipeline.stages.judge.case import Case
from pipeline.stages.judge.episodes import Episode
from pipeline.stages.judge.failures import Course, accepted_in, numbers_of, within_budget
from pipeline.stages.judge.judgement import Judgements
from pipeline.stages.judge.jumps import Jump
from pipeline.stages.judge.suspect import suspect_of
from pipeline.stages.judge.use import reaction_s
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, times_ns
from schemas.config import Configuration, HazardConfig
from schemas.conform import dtypes
from schemas.enums import Evidence, FailureMode, Hazard, Timing
from schemas.tables import Hazards


@dataclass(frozen=True)
class Offers:
    """The frame of offers in arrays, `number`: the position, by its row, that completes each."""

    frame: pl.DataFrame
    balise_id: list[str]
    number: Ints
    t_ns: Ints
    path_m: Floats
    judged: Judgements
    virtual: Bools
    offered: Bools
    accepted: Bools
    beyond_window: Bools

    @classmethod
    def of(cls, frame: pl.DataFrame, positions: pl.DataFrame) -> Offers:
        return cls(
            frame=frame,
            balise_id=frame["balise_id"].to_list(),
            number=numbers_of(frame, positions),
            t_ns=times_ns(frame),
            path_m=floats(frame, "path_m"),
            judged=Judgements.of(frame),
            virtual=flags(frame, "virtual"),
            offered=flags(frame, "offered"),
            accepted=flags(frame, "accepted"),
            beyond_window=flags(frame, "beyond_window"),
        )


@dataclass
class HazardRow:
    """One row in the making: its class, episode, jump if any, and the offers that hit, in order.

    `crossed`: those of the offers that a jump crosses.
    """

    hazard: Hazard
    episode: Episode
    jump: Jump | None = None
    hits: list[int] = field(default_factory=list)
    crossed: list[int] = field(default_factory=list)
    caused_by: HazardRow | None = None


def hazard_rows(episodes: Iterable[Episode], course: Course, offers: Offers, config: HazardConfig) -> list[HazardRow]:
    """At most one row per episode and class, and one for VBs that the jump back crosses; in order of time."""
    return [row for episode in episodes for row in _of_episode(episode, course, offers, config)]


def _of_episode(episode: Episode, course: Course, offers: Offers, config: HazardConfig) -> list[HazardRow]:
    taken: set[int] = set()
    rows: list[HazardRow] = []
    for jump in course.jumps_in(episode.onset, episode.end):
        crossed = crossed_by(jump, offers, course)
        taken.update(crossed)
        if crossed:
            _add(rows, HazardRow(_class_of(crossed, offers), episode, jump), crossed)
    hits = _hits(episode, offers, taken, config)
    shifted = [hit for hit in hits if not offers.judged.wrong_track[hit]]
    jumped = next((row for kind in (Hazard.VB_JUMP_1A, Hazard.VB_JUMP_1B) for row in rows if row.hazard is kind), None)
    if jumped is not None:
        jumped.hits += shifted
    elif shifted:
        rows.append(HazardRow(Hazard.VB_SHIFT, episode, None, shifted))
    astray = [hit for hit in hits if offers.judged.wrong_track[hit]]
    if astray:
        rows.append(HazardRow(Hazard.VB_WRONG_TRACK, episode, None, astray))
    rows.sort(key=lambda row: offers.t_ns[row.hits[0]] if row.jump is None else course.t_ns[row.jump.first])
    back = _jump_back(episode, rows, offers, course)
    return [*rows, back] if back is not None else rows


def _add(rows: list[HazardRow], row: HazardRow, crossed: list[int]) -> None:
    """VBs hit later by a jump of the same class are appended."""
    own = next((other for other in rows if other.hazard is row.hazard), None)
    if own is None:
        rows.append(row)
        own = row
    own.hits += crossed
    own.crossed += crossed


def _hits(episode: Episode, offers: Offers, taken: set[int], config: HazardConfig) -> list[int]:
    """Offers judged wrong during the episode, beyond the shift limit or on another track, that no jump crossed."""
    beyond = (offers.judged.least_m > config.shift_limit_m) | offers.judged.wrong_track
    inside = (offers.number >= episode.onset) & (offers.number < episode.end)
    hit = np.flatnonzero(beyond & offers.offered & offers.judged.is_wrong & inside)
    return [number for number in hit.tolist() if number not in taken]


def _jump_back(episode: Episode, rows: list[HazardRow], offers: Offers, course: Course) -> HazardRow | None:
    if episode.jump_back is None:
        return None
    crossed = crossed_by(episode.jump_back, offers, course)
    if not crossed:
        return None
    cause = rows[0] if rows else None
    return HazardRow(_class_of(crossed, offers), episode, episode.jump_back, crossed, crossed, cause)


def crossed_by(jump: Jump, offers: Offers, course: Course) -> list[int]:
    """Virtual balises on the way of a jump that the train's own step does not cross."""
    on_the_way = np.flatnonzero(offers.virtual & (offers.number >= jump.first) & (offers.number <= jump.last))
    if on_the_way.size == 0:
        return []
    before, after = course.positions[jump.first - 1], course.positions[jump.last]
    step_m = jump.step_m * after["direction"][0]
    # Where the train was is better known by the evidence than by the position before the jump.
    start_m = next(before[name][0] for name in ("train_m", "path_m") if before[name][0] is not None)
    low_m, high_m = sorted((start_m, start_m + (after["path_m"][0] - before["path_m"][0]) - step_m))
    own = (offers.path_m[on_the_way] >= low_m) & (offers.path_m[on_the_way] <= high_m)
    return on_the_way[~own].tolist()  # type: ignore[no-any-return]


def _class_of(crossed: list[int], offers: Offers) -> Hazard:
    distinct = {offers.balise_id[number] for number in crossed}
    return Hazard.VB_JUMP_1A if len(distinct) > 1 else Hazard.VB_JUMP_1B


def size_m(row: HazardRow, course: Course, offers: Offers) -> float | None:
    """The largest |e| of the episode with its sign, by the interval's centre; of a jump back its step.

    The step of a jump serves where no place along the track can be compared with the evidence.
    """
    episode, jump = row.episode, row.jump
    if jump is not None and jump is episode.jump_back:
        return jump.step_m
    lasting = course.judged.take(np.arange(episode.onset, episode.end)).middle_m
    hit = offers.judged.take(np.array(row.hits, dtype=np.int64)).middle_m
    error_m = np.concatenate([lasting, hit])
    error_m = error_m[np.isfinite(error_m)]
    if error_m.size == 0:
        return None if jump is None else jump.step_m
    return float(error_m[np.argmax(np.abs(error_m))])


def rate_mps(row: HazardRow, course: Course) -> float | None:
    """Slope of the error from onset to failure [m/s], by the interval's centre; None for a step."""
    episode = row.episode
    if episode.step is not None or row.jump is not None:
        return None
    until = episode.mark if episode.failure_number is None else episode.failure_number
    part = slice(episode.onset, until + 1)
    error_m, t_s = course.judged.middle_m[part], (course.t_ns[part] - episode.onset_ns) / NS_PER_S
    known = np.isfinite(error_m)
    if known.sum() < 2 or np.ptp(t_s[known]) == 0.0:
        return None
    slope, _ = np.polyfit(t_s[known], error_m[known], 1)
    return float(slope)


def hazards_table(
    rows: Sequence[HazardRow], case: Case, epochs: pl.DataFrame, course: Course, offers: Offers
) -> pl.DataFrame:
    """Rows in order of time; `hazard_id` is the place in `rows`; `epochs`: judged."""
    ids = {id(row): number for number, row in enumerate(rows)}
    config = case.config
    found = [
        {
            "solution": case.solution.name,
            "hazard_id": number,
            "caused_by": None if row.caused_by is None else ids[id(row.caused_by)],
            "suspect": suspect_of(epochs, row.episode.onset_ns, row.episode.end_ns, config).value,
            "size_m": size_m(row, course, offers),
            "rate_mps": rate_mps(row, course),
            "evidence": _evidence(row, course, offers).value,
            **_kind(row, offers),
            **instants(row, course, offers, config),
            **_place(row, case, epochs, course, offers),
            **_budget(row.episode, course, offers, config.budget_s),
        }
        for number, row in enumerate(rows)
    ]
    return pl.DataFrame(found, schema=dtypes(Hazards))


def _kind(row: HazardRow, offers: Offers) -> dict[str, Any]:
    ids = list(dict.fromkeys(offers.balise_id[hit] for hit in row.hits))
    accepted = {offers.balise_id[hit] for hit in row.hits if offers.accepted[hit]}
    return {
        "hazard": row.hazard.value,
        "failure_mode": _failure_mode(row, offers).value,
        "timing": _timing(row, offers).value,
        "balise_ids": ids,
        "accepted_ids": [balise for balise in ids if balise in accepted],
    }


def _timing(row: HazardRow, offers: Offers) -> Timing:
    """Offered before (+) or after the train is there."""
    error_m = float(offers.judged.middle_m[row.hits[0]])
    if np.isnan(error_m) or error_m == 0.0:
        return Timing.NONE
    return Timing.EARLY if error_m > 0.0 else Timing.LATE


def _failure_mode(row: HazardRow, offers: Offers) -> FailureMode:
    if row.hazard is not Hazard.VB_SHIFT or _timing(row, offers) is Timing.EARLY:
        return FailureMode.INSERTION
    return FailureMode.DELETION if offers.beyond_window[row.hits].any() else FailureMode.NONE


def _evidence(row: HazardRow, course: Course, offers: Offers) -> Evidence:
    """What the judgement of the first VB hit rests on, else that of the mark; the odometer where nothing else is."""
    kinds = [offers.judged.kind[row.hits[0]], course.judged.kind[row.episode.mark]]
    known = [KINDS[kind] for kind in kinds if kind >= 0]
    return known[0] if known else Evidence.ODOMETER


def instants(row: HazardRow, course: Course, offers: Offers, config: Configuration) -> dict[str, Any]:
    """When it began, hit, failed, was detected and ended, and the times between (DIAG, T_D and T_dsf)."""
    episode, jump = row.episode, row.jump
    reaction_ns = round(reaction_s(course.t_ns, config) * NS_PER_S)
    detected_ns = episode.detected_ns
    return {
        "t_onset": episode.onset_ns,
        "t_hazard": int(offers.t_ns[row.hits[0]] if jump is None else course.t_ns[jump.first]),
        "t_failure": episode.t_failure_ns,
        "t_failure_may": episode.t_failure_may_ns,
        "t_detected": detected_ns,
        "t_negated": None if detected_ns is None else detected_ns + reaction_ns,
        "t_end": episode.end_ns,
        "monitor": episode.monitor,
        "detected": detected_ns is not None,
        "alarm_before_onset": episode.alarm_before_onset,
        "time_to_detect_s": _seconds(episode.onset_ns, detected_ns),
        "time_since_failure_s": _seconds(episode.t_failure_ns, detected_ns),
        "time_since_failure_may_s": _seconds(episode.t_failure_may_ns, detected_ns),
    }


def _seconds(begin_ns: int | None, end_ns: int | None) -> float | None:
    return None if begin_ns is None or end_ns is None else (end_ns - begin_ns) / NS_PER_S


def _place(row: HazardRow, case: Case, epochs: pl.DataFrame, course: Course, offers: Offers) -> dict[str, Any]:
    """Where the train was at the hazard, and how fast it went; null where nobody knows."""
    at_offer = row.jump is None
    number = int(offers.number[row.hits[0]]) if row.jump is None else row.jump.first
    there = course.positions.row(number, named=True)
    path_m = there["path_m"] - there["direction"] * float(course.judged.middle_m[number])
    names, measures = case.solution.path.locate(max(there["leg"], 0), path_m)
    hazard_ns = offers.t_ns[row.hits[:1]] if at_offer else course.t_ns[[number]]
    return {
        "netelement_id": names[0],
        "measure_m": _known(float(measures[0])),
        "path_m": _known(path_m),
        "speed_mps": _known(float(speed_at(epochs, hazard_ns)[0])),
    }


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def speed_at(epochs: pl.DataFrame, t_ns: Ints) -> Floats:
    """Speed [m/s] by the epochs around each instant; NaN where no epoch knows it."""
    speed_mps, stamps_ns = np.abs(floats(epochs, "speed_mps")), times_ns(epochs)
    known = np.isfinite(speed_mps)
    if not known.any():
        return np.full(t_ns.size, np.nan)
    at_s, stamps_s = ((values - stamps_ns[0]) / NS_PER_S for values in (t_ns, stamps_ns[known]))
    found: Floats = np.interp(at_s, stamps_s, speed_mps[known])
    return found


def _budget(episode: Episode, course: Course, offers: Offers, budget_s: float) -> dict[str, Any]:
    """Of the failure that the episode belongs to; of a fault that was never surely in use, what may have been."""
    failure = episode.failure
    if failure is not None:
        times = {"hazardous_s": failure.hazardous_s, "hazardous_may_s": failure.hazardous_may_s}
        return {**times, "budget_s": budget_s, "within_budget": failure.within_budget}
    may_s = course.unknown_or_wrong_s(episode.onset, episode.end)
    accepted = accepted_in(offers.frame, course.positions, episode.onset, episode.end)
    within = within_budget(0.0, may_s, accepted, budget_s)
    return {"hazardous_s": 0.0, "hazardous_may_s": may_s, "budget_s": budget_s, "within_budget": within}
