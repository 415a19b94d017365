"""Positions that a log repeats at a higher rate than the receiver tells them: copies, no epochs.

In: positions of one solution in order of time. Out: which rows are copies. A receiver has a period of its own, the
usual time between two different positions. A row that repeats the one before within that period is a copy. What
repeats for longer stays: a frozen receiver is judged as what it is, once per period.
"""

from __future__ import annotations

import numpy as np

from schemas.arrays import Bools, Floats, median

# Numerics of the reading: with fewer updates no period is known; a regular one is met, to a logged step, by so many of
# the updates. Digits that repeat at low speed are not: their time changes with the speed.
_FEWEST = 20
_REGULAR_SHARE = 0.8
_LEAST_RATIO = 1.5
_STEP_NOISE = 1.2


def copies(t_s: Floats, latitude_deg: Floats, longitude_deg: Floats) -> Bools:
    """Rows [s, deg] that repeat the place of the row before within one period of the receiver."""
    none: Bools = np.zeros(t_s.size, dtype=np.bool_)
    same = np.append(False, (np.diff(latitude_deg) == 0.0) & (np.diff(longitude_deg) == 0.0))
    updates = t_s[~same & np.isfinite(latitude_deg)]
    if not same.any() or updates.size < _FEWEST:
        return none
    step_s = median(np.diff(t_s))
    apart_s = np.diff(updates)
    period_s = median(apart_s)
    regular = np.mean(np.abs(apart_s - period_s) <= _STEP_NOISE * step_s)
    if period_s < _LEAST_RATIO * step_s or regular < _REGULAR_SHARE:
        return none
    kept_s = -np.inf
    for row in range(t_s.size):
        none[row] = same[row] and t_s[row] - kept_s < period_s - step_s / 2.0
        kept_s = kept_s if none[row] else t_s[row]
    return none
