"""Hazards: jumps, shifts and wrong tracks, judged on offered virtual balises (DOMAIN section 5.3), and their rows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import polars as pl

from pipeline.evidence.evidence import KINDS
from pipeline.judge.bench import Bench, Offers, Series
from pipeline.judge.episodes import Episode
from pipeline.judge.judgement import UNKNOWN, WRONG
from pipeline.judge.jumps import Jump
from pipeline.judge.states import reaction_s
from pipeline.judge.suspect import suspect_of
from schemas.arrays import NS_PER_S
from schemas.config import HazardConfig
from schemas.conform import dtypes
from schemas.enums import Evidence, FailureMode, Hazard, Judgement, Timing
from schemas.stages import Failures
from schemas.tables import Hazards


@dataclass
class Draft:
    """One row in the making: its class, episode, jump if any, and the offers that hit, in order.

    `crossed`: those of the offers that a jump crosses.
    """

    hazard: Hazard
    episode: Episode
    jump: Jump | None = None
    hits: list[int] = field(default_factory=list)
    crossed: list[int] = field(default_factory=list)
    caused_by: Draft | None = None


def drafts_of(episodes: Iterable[Episode], bench: Bench) -> list[Draft]:
    """At most one row per episode and class, and one for VBs that the jump back crosses; in order of time."""
    return [
        draft
        for episode in episodes
        for draft in _of_episode(episode, bench.series, bench.offers, bench.config.hazards)
    ]


def _of_episode(episode: Episode, series: Series, offers: Offers, config: HazardConfig) -> list[Draft]:
    inside = [jump for jump in series.jumps if episode.onset <= jump.last and jump.first < episode.end]
    taken: set[int] = set()
    rows: list[Draft] = []
    for jump in inside:
        crossed = crossed_by(jump, offers, series)
        taken.update(crossed)
        if crossed:
            _add(rows, Draft(_class_of(crossed, offers), episode, jump), crossed)
    hits = _hits(episode, offers, taken, config)
    shifted = [hit for hit in hits if not offers.judged.wrong_track[hit]]
    jumped = next((row for kind in (Hazard.VB_JUMP_1A, Hazard.VB_JUMP_1B) for row in rows if row.hazard is kind), None)
    if jumped is not None:
        jumped.hits += shifted
    elif shifted:
        rows.append(Draft(Hazard.VB_SHIFT, episode, None, shifted))
    astray = [hit for hit in hits if offers.judged.wrong_track[hit]]
    if astray:
        rows.append(Draft(Hazard.VB_WRONG_TRACK, episode, None, astray))
    rows.sort(key=lambda row: offers.t_ns[row.hits[0]] if row.jump is None else series.t_ns[row.jump.first])
    back = _jump_back(episode, rows, offers, series)
    return [*rows, back] if back is not None else rows


def _add(rows: list[Draft], draft: Draft, crossed: list[int]) -> None:
    """VBs hit later by a jump of the same class are appended."""
    own = next((row for row in rows if row.hazard is draft.hazard), None)
    if own is None:
        rows.append(draft)
        own = draft
    own.hits += crossed
    own.crossed += crossed


def _hits(episode: Episode, offers: Offers, taken: set[int], config: HazardConfig) -> list[int]:
    """Offers judged wrong during the episode, beyond the shift limit or on another track, that no jump crossed."""
    beyond = (offers.judged.least_m > config.shift_limit_m) | offers.judged.wrong_track
    wrong = beyond & offers.offered & (offers.judged.code == WRONG)
    hit = np.flatnonzero(wrong & episode.holds(offers.number))
    return [number for number in hit.tolist() if number not in taken]


def _jump_back(episode: Episode, rows: list[Draft], offers: Offers, series: Series) -> Draft | None:
    if episode.jump_back is None:
        return None
    crossed = crossed_by(episode.jump_back, offers, series)
    if not crossed:
        return None
    cause = rows[0] if rows else None
    return Draft(_class_of(crossed, offers), episode, episode.jump_back, crossed, crossed, cause)


def crossed_by(jump: Jump, offers: Offers, series: Series) -> list[int]:
    """Virtual balises on the way of a jump that the train's own step does not cross."""
    on_the_way = np.flatnonzero(offers.virtual & (offers.number >= jump.first) & (offers.number <= jump.last))
    before, after = series.path_m[jump.first - 1], series.path_m[jump.last]
    step_m = jump.step_m * series.direction[jump.last]
    start = series.train_m[jump.first - 1]
    start = before if np.isnan(start) else start
    low, high = sorted((start, start + (after - before) - step_m))
    own = (offers.path_m[on_the_way] >= low) & (offers.path_m[on_the_way] <= high)
    return on_the_way[~own].tolist()  # type: ignore[no-any-return]


def _class_of(crossed: list[int], offers: Offers) -> Hazard:
    distinct = {offers.balise_id[number] for number in crossed}
    return Hazard.VB_JUMP_1A if len(distinct) > 1 else Hazard.VB_JUMP_1B


def size_m(draft: Draft, bench: Bench) -> float | None:
    """The largest known |e| of the episode with its sign; of a jump back its step, as of a jump without known errors.

    Where no error is known closely, the largest that is sure.
    """
    episode, jump = draft.episode, draft.jump
    if jump is not None and jump is episode.jump_back:
        return jump.step_m
    known_to_m = bench.config.hazards.known_error_m
    lasting = bench.series.judged.take(np.arange(episode.onset, episode.end))
    hit = bench.offers.judged.take(np.array(draft.hits, dtype=np.int64))
    known = np.concatenate([lasting.known_m(known_to_m), hit.known_m(known_to_m)])
    if not np.isfinite(known).any():
        if jump is not None:
            return jump.step_m
        known = np.concatenate([np.sign(one.middle_m) * one.least_m for one in (lasting, hit)])
    known = known[np.isfinite(known)]
    return float(known[np.argmax(np.abs(known))]) if known.size else None


def rate_mps(draft: Draft, bench: Bench) -> float | None:
    """Slope of the error from onset to failure [m/s]; None for a step, or where it is not known."""
    episode = draft.episode
    if episode.step is not None or draft.jump is not None:
        return None
    until = episode.mark if episode.failure is None else episode.failure
    part = slice(episode.onset, until + 1)
    series, known_to_m = bench.series, bench.config.hazards.known_error_m
    error, t_s = series.judged.known_m(known_to_m)[part], (series.t_ns[part] - episode.onset_ns) / 1e9
    known = np.isfinite(error)
    if known.sum() < 2 or np.ptp(t_s[known]) == 0.0:
        return None
    slope, _ = np.polyfit(t_s[known], error[known], 1)
    return float(slope)


def within_budget(episode: Episode, offers: Offers, budget_s: float) -> bool | None:
    """Whether an episode kept the allowed T_D: not where a VB was accepted wrong in it; null where nobody knows."""
    accepted = accepted_in(episode, offers)
    if accepted is Judgement.WRONG or episode.hazardous_s > budget_s:
        return False
    proved = episode.hazardous_may_s <= budget_s and accepted is Judgement.RIGHT
    return True if proved else None


def accepted_in(episode: Episode, offers: Offers) -> Judgement:
    """The worst judgement of the VBs that were accepted in an episode; right where none was."""
    codes = offers.judged.code[offers.accepted & episode.holds(offers.number)]
    worst = {WRONG: Judgement.WRONG, UNKNOWN: Judgement.UNKNOWN}
    return next((word for code, word in worst.items() if (codes == code).any()), Judgement.RIGHT)


def failures_table(episodes: Sequence[Episode], drafts: Sequence[Draft], bench: Bench) -> pl.DataFrame:
    """One row per episode with time judged wrong in use."""
    first_row = {id(draft.episode): number for number, draft in reversed(list(enumerate(drafts)))}
    series, budget_s = bench.series, bench.config.budget_s
    rows = [
        {
            "t_onset": episode.onset_ns,
            "t_failure": None if episode.failure is None else int(series.t_ns[episode.failure]),
            "t_end": episode.end_ns,
            "hazardous_s": episode.hazardous_s,
            "hazardous_may_s": episode.hazardous_may_s,
            "accepted": accepted_in(episode, bench.offers).value,
            "within_budget": within_budget(episode, bench.offers, budget_s),
            "wrong_track": bool(series.judged.wrong_track[episode.onset : episode.end].any()),
            "hazard_id": first_row.get(id(episode)),
        }
        for episode in episodes
        if episode.hazardous_s > 0.0
    ]
    return pl.DataFrame(rows, schema=dtypes(Failures))


def hazards_table(drafts: Sequence[Draft], bench: Bench) -> pl.DataFrame:
    """Rows in order of time; `hazard_id` is the place in `drafts`."""
    ids = {id(draft): number for number, draft in enumerate(drafts)}
    rows = [
        {
            "solution": bench.solution.name,
            "hazard_id": number,
            "caused_by": None if draft.caused_by is None else ids[id(draft.caused_by)],
            "suspect": suspect_of(bench, draft.episode.onset_ns, draft.episode.end_ns).value,
            "size_m": size_m(draft, bench),
            "rate_mps": rate_mps(draft, bench),
            "evidence": _evidence(draft, bench).value,
            **_kind(draft, bench.offers),
            **_instants(draft, bench),
            **_budget(draft, bench),
        }
        for number, draft in enumerate(drafts)
    ]
    return pl.DataFrame(rows, schema=dtypes(Hazards))


def _kind(draft: Draft, offers: Offers) -> dict[str, Any]:
    ids = list(dict.fromkeys(offers.balise_id[hit] for hit in draft.hits))
    accepted = {offers.balise_id[hit] for hit in draft.hits if offers.accepted[hit]}
    return {
        "hazard": draft.hazard.value,
        "failure_mode": _failure_mode(draft, offers).value,
        "timing": _timing(draft, offers).value,
        "balise_ids": ids,
        "accepted_ids": [balise for balise in ids if balise in accepted],
    }


def _timing(draft: Draft, offers: Offers) -> Timing:
    """Offered before (+) or after the train is there."""
    error = float(offers.judged.middle_m[draft.hits[0]])
    if np.isnan(error) or error == 0.0:
        return Timing.NONE
    return Timing.EARLY if error > 0.0 else Timing.LATE


def _failure_mode(draft: Draft, offers: Offers) -> FailureMode:
    if draft.hazard is not Hazard.VB_SHIFT or _timing(draft, offers) is Timing.EARLY:
        return FailureMode.INSERTION
    return FailureMode.DELETION if offers.beyond_window[draft.hits].any() else FailureMode.NONE


def _evidence(draft: Draft, bench: Bench) -> Evidence:
    """What the judgement of the first VB hit rests on, else that of the mark; the odometer where nothing else is."""
    kinds = [bench.offers.judged.kind[draft.hits[0]], bench.series.judged.kind[draft.episode.mark]]
    known = [KINDS[kind] for kind in kinds if kind >= 0]
    return known[0] if known else Evidence.ODOMETER


def _instants(draft: Draft, bench: Bench) -> dict[str, Any]:
    series, offers = bench.series, bench.offers
    episode, jump = draft.episode, draft.jump
    hazard_ns = int(offers.t_ns[draft.hits[0]] if jump is None else series.t_ns[jump.first])
    number = int(offers.number[draft.hits[0]] if jump is None else jump.first)
    failure_ns = None if episode.failure is None else int(series.t_ns[episode.failure])
    detected_ns, reaction = episode.detected_ns, reaction_s(bench.position_ns, bench.config)
    known_failure = failure_ns if episode.failure_known else None
    return {
        "t_onset": episode.onset_ns,
        "t_hazard": hazard_ns,
        "t_failure": failure_ns,
        "t_detected": detected_ns,
        "t_negated": None if detected_ns is None else detected_ns + round(reaction * NS_PER_S),
        "t_end": episode.end_ns,
        "monitor": episode.monitor,
        "detected": detected_ns is not None,
        "alarm_before_onset": episode.alarm_before_onset,
        "time_to_detect_s": _seconds(episode.onset_ns, detected_ns),
        "time_since_failure_s": _seconds(known_failure, detected_ns),
        **_place(int(series.row[number]), hazard_ns, bench),
    }


def _place(row: int, t_ns: int, bench: Bench) -> dict[str, Any]:
    """Where the train was at the hazard, and how fast it went; null where nobody knows."""
    direction, middle_m = int(bench.positions.direction[row]), float(bench.judged.middle_m[row])
    path_m = float(bench.path_m[row]) - direction * middle_m
    names, measures = bench.solution.path.locate(max(int(bench.positions.leg[row]), 0), path_m)
    return {
        "netelement_id": names[0],
        "measure_m": _known(float(measures[0])),
        "path_m": _known(path_m),
        "speed_mps": _known(float(bench.speed_at(np.array([t_ns]))[0])),
    }


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _budget(draft: Draft, bench: Bench) -> dict[str, Any]:
    episode, budget_s = draft.episode, bench.config.budget_s
    return {
        "hazardous_s": episode.hazardous_s,
        "hazardous_may_s": episode.hazardous_may_s,
        "budget_s": budget_s,
        "within_budget": within_budget(episode, bench.offers, budget_s),
    }


def _seconds(begin_ns: int | None, end_ns: int | None) -> float | None:
    return None if begin_ns is None or end_ns is None else (end_ns - begin_ns) / NS_PER_S
