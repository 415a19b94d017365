"""Where the speeds of an odometer contradict its distance: one of the two is wrong, and nobody knows which."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from schemas.arrays import Bools, Floats, spans_of
from schemas.config import AlignConfig


class Contradiction(NamedTuple):
    """Per step: in a run that the speeds contradict; by how much [m]; what of that is known by then, all at once."""

    steps: Bools
    off_m: Floats
    doubt_m: Floats


def contradicted_by_speeds(
    t_s: Floats, recorded_m: Floats, driven_m: Floats, rows_m: Floats, deadband_mps: float, config: AlignConfig
) -> Contradiction:
    """Runs of rows over which speeds (`driven_m`) and distance (`recorded_m`, per step) part by more than a leap.

    `rows_m`: what the noise of two rows makes of a distance, as known at each. A second before each row counts: more
    than `speed_agreement` of the way, the dead band and that. A run counts where it sums up to `leap_m` beside the
    same. Speeds that never agreed with the distance contradict nothing.
    """
    both = np.isfinite(recorded_m) & np.isfinite(driven_m)
    recorded_sum_m, driven_sum_m, way_m = (
        np.concatenate([[0.0], np.cumsum(np.where(both, values, 0.0))])
        for values in (recorded_m, driven_m, np.maximum(np.abs(recorded_m), np.abs(driven_m)))
    )
    share = config.speed_agreement
    agreed = (way_m >= config.leap_m / share) & (np.abs(driven_sum_m - recorded_sum_m) <= share * way_m)
    before = np.searchsorted(t_s, t_s - config.speed_window_s * (1.0 + 1e-9))
    apart_m = np.abs((driven_sum_m - recorded_sum_m) - (driven_sum_m - recorded_sum_m)[before])
    allowed_m = share * (way_m - way_m[before]) + deadband_mps * (t_s - t_s[before]) + rows_m
    parts = (apart_m > allowed_m) & np.concatenate([[False], both])
    found = Contradiction(np.zeros(both.size, dtype=np.bool_), *np.zeros((2, both.size)))
    for first, last in spans_of(parts):
        run = slice(int(before[first]), last)
        if not agreed[run.start]:
            continue
        so_far_m = np.abs(np.cumsum(np.where(both, driven_m - recorded_m, 0.0)[run]))
        allowed_so_far_m = config.leap_m + rows_m[run] + share * np.cumsum(np.diff(way_m[run.start : last + 1]))
        beyond = np.flatnonzero(so_far_m > allowed_so_far_m)
        if beyond.size:
            found.steps[run] = True
            found.off_m[run] = np.abs(np.diff(np.concatenate([[0.0], so_far_m])))
            # Known at the row where it is too much: from there on each step as it comes.
            at = run.start + int(beyond[0])
            found.doubt_m[at] = so_far_m[beyond[0]]
            found.doubt_m[at + 1 : last] = found.off_m[at + 1 : last]
    return found
