"""A stretch: increments that the bank saw one after the other, and the bound that a split of them among the monitors
gives.

The fault's growth over a stretch is the sum of gain_s (y - u). Split each row's gain_s among the monitors, however:
what falls to an average is, by the average's own recursion, a sum over that average's values, and each of these is
within its threshold. So *every* split bounds the growth from above (weak duality), and the best split gives the largest
growth itself.

With q_i the part of row i that falls to an average A_i = (1 - w_i) A_(i-1) + w_i y_i:

    sum q_i y_i = sum A_i (q_i / w_i - q_(i+1) (1 - w_(i+1)) / w_(i+1))  -  A_0 q_1 (1 - w_1) / w_1
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipeline.studies.undetected.watched import Watched
from schemas.arrays import Floats
from schemas.frozen import frozen


@frozen
class GrowthStretch:
    """`watched`: the rows after a start, to be bounded one by one.

    `start_mps` (averages,): the averages at the start; `start_free_mps`: how far they may be from that.
    """

    watched: Watched
    start_mps: Floats
    start_free_mps: Floats

    @property
    def count(self) -> int:
        """How many rows."""
        return self.watched.count

    def first_rows(self, rows: int) -> GrowthStretch:
        """Its first rows alone."""
        return replace(self, watched=self.watched.rows_between(0, rows))

    @property
    def recorded_m(self) -> Floats:
        """What the increments recorded have gathered up to each row."""
        return np.cumsum(self.watched.gain_s * self.watched.rate_mps)


def stretch_after(rows: Watched, start: int, end: int, known: bool) -> GrowthStretch:
    """The rows (start, end]; without `known` the averages at the start are only known to be within their thresholds."""
    averages = rows.average_mps[start]
    thresholds = rows.threshold_mps[start]
    nothing = np.zeros_like(averages)
    watched = rows.rows_between(start + 1, end + 1)
    if known or rows.fresh[start]:
        return GrowthStretch(watched, averages, nothing)
    return GrowthStretch(watched, nothing, thresholds)


def payments_m(stretch: GrowthStretch, shares: Floats) -> Floats:
    """What raw (first) and each average pay for the sum of gain_s y up to each row; shapes (rows, 1 + averages).

    `shares`: of each row, raw first; they add up to one. The sum up to a row ends there: what the last row gives to an
    average is paid by its value there.
    """
    watched = stretch.watched
    raw = watched.gain_s * np.where(shares[:, 0] > 0.0, watched.most_mps, watched.least_mps) * shares[:, 0]
    part = shares[:, 1:] * (watched.gain_s[:, None] / watched.weight)
    # Each value A_i is paid once: |q_i / w_i - q_(i+1) (1 - w_(i+1)) / w_(i+1)| times its threshold.
    before = part * (1.0 - watched.weight)
    inside = part.copy()
    inside[:-1] -= before[1:]
    inner = _cost_m(inside, watched.threshold_mps)
    paid = _cost_m(part, watched.threshold_mps)
    paid[1:] += np.cumsum(inner[:-1], axis=0)
    paid += np.abs(before[0]) * stretch.start_free_mps - before[0] * stretch.start_mps
    return np.column_stack([np.cumsum(raw), paid])


def _cost_m(part: Floats, threshold: Floats) -> Floats:
    """|part| times the threshold; what falls to no one costs nothing, even where nothing is tested."""
    cost: Floats = np.abs(part) * np.where(part == 0.0, 0.0, threshold)
    return cost
