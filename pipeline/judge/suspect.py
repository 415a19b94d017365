"""An opinion on who was at fault (DOMAIN section 5.5). Nothing but the column `suspect` depends on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.evidence.evidence import KINDS
from pipeline.judge.judgement import Judgements
from schemas.arrays import NS_PER_S, Bools, Floats, Ints
from schemas.enums import Evidence, Suspect


@dataclass(frozen=True)
class Witnesses:
    """All epochs of a solution; NaN where a witness says nothing.

    `margin_m`: errors below it are those of a healthy position. `contradicted`: the odometer is, by reference, reads
    or its own standing. Velocities farther apart than `doppler_gap_s` do not tell the way between them.
    """

    t_ns: Ints
    judged: Judgements
    margin_m: Floats
    path_m: Floats
    odometer_m: Floats
    velocity_mps: Floats
    contradicted: Bools
    ambiguous: Bools
    lookback_s: float
    doppler_gap_s: float


def suspect_of(w: Witnesses, begin_ns: int, end_ns: int) -> Suspect:
    """The decision table, from `lookback_s` before the alarm or hazard to its end; the first row that applies.

    | row | evidence | suspect |
    |---|---|---|
    | 1 | the position left what reference or reads leave | gnss |
    | 2 | the odometer is contradicted, or position and Doppler part from it together | odometer |
    | 3 | the position left the odometer since a VB | gnss |
    | 4 | the match was ambiguous | track |
    | 5 | else | unknown |

    The map is found over several runs (`pipeline/figures/map_errors.py`).
    """
    first = int(np.searchsorted(w.t_ns, begin_ns - round(w.lookback_s * NS_PER_S)))
    rows = np.arange(first, max(first, int(np.searchsorted(w.t_ns, end_ns, side="right"))))
    with np.errstate(invalid="ignore"):
        left = (w.judged.least_m[rows] > w.margin_m[rows]) | w.judged.wrong_track[rows]
    by_odometer = w.judged.kind[rows] == KINDS.index(Evidence.ODOMETER)
    if (left & ~by_odometer).any():
        return Suspect.GNSS
    if w.contradicted[rows].any() or _parted_together(w, rows):
        return Suspect.ODOMETER
    if left.any():
        return Suspect.GNSS
    return Suspect.TRACK if w.ambiguous[rows].any() else Suspect.UNKNOWN


def _parted_together(w: Witnesses, rows: Ints) -> bool:
    """Position and Doppler agree with each other where both left the odometer, by half the margin of the position."""
    known = rows[np.isfinite(w.path_m[rows]) & np.isfinite(w.odometer_m[rows]) & np.isfinite(w.velocity_mps[rows])]
    if known.size < 2:
        return False
    dt_s = np.diff(w.t_ns[known]) / NS_PER_S
    mean_mps = 0.5 * (w.velocity_mps[known][1:] + w.velocity_mps[known][:-1])
    doppler_m = np.concatenate([[0.0], np.cumsum(np.where(dt_s <= w.doppler_gap_s, mean_mps * dt_s, 0.0))])
    position_m, odometer_m = w.path_m[known] - w.path_m[known[0]], w.odometer_m[known] - w.odometer_m[known[0]]
    margin = 0.5 * w.margin_m[known]
    both = (np.abs(position_m - odometer_m) > margin) & (np.abs(doppler_m - odometer_m) > margin)
    return bool((both & (np.abs(position_m - doppler_m) <= margin)).any())
