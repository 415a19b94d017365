"""An opinion on who was at fault (DOMAIN section 5.5). Nothing but the column `suspect` depends on it."""

from __future__ import annotations

import numpy as np

from pipeline.evidence.evidence import KINDS, within_spans
from pipeline.judge.bench import Bench
from schemas.arrays import NS_PER_S, Ints, floats
from schemas.enums import Evidence, Suspect


def suspect_of(bench: Bench, begin_ns: int, end_ns: int) -> Suspect:
    """The decision table, from `suspect_lookback_s` before the alarm or hazard to its end; the first row that applies.

    | row | evidence | suspect |
    |---|---|---|
    | 1 | the position left what reference or reads leave | gnss |
    | 2 | the odometer is contradicted, or position and Doppler part from it together | odometer |
    | 3 | the position left the odometer since a VB | gnss |
    | 4 | the match was ambiguous | track |
    | 5 | else | unknown |

    The map is found over several runs (`pipeline/figures/map_errors.py`).
    """
    first = int(np.searchsorted(bench.t_ns, begin_ns - round(bench.config.hazards.suspect_lookback_s * NS_PER_S)))
    rows = np.arange(first, max(first, int(np.searchsorted(bench.t_ns, end_ns, side="right"))))
    judged = bench.judged.take(rows)
    with np.errstate(invalid="ignore"):
        left = (judged.least_m > bench.margin_m[rows]) | judged.wrong_track
    if (left & (judged.kind != KINDS.index(Evidence.ODOMETER))).any():
        return Suspect.GNSS
    stood = within_spans(bench.at_ns[rows], bench.stood)
    if (stood | bench.odometer_wrong[rows]).any() or _parted_together(bench, rows):
        return Suspect.ODOMETER
    if left.any():
        return Suspect.GNSS
    ambiguous = np.isfinite(bench.path_m) & ~bench.positions.unambiguous
    return Suspect.TRACK if ambiguous[rows].any() else Suspect.UNKNOWN


def _parted_together(bench: Bench, rows: Ints) -> bool:
    """Position and Doppler agree with each other where both left the odometer, by half the margin of the position."""
    path_m, odometer_m = bench.path_m[rows], floats(bench.epochs, "odometer_m")[rows]
    velocity_mps = floats(bench.epochs, "velocity_along_mps")[rows]
    known = np.flatnonzero(np.isfinite(path_m) & np.isfinite(odometer_m) & np.isfinite(velocity_mps))
    if known.size < 2:
        return False
    dt_s = np.diff(bench.t_ns[rows][known]) / NS_PER_S
    mean_mps = 0.5 * (velocity_mps[known][1:] + velocity_mps[known][:-1])
    near = dt_s <= bench.config.monitors.doppler_gap_s
    doppler_m = np.concatenate([[0.0], np.cumsum(np.where(near, mean_mps * dt_s, 0.0))])
    position_m, odometer_m = path_m[known] - path_m[known[0]], odometer_m[known] - odometer_m[known[0]]
    margin = 0.5 * bench.margin_m[rows][known]
    both = (np.abs(position_m - odometer_m) > margin) & (np.abs(doppler_m - odometer_m) > margin)
    return bool((both & (np.abs(position_m - doppler_m) <= margin)).any())
