"""Hazard rows: jumps, shifts and wrong tracks, judged on offered virtual balises (DOMAIN section 5.3)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from pipeline.judge.bench import Bench, Offers, Series
from pipeline.judge.episodes import Episode
from pipeline.judge.judgement import WRONG
from pipeline.judge.jumps import Jump
from schemas.config import HazardConfig
from schemas.enums import Hazard


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
