"""The largest error ahead at every row since the last independent fix, over resets, re-links and tests of the position.

Growth over stretches adds up. Where the bank began anew the fault may have changed unobserved; a re-link bounds it
against its anchor; a monitor without memory bounds it outright, there and, with the growth since, for a while after.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipeline.studies.undetected.splits import BoundedGrowth, best_shares, bound_growth, split_horizons
from pipeline.studies.undetected.stretch import GrowthStretch, stretch_after
from pipeline.studies.undetected.watched import NO_ROW, Watched
from schemas.arrays import Bools, Floats, Ints
from schemas.config import UndetectedConfig
from schemas.frozen import frozen

Grow = Callable[[GrowthStretch], BoundedGrowth]
# How many rows to look back over, and the split of these rows.
After = list[tuple[int, Floats]]


@frozen
class Errors:
    """The largest error ahead at each row [m], and what bounds it: `paid_m` (rows, 1 + averages), or `outright`."""

    most_m: Floats
    paid_m: Floats
    outright: Bools


def largest_errors(
    window: Watched, config: UndetectedConfig, grow: Grow = bound_growth, after: After | None = None
) -> Errors:
    """The largest error ahead at all rows but the first, of a fault that began after the first (`Watched.since`).

    `grow`: bound of the growth over a stretch; `after`: splits to look back at tests of the position with, by default
    the best ones here; any of them is a bound.
    """
    most = np.zeros(window.count)
    paid = np.zeros((window.count, 1 + window.weight.shape[1]))
    outright = np.zeros(window.count, dtype=np.bool_)
    after_level = _after_tests_m(window, splits_after_tests(window, config) if after is None else after)
    begins = [0, *(1 + np.flatnonzero(window.fresh[1:] | window.free[1:])).tolist()]
    for begin, beyond in zip(begins, [*begins[1:], window.count], strict=True):
        if begin:
            most[begin] = min(_error_across_m(window, begin, most), after_level[begin])
            outright[begin] = after_level[begin] == most[begin]
        if begin + 1 < beyond:
            growth = grow(stretch_after(window, begin, beyond - 1, known=begin == 0))
            part = slice(begin + 1, beyond)
            learned = np.cumsum(window.learned_m[part]) + window.learned_late_m[part]
            grown = most[begin] + (window.learned_late_m[begin] if begin else 0.0) + growth.most_m + learned
            paid[part] = growth.paid_m
            outright[part] = after_level[part] < grown
            most[part] = np.minimum(grown, after_level[part])
    return Errors(most[1:], paid[1:], outright[1:])


def _error_across_m(window: Watched, row: int, most_m: Floats) -> float:
    """The error [m] that a fault may have at a row to which the bank saw no increment, or at a re-link inside one."""
    if window.fresh[row]:
        unobserved_m = float(window.fastest_m[row])
    else:
        stretch = stretch_after(window, row - 1, row, known=row == 1)
        unobserved_m = float(bound_growth(stretch).most_m[0]) + _hidden_by_learning_m(window, row)
    anchor = window.anchor[row]
    at_anchor = float(most_m[anchor]) if anchor != NO_ROW else 0.0
    return min(float(most_m[row - 1]) + unobserved_m, at_anchor + float(window.held_high_m[row]))


def _hidden_by_learning_m(window: Watched, row: int) -> float:
    """What learned scale and latency may hide over the step to a row [m]."""
    late_m = window.learned_late_m[row] + (window.learned_late_m[row - 1] if row > 1 else 0.0)
    return float(window.learned_m[row] + late_m)


def _after_tests_m(window: Watched, splits: After) -> Floats:
    """What tests of the position itself leave at each row [m]: their own bound, or one before and the growth since."""
    best = window.high_m.copy()
    best[0] = np.inf
    for lag, shares in splits:
        begins = np.flatnonzero(np.isfinite(window.high_m[:-lag]))
        begins = begins[(begins > 0) & _are_unbroken(window, begins, lag)]
        if begins.size:
            grown = _growth_over_m(window, begins, lag, shares)
            np.minimum.at(best, begins + lag, window.high_m[begins] + grown)
    return best


def _are_unbroken(window: Watched, begins: Ints, lag: int) -> Bools:
    """Whether the bank did not begin anew within `lag` rows after each of these."""
    broken = np.cumsum(window.fresh)
    unbroken: Bools = broken[begins + lag] == broken[begins]
    return unbroken


def splits_after_tests(window: Watched, config: UndetectedConfig) -> After:
    """Splits for stretches whose averages at the start are not known, as a longest stretch in the middle has them."""
    if not np.isfinite(window.high_m[1:]).any():
        return []
    first, last = window.longest_stretch
    period_s = max(float(np.median(np.diff(window.t_s[first : last + 1]))) if last > first else 1.0, 1e-3)
    most = min(last - first - 1, int(config.look_back_s / period_s))
    middle = (first + last - most) // 2
    lags = [1, *split_horizons(most)] if most > 0 else []
    return [(lag, best_shares(stretch_after(window, middle, middle + lag, known=False))) for lag in lags]


def _growth_over_m(window: Watched, begins: Ints, lag: int, shares: Floats) -> Floats:
    """Growth of a fault [m] from each of the rows `begins` over `lag` rows, with one split `shares` for all.

    Shape (begins,). The averages at the start are not known, so they count with their thresholds.
    """
    total = np.zeros(begins.size)
    threshold = np.where(window.fresh[begins, None], 0.0, window.threshold_mps[begins])
    carried = np.zeros_like(threshold)  # part of the row after, as it falls to the averages here
    for row in range(lag, 0, -1):
        at = begins + row
        gain_s = window.gain_s[at]
        weight = window.weight[at]
        raw = shares[row - 1, 0]
        total += gain_s * raw * (window.most_mps[at] if raw > 0.0 else window.least_mps[at])
        part = shares[row - 1, 1:] * gain_s[:, None] / weight
        total += (np.abs(part - carried) * window.threshold_mps[at]).sum(axis=1)
        carried = part * (1.0 - weight)
        total -= gain_s * window.rate_mps[at]
        total += window.learned_m[at]
    total += (np.abs(carried) * threshold).sum(axis=1)
    return total + window.learned_late_m[begins] + window.learned_late_m[begins + lag]
