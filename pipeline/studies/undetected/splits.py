"""By how much a fault can have grown over a stretch: the best split among the monitors, and what it lets pass.

The split is found on blocks of rows that grow with the time since the start.

Thresholds change slowly, and so do the best shares: within a block they are straight lines. The bound that they give is
evaluated on every row (`paid_m`), so blocks cost closeness, never validity.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from pipeline.studies.undetected.stretch import GrowthStretch, payments_m
from schemas.arrays import Floats, Ints
from schemas.frozen import frozen

# Blocks are so much longer than the stretch before them; so much farther on lies the next row with a split of its own.
GROWTH = 0.3
# Nothing is infinite in a program: a monitor that is not evaluated costs so many times the dearest that is.
_NOT_TESTED = 1e3


class _Blocks(NamedTuple):
    """First and last row of each block, and which block each row is in."""

    first: Ints
    last: Ints
    of_row: Ints

    @classmethod
    def of_rows(cls, rows: int) -> _Blocks:
        """Blocks over so many rows, each longer than the one before."""
        edges = [0]
        while edges[-1] < rows:
            edges.append(min(edges[-1] + max(1, int(GROWTH * edges[-1])), rows))
        first = np.array(edges[:-1])
        end = np.array(edges[1:])
        return cls(first, end - 1, np.repeat(np.arange(first.size), end - first))

    def weights_at(self, row: Ints) -> Floats:
        """What the shares at both ends of the blocks, two columns each, are at these rows: straight lines between."""
        block = self.of_row[row]
        each = np.arange(row.size)
        along = (row - self.first[block]) / np.maximum(self.last[block] - self.first[block], 1)
        weights = np.zeros((row.size, 2 * self.first.size))
        weights[each, 2 * block] = 1.0 - along
        weights[each, 2 * block + 1] = along
        return weights


def best_shares(stretch: GrowthStretch) -> Floats:
    """Shares of raw and averages in each row, shape (rows, 1 + averages), that give the least bound at the last row."""
    from scipy.linalg import block_diag  # most replays solve nothing
    from scipy.optimize import linprog

    blocks = _Blocks.of_rows(stretch.count)
    monitors = 1 + stretch.watched.weight.shape[1]
    ends = 2 * blocks.first.size
    parts = [_raw_cost(stretch, blocks), *(_average_cost(stretch, blocks, average) for average in range(monitors - 1))]
    costs = np.concatenate([part.cost for part in parts])
    linear = np.concatenate([part.linear for part in parts])
    gauge = max(float(costs.max()), 1e-12)
    each = np.eye(costs.size)
    # Each term is what it has above zero less what it has below; shares add up to one at both ends of each block.
    whole = np.tile(np.eye(ends), monitors)
    nothing = np.zeros((ends, 2 * costs.size))
    optimum = linprog(
        np.concatenate([linear, costs, costs]) / gauge,
        A_eq=np.block([[block_diag(*(part.terms for part in parts)), -each, each], [whole, nothing]]),
        b_eq=np.concatenate([np.zeros(costs.size), np.ones(ends)]),
        bounds=np.array([(-np.inf, np.inf)] * (monitors * ends) + [(0.0, np.inf)] * (2 * costs.size)),
        method="highs-ds",
    )
    knots = optimum.x[: monitors * ends].reshape(monitors, ends) if optimum.status == 0 else np.zeros((monitors, ends))
    shares: Floats = blocks.weights_at(np.arange(stretch.count)) @ knots.T
    # They add up to one, to the last digit.
    shares[:, 0] += 1.0 - shares.sum(axis=1)
    return shares


class _MonitorCost(NamedTuple):
    """Of one monitor: what is paid for, over its shares at both ends of the blocks; the cost of each; the start's."""

    terms: Floats
    cost: Floats
    linear: Floats


def _raw_cost(stretch: GrowthStretch, blocks: _Blocks) -> _MonitorCost:
    """What the monitor of raw differences costs a fault, split between both ends of each block."""
    raw_mps = np.maximum(np.abs(stretch.watched.most_mps), np.abs(stretch.watched.least_mps))
    raw_m = np.add.reduceat(stretch.watched.gain_s * _priced_thresholds(raw_mps), blocks.first)
    single = blocks.first == blocks.last
    cost = np.column_stack([np.where(single, raw_m, 0.5 * raw_m), np.where(single, 0.0, 0.5 * raw_m)]).ravel()
    return _MonitorCost(np.eye(cost.size), cost, np.zeros(cost.size))


def _average_cost(stretch: GrowthStretch, blocks: _Blocks, average: int) -> _MonitorCost:
    """What the monitor of one average costs a fault."""
    weight = stretch.watched.weight[:, average]
    part = stretch.watched.gain_s / weight
    # What a row gives to the average, its row before has to pay for in part; the last row has none after it.
    after = np.append((part * (1.0 - weight))[1:], 0.0)
    at, cost = _paying_rows(blocks, _priced_thresholds(stretch.watched.threshold_mps[:, average]))
    following = np.minimum(at + 1, stretch.count - 1)
    terms = part[at, None] * blocks.weights_at(at) - after[at, None] * blocks.weights_at(following)
    start = np.eye(1, terms.shape[1]) * part[0] * (1.0 - weight[0])
    linear = np.zeros(terms.shape[1])
    linear -= start[0] * stretch.start_mps[average]
    if (free := stretch.start_free_mps[average]) > 0.0:
        terms = np.vstack([terms, start])
        cost = np.append(cost, free)
    return _MonitorCost(terms, cost, linear)


def _paying_rows(blocks: _Blocks, threshold: Floats) -> tuple[Ints, Floats]:
    """Rows whose payment stands for those of their block, and how much: its first, its last but one, its last.

    Payments inside a block run along a straight line: the mean of both ends stands for them.
    """
    inner = blocks.last > blocks.first
    first = blocks.first[inner]
    last = blocks.last[inner]
    half = 0.5 * (np.add.reduceat(threshold, blocks.first)[inner] - threshold[last])
    return np.concatenate([first, last - 1, blocks.last]), np.concatenate([half, half, threshold[blocks.last]])


def _priced_thresholds(threshold: Floats) -> Floats:
    """Thresholds, with a price out of reach where nothing is tested."""
    tested = np.isfinite(threshold)
    if tested.all():
        return threshold
    dearest = float(threshold[tested].max(initial=1.0))
    return np.where(tested, threshold, _NOT_TESTED * dearest)


@frozen
class BoundedGrowth:
    """`most_m` (rows,): the fault's growth since the start, at most; `paid_m` (rows, 1 + averages): what bounds it."""

    most_m: Floats
    paid_m: Floats


def bound_growth(stretch: GrowthStretch) -> BoundedGrowth:
    """The growth that no monitor would have noticed, from above, at every row of a stretch."""
    return bound_growth_with(stretch, best_splits(stretch))


def bound_growth_with(stretch: GrowthStretch, splits: Iterable[Floats]) -> BoundedGrowth:
    """The least bound of the growth per row, over these splits, each of shape (some rows, 1 + averages).

    A split shares the fault out among the monitors: any bounds the growth, also one for the first rows only.
    """
    most = np.full(stretch.count, np.inf)
    monitors = 1 + stretch.watched.weight.shape[1]
    paid = np.zeros((stretch.count, monitors))
    to_one_monitor = (np.tile(alone, (stretch.count, 1)) for alone in np.eye(monitors))
    for shares in (*to_one_monitor, *splits):
        part = stretch.first_rows(len(shares))
        by_monitor_m = payments_m(part, shares[: part.count])
        total_m = by_monitor_m.sum(axis=1)
        better = np.flatnonzero(total_m < most[: total_m.size])
        most[better] = total_m[better]
        paid[better] = by_monitor_m[better]
    return BoundedGrowth(most - stretch.recorded_m, paid)


def best_splits(stretch: GrowthStretch) -> Iterator[Floats]:
    """The best up to rows that lie farther and farther on."""
    for rows in split_horizons(stretch.count):
        yield best_shares(stretch.first_rows(rows))


def split_horizons(rows: int) -> list[int]:
    """Numbers of rows up to which the best split is sought, the last one all of them; one row needs none.

    The best split up to one row is good up to the rows around it too.
    """
    lengths = [2]
    while lengths[-1] < rows:
        lengths.append(min(max(lengths[-1] + 1, int((1.0 + GROWTH) * lengths[-1])), rows))
    return lengths if rows > 1 else []
