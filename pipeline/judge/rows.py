"""Rows of `hazards` and of the failures, from episodes and what they hit (CONTRACT section 3)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl

from pipeline.evidence.evidence import KINDS
from pipeline.judge.bench import Bench, Offers
from pipeline.judge.episodes import Episode
from pipeline.judge.hazards import Draft, rate_mps, size_m
from pipeline.judge.judgement import UNKNOWN, WRONG
from pipeline.judge.states import reaction_s
from pipeline.judge.suspect import suspect_of
from schemas.arrays import NS_PER_S
from schemas.conform import dtypes
from schemas.enums import Evidence, FailureMode, Hazard, Timing
from schemas.stages import Failures
from schemas.tables import Hazards


def within_budget(episode: Episode, offers: Offers, budget_s: float) -> bool | None:
    """Whether an episode kept the allowed T_D: not where a VB was accepted wrong in it; null where nobody knows."""
    accepted = offers.judged.code[offers.accepted & episode.holds(offers.number)]
    if (accepted == WRONG).any() or episode.hazardous_s > budget_s:
        return False
    proved = episode.hazardous_may_s <= budget_s and not (accepted == UNKNOWN).any()
    return True if proved else None


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
    detected_ns, reaction = episode.detected_ns, reaction_s(bench.t_ns, bench.config)
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
