"""The best split of a stretch among the monitors, found on blocks of rows that grow with the time since the start.

Thresholds change slowly, and so do the best shares: within a block they are straight lines. The bound that they give is
evaluated on every row (`paid_m`), so blocks cost closeness, never validity.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from pipeline.undetected.stretch import Stretch
from schemas.arrays import Floats, Ints

if TYPE_CHECKING:
    from scipy import sparse

# Entries of a matrix: rows, columns, values.
Entries = tuple[Ints, Ints, Floats]
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
    def over(cls, rows: int) -> _Blocks:
        edges = [0]
        while edges[-1] < rows:
            edges.append(min(edges[-1] + max(1, int(GROWTH * edges[-1])), rows))
        first, end = np.array(edges[:-1]), np.array(edges[1:])
        return cls(first, end - 1, np.repeat(np.arange(first.size), end - first))

    def lines(self, row: Ints) -> tuple[Ints, Floats]:
        """Of each row its block and how far along it lies, from 0 to 1."""
        block = self.of_row[row]
        return block, (row - self.first[block]) / np.maximum(self.last[block] - self.first[block], 1)


def best_shares(stretch: Stretch) -> Floats:
    """Shares of raw and averages in each row, shape (rows, 1 + averages), that give the least bound at the last row."""
    from scipy.optimize import linprog  # most replays solve nothing

    blocks, monitors = _Blocks.over(stretch.rows), 1 + stretch.weight.shape[1]
    ends = 2 * blocks.first.size
    terms, costs, linear = _program(stretch, blocks)
    gauge = max(float(costs.max()), 1e-12)
    found = linprog(
        np.concatenate([linear, costs, costs]) / gauge,
        A_eq=_equations(terms, costs.size, ends, monitors),
        b_eq=np.concatenate([np.zeros(costs.size), np.ones(ends)]),
        bounds=np.array([(-np.inf, np.inf)] * (monitors * ends) + [(0.0, np.inf)] * (2 * costs.size)),
        method="highs-ds",
    )
    knots = np.zeros((monitors, blocks.first.size, 2))
    if found.status == 0:
        knots = found.x[: monitors * ends].reshape(knots.shape)
    block, along = blocks.lines(np.arange(stretch.rows))
    shares = (knots[:, block, 0] * (1.0 - along) + knots[:, block, 1] * along).T
    # They add up to one, to the last digit.
    shares[:, 0] += 1.0 - shares.sum(axis=1)
    return shares


def _equations(terms: list[Entries], size: int, ends: int, monitors: int) -> sparse.csr_matrix:
    """Each term is what it has above zero less what it has below; shares add up to one at both ends of each block."""
    from scipy import sparse

    shares, each = monitors * ends, np.arange(size)
    ones = np.ones(size)
    whole = size + np.tile(np.arange(ends), monitors), np.arange(shares), np.ones(shares)
    entries = [*terms, (each, shares + each, -ones), (each, shares + size + each, ones), whole]
    row, column, value = (np.concatenate(part) for part in zip(*entries, strict=True))
    return sparse.csr_matrix((value, (row, column)), shape=(size + ends, shares + 2 * size))


def _program(stretch: Stretch, blocks: _Blocks) -> tuple[list[Entries], Floats, Floats]:
    """What is paid for, as terms over the shares at both ends of the blocks; what each costs; what the start gives."""
    ends = 2 * blocks.first.size
    pieces, costs, linear = [], [], np.zeros((1 + stretch.weight.shape[1]) * ends)
    raw_mps = np.maximum(np.abs(stretch.most_mps), np.abs(stretch.least_mps))
    raw_m = np.add.reduceat(stretch.way_s * _tested(raw_mps), blocks.first)
    pieces.append((np.arange(ends), np.arange(ends), np.ones(ends)))
    single = blocks.first == blocks.last
    costs.append(np.column_stack([np.where(single, raw_m, 0.5 * raw_m), np.where(single, 0.0, 0.5 * raw_m)]).ravel())
    for average in range(stretch.weight.shape[1]):
        part = stretch.way_s / stretch.weight[:, average]
        before = part * (1.0 - stretch.weight[:, average])
        threshold = _tested(stretch.threshold_mps[:, average])
        at, cost = _paid_at(blocks, threshold)
        offset, begin = (1 + average) * ends, sum(piece.size for piece in costs)
        pieces += _shares_at(blocks, at, np.arange(begin, begin + at.size), part[at], offset)
        inner = np.flatnonzero(at + 1 < stretch.rows)
        after = at[inner] + 1
        pieces += _shares_at(blocks, after, begin + inner, -before[after], offset)
        costs.append(cost)
        free = stretch.start_free_mps[average]
        if free > 0.0:
            pieces.append((np.array([begin + at.size]), np.array([offset]), np.array([before[0]])))
            costs.append(np.array([free]))
        linear[offset] -= before[0] * stretch.start_mps[average]
    return pieces, np.concatenate(costs), linear


def _paid_at(blocks: _Blocks, threshold: Floats) -> tuple[Ints, Floats]:
    """Rows whose payment stands for those of their block, and how much: its first, its last but one, its last.

    Payments inside a block run along a straight line: the mean of both ends stands for them.
    """
    inner = blocks.last > blocks.first
    first, last = blocks.first[inner], blocks.last[inner]
    half = 0.5 * (np.add.reduceat(threshold, blocks.first)[inner] - threshold[last])
    return np.concatenate([first, last - 1, blocks.last]), np.concatenate([half, half, threshold[blocks.last]])


def _shares_at(blocks: _Blocks, at: Ints, row: Ints, value: Floats, offset: int) -> list[Entries]:
    """The share at these rows of the stretch, times `value`, as entries of the program's rows."""
    block, along = blocks.lines(at)
    return [(row, offset + 2 * block, value * (1.0 - along)), (row, offset + 2 * block + 1, value * along)]


def _tested(threshold: Floats) -> Floats:
    tested = np.isfinite(threshold)
    if tested.all():
        return threshold
    dearest = float(threshold[tested].max(initial=1.0))
    return np.where(tested, threshold, _NOT_TESTED * dearest)
