"""The state of the reactive LDS per epoch (DOMAIN section 4; TVB section 4)."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.judge.judgement import RIGHT, WRONG, Judgements
from schemas.arrays import Bools, Floats, Ints, flags
from schemas.config import LdsConfig
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
