"""The step of a counter, as its rows up to each row show it: what feeds detection knows nothing of later rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl

from pipeline.stages.odometry.written_steps import FEWEST_BENDS, multiples_of
from schemas.arrays import Bools, Floats
from schemas.config import AlignConfig

# Less is rounding of decimal numbers, which are not whole in binary; far below any `counter_step_m`.
_ROUNDED_M = 1e-3
# Numerics: ways before each that show what is usual, and that are looked at first.
_USUAL_ROWS, _NEAR_ROWS = 100, 200


class CountStep(NamedTuple):
    """The step of the counter as known at each row [m], 0 where none is; `shown`: a step would have shown by then.

    Of a counter that stands, or moves on evenly, nothing is to be seen, and nothing scatters.
    """

    step_m: Floats
    shown: Bools


def count_step(distance_m: Floats, config: AlignConfig) -> CountStep:
    """Rows without a distance (NaN) know what the last one did.

    All usual ways so far are multiples of the step, one is a single step; 0 where there is none, or one finer than
    `counter_step_m`. Ways that no train drives do not count: beside those before them they are leaps.
    """
    rows = np.flatnonzero(np.isfinite(distance_m))
    known = CountStep(np.zeros(distance_m.size), np.ones(distance_m.size, dtype=np.bool_))
    if rows.size < 2:
        return known
    ways_m = np.abs(np.diff(distance_m[rows]))
    usual = np.flatnonzero(_usual(ways_m, config))
    last = np.searchsorted(rows[usual + 1], np.arange(distance_m.size), side="right") - 1
    after = last >= 0
    known.step_m[after] = _steps_known_m(ways_m[usual], config.counter_step_m)[last[after]]
    known.shown[after] = _shown(ways_m[usual])[last[after]]
    return known


def _shown(ways_m: Floats) -> Bools:
    """Ways differ from those before them as often as makes a step, or never; or so many were the same under way."""
    written = np.rint(ways_m / _ROUNDED_M)
    bent = np.concatenate([[False], np.diff(written) != 0.0])
    bends = np.cumsum(bent)
    since_bend = np.arange(written.size) - np.maximum.accumulate(np.where(bent, np.arange(written.size), 0))
    even = np.logical_or.accumulate((since_bend >= FEWEST_BENDS) & (written > 0.0))
    shown: Bools = (bends == 0) | (bends >= FEWEST_BENDS) | even
    return shown


def _usual(ways_m: Floats, config: AlignConfig) -> Bools:
    medians_m = pl.Series(ways_m).rolling_median(_USUAL_ROWS, min_samples=1).to_numpy()
    usual: Bools = ways_m <= config.bunched_stamps_m + 2.0 * np.concatenate([[0.0], medians_m[:-1]])
    return usual


def _steps_known_m(ways_m: Floats, least_m: float) -> Floats:
    """Of which step all ways up to each are multiples; 0 where there is none [m]."""
    single_m = np.minimum.accumulate(np.where(ways_m > _ROUNDED_M, ways_m, np.inf))
    begins = np.flatnonzero(single_m < np.concatenate([[np.inf], single_m[:-1]]))
    steps_m = np.zeros(ways_m.size)
    ends = np.append(begins[1:], ways_m.size)
    for begin, end in zip(begins.tolist(), ends[: begins.size].tolist(), strict=True):
        step_m = float(single_m[begin])
        if step_m < least_m:
            break
        # The last ways first: where the smallest way shrinks row by row, all of them would be looked at each time.
        if multiples_of(ways_m[max(begin - _NEAR_ROWS, 0) : begin + 1], step_m)[1].all():
            steps_m[begin:end] = np.where(_is_step(ways_m[:end], step_m)[begin:], step_m, 0.0)
    return steps_m


def _is_step(ways_m: Floats, step_m: float) -> Bools:
    """Whether all ways up to each are multiples, of which enough differ from the one before."""
    counts, multiples = multiples_of(ways_m, step_m)
    bends = np.concatenate([[0], np.cumsum(np.diff(counts) != 0.0)])
    shown: Bools = np.logical_and.accumulate(multiples) & (bends >= FEWEST_BENDS)
    return shown
