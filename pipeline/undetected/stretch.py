"""A stretch: increments that the bank saw one after the other, and the bound that a way of paying for them gives.

The fault's growth over a stretch is the sum of way_s (y - u). Split each row's way_s among the monitors, in any way:
what falls to an average is, by the average's own recursion, a sum over that average's values, and each of these is
within its threshold. So *every* split bounds the growth from above (weak duality), and the best split gives the largest
growth itself.

With q_i the part of row i that falls to an average A_i = (1 - w_i) A_(i-1) + w_i y_i:

    sum q_i y_i = sum A_i (q_i / w_i - q_(i+1) (1 - w_(i+1)) / w_(i+1))  -  A_0 q_1 (1 - w_1) / w_1
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from pipeline.undetected.watched import Watched
from schemas.arrays import Floats


@dataclass(frozen=True)
class Stretch:
    """Rows after a start, to be bounded one by one; shapes (n,) and (n, averages), as in `Watched`.

    `start_mps` (averages,): the averages at the start; `start_free_mps`: how far they may be from that.
    """

    way_s: Floats
    rate_mps: Floats
    least_mps: Floats
    most_mps: Floats
    weight: Floats
    threshold_mps: Floats
    start_mps: Floats
    start_free_mps: Floats

    @property
    def rows(self) -> int:
        return self.way_s.size

    def first(self, rows: int) -> Stretch:
        whole = ("start_mps", "start_free_mps")
        return Stretch(
            **{
                item.name: getattr(self, item.name)[slice(None) if item.name in whole else slice(rows)]
                for item in fields(self)
            }
        )

    @property
    def recorded_m(self) -> Floats:
        """What the increments recorded have gathered up to each row."""
        return np.cumsum(self.way_s * self.rate_mps)


def stretch_after(rows: Watched, start: int, end: int, known: bool) -> Stretch:
    """The rows (start, end]; without `known` the averages at the start are only known to have been silent."""
    part = slice(start + 1, end + 1)
    averages = rows.average_mps[start]
    known = known or bool(rows.fresh[start])
    return Stretch(
        way_s=rows.way_s[part],
        rate_mps=rows.rate_mps[part],
        least_mps=rows.least_mps[part],
        most_mps=rows.most_mps[part],
        weight=rows.weight[part],
        threshold_mps=rows.threshold_mps[part],
        start_mps=averages if known else np.zeros_like(averages),
        start_free_mps=np.zeros_like(averages) if known else rows.threshold_mps[start],
    )


def paid_m(stretch: Stretch, shares: Floats) -> Floats:
    """What raw (first) and each average pay for the sum of way_s y up to each row; shapes (rows, 1 + averages).

    `shares`: of each row, raw first; they add up to one. The sum up to a row ends there: what the last row gives to an
    average is paid by its value there.
    """
    raw = stretch.way_s * np.where(shares[:, 0] > 0.0, stretch.most_mps, stretch.least_mps) * shares[:, 0]
    part = shares[:, 1:] * (stretch.way_s[:, None] / stretch.weight)
    before = part * (1.0 - stretch.weight)
    inside = part.copy()
    inside[:-1] -= before[1:]
    inner = _cost(inside, stretch.threshold_mps)
    paid = _cost(part, stretch.threshold_mps)
    paid[1:] += np.cumsum(inner[:-1], axis=0)
    paid += np.abs(before[0]) * stretch.start_free_mps - before[0] * stretch.start_mps
    return np.column_stack([np.cumsum(raw), paid])


def _cost(part: Floats, threshold: Floats) -> Floats:
    """|part| times the threshold; what falls to no one costs nothing, even where nothing is tested."""
    cost: Floats = np.abs(part) * np.where(part == 0.0, 0.0, threshold)
    return cost
