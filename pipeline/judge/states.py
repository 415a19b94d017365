"""What holds at each epoch: position in use, train moving, state of the reactive LDS (DOMAIN sections 4 and 5)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.epochs.clock import crossing_gap_ns, met, nominal_period_s, trusted
from pipeline.judge.judgement import RIGHT, WRONG, Judgements
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, runs_of, spans_of, times_ns
from schemas.config import Configuration, LdsConfig
from schemas.enums import LdsState

_STATES = tuple(LdsState)


def lds_states(epochs: pl.DataFrame, judged: Judgements, odometer_wrong: Bools) -> pl.Series:
    """P2 negated; P3 diagnosis faulty; P1 wrong and not negated; P0 right; null where the evidence cannot say."""
    state = np.full(epochs.height, len(_STATES))
    state[judged.code == RIGHT] = _STATES.index(LdsState.P0)
    state[judged.code == WRONG] = _STATES.index(LdsState.P1)
    state[flags(epochs, "diagnosis_faulty") | odometer_wrong] = _STATES.index(LdsState.P3)
    state[flags(epochs, "negated")] = _STATES.index(LdsState.P2)
    words = pl.Series("lds_state", [*(one.value for one in _STATES), None], dtype=pl.Enum(LdsState))
    return words.gather(state)


def odometer_beyond_confidence(
    t_ns: Ints, odometer_m: Floats, train_m: Floats, half_m: Floats, accepted_ns: Ints, lds: LdsConfig
) -> Bools:
    """The distance counted since the last accepted VB is wrong by more than 5 m + 5 % (SUBSET-041 5.3.1.1).

    `train_m`, `half_m`: path position by reference or balise reads and half its interval, NaN elsewhere: only these
    can say so. The whole interval has to say it.
    """
    beyond = np.zeros(t_ns.size, dtype=np.bool_)
    rows = np.flatnonzero(np.isfinite(odometer_m) & np.isfinite(train_m))
    last = np.searchsorted(accepted_ns, t_ns[rows], side="right") - 1
    rows, last = rows[last >= 0], last[last >= 0]
    if rows.size == 0:
        return beyond
    x = (t_ns[rows] - t_ns[rows[0]]).astype(np.float64)
    at = (accepted_ns[last] - t_ns[rows[0]]).astype(np.float64)
    since = (np.interp(at, x, values[rows]) for values in (odometer_m, train_m, half_m))
    counted_from, moved_from, half_from = since
    counted, moved = odometer_m[rows] - counted_from, train_m[rows] - moved_from
    allowed = lds.odometer_fixed_m + lds.odometer_share * np.abs(counted) + half_m[rows] + half_from
    beyond[rows] = np.abs(counted - moved) > allowed
    return beyond


def reaction_s(position_ns: Ints, config: Configuration) -> float:
    """From detection to negation [s]: as configured, else from one position to the next."""
    if config.hazards.reaction_s is not None:
        return config.hazards.reaction_s
    return nominal_period_s(position_ns) or 0.0


def in_use_s(epochs: pl.DataFrame, config: Configuration) -> Floats:
    """For how long each epoch stands for a position in use [s]: from the position before, for a fault may be that old.

    At most max(1.5 periods, `crossing_gap_s`), the first position for one period; of a negated time only what comes
    before the reaction. Epochs without a position stand for no time.
    """
    all_ns, known = times_ns(epochs), met(epochs, pl.col("path_m").is_not_null())
    t_ns = all_ns[known]
    period_s = nominal_period_s(t_ns) or 0.0
    all_s, end_s = ((times - all_ns[:1]) / NS_PER_S for times in (all_ns, t_ns))
    before_s = np.diff(end_s, prepend=end_s[:1] - period_s)
    begin_s = end_s - np.minimum(before_s, crossing_gap_ns(t_ns, config.lds) / NS_PER_S)
    blocked = np.zeros(t_ns.size)
    for from_s, until_s in _negated_spans(all_s, flags(epochs, "negated"), reaction_s(t_ns, config)):
        blocked += np.clip(np.minimum(end_s, until_s) - np.maximum(begin_s, from_s), 0.0, None)
    held = np.zeros(all_ns.size)
    left_s = end_s - begin_s - blocked
    held[known] = np.where(left_s > 0.5 / NS_PER_S, left_s, 0.0)
    used: Floats = np.where(met(epochs, trusted(config)), held, 0.0)
    return used


def _negated_spans(t_s: Floats, negated: Bools, delay_s: float) -> list[tuple[float, float]]:
    """From each detection plus the reaction to the return [s]."""
    firsts, lasts = runs_of(negated)
    until = np.append(t_s, np.inf)[lasts + 1]
    return list(zip((t_s[firsts] + delay_s).tolist(), until.tolist(), strict=True))


def stood_spans(
    t_ns: Ints, path_m: Floats, odometer_moves: Bools, known: Bools, limit_m: float
) -> list[tuple[int, int]]:
    """Times in which the odometer stood while positions left their place by more than the limit [ns].

    `odometer_moves`: per epoch, up to the next one; `known`: where it says anything. Whether the train moved there
    nobody knows by the odometer.
    """
    found = []
    for first, last in spans_of(known & ~odometer_moves):
        rows = slice(first, min(last + 2, t_ns.size))
        places = path_m[rows][np.isfinite(path_m[rows])]
        if places.size and float(np.abs(places - places[0]).max()) > limit_m:
            found.append((int(t_ns[rows][0]), int(t_ns[rows][-1])))
    return found


def held_on(steps: Bools, size: int) -> Bools:
    """What holds from each epoch to the next; nothing follows upon the last one, which stays as it was before."""
    last = steps[-1:] if steps.size else np.zeros(1, dtype=np.bool_)
    return np.concatenate([steps, last])[:size]
