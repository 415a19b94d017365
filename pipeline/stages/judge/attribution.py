"""Which component is suspected (DOMAIN section 5.5): an opinion, only the column `suspect` depends on it."""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.stages.judge.judgement import ODOMETER, Judgements, margins_m
from schemas.arrays import NS_PER_S, Floats, floats, times_ns
from schemas.config import Configuration
from schemas.enums import Suspect


def suspect_of(epochs: pl.DataFrame, begin_ns: int, end_ns: int, config: Configuration) -> Suspect:
    """The decision table, from `suspect_lookback_s` before an alarm or hazard to its end; the first row that applies.

    | row | evidence | suspect |
    |---|---|---|
    | 1 | the position left what reference or reads leave | gnss |
    | 2 | the odometer is contradicted, or position and Doppler part from it together | odometer |
    | 3 | the position left the odometer since a VB | gnss |
    | 4 | the match was ambiguous | track |
    | 5 | else | unknown |

    The map is found over several runs (`pipeline/results/figures/map_errors.py`).
    """
    t_ns = times_ns(epochs)
    first = int(np.searchsorted(t_ns, begin_ns - round(config.hazards.suspect_lookback_s * NS_PER_S)))
    part = epochs[first : max(first, int(np.searchsorted(t_ns, end_ns, side="right")))]
    judged = Judgements.of(part)
    margin_m = margins_m(floats(part, "sigma_along_m"), config.hazards)
    with np.errstate(invalid="ignore"):
        left = (judged.least_m > margin_m) | judged.wrong_track
    if (left & (judged.kind != ODOMETER)).any():
        return Suspect.GNSS
    if (part["stood"] | part["odometer_wrong"]).any() or _parted_together(part, margin_m, config):
        return Suspect.ODOMETER
    if left.any():
        return Suspect.GNSS
    ambiguous = part["path_m"].is_not_null() & ~part["unambiguous"]
    return Suspect.TRACK if ambiguous.any() else Suspect.UNKNOWN


def _parted_together(part: pl.DataFrame, margin_m: Floats, config: Configuration) -> bool:
    """Position and Doppler agree with each other where both left the odometer, by half the margin of the position."""
    path_m = floats(part, "path_m")
    odometer_m = floats(part, "odometer_m")
    velocity_mps = floats(part, "velocity_along_mps")
    known = np.flatnonzero(np.isfinite(path_m) & np.isfinite(odometer_m) & np.isfinite(velocity_mps))
    if known.size < 2:
        return False
    dt_s = np.diff(times_ns(part)[known]) / NS_PER_S
    mean_mps = 0.5 * (velocity_mps[known][1:] + velocity_mps[known][:-1])
    near = dt_s <= config.monitors.doppler_gap_s
    doppler_m = np.concatenate([[0.0], np.cumsum(np.where(near, mean_mps * dt_s, 0.0))])
    position_m = path_m[known] - path_m[known[0]]
    odometer_m = odometer_m[known] - odometer_m[known[0]]
    margin_m = 0.5 * margin_m[known]
    both = (np.abs(position_m - odometer_m) > margin_m) & (np.abs(doppler_m - odometer_m) > margin_m)
    return bool((both & (np.abs(position_m - doppler_m) <= margin_m)).any())
