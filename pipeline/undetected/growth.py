"""By how much a fault can have grown, at most, at every row of a stretch; and which monitors hold it there."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.undetected.shares import GROWTH, best_shares
from pipeline.undetected.stretch import Stretch, paid_m
from schemas.arrays import Floats


@dataclass(frozen=True)
class Growth:
    """`most_m` (rows,): the fault's growth since the start, at most; `paid_m` (rows, 1 + averages): what bounds it."""

    most_m: Floats
    paid_m: Floats


def growth_of(stretch: Stretch) -> Growth:
    """The growth that no monitor would have noticed, from above, at every row of a stretch."""
    return growth_with(stretch, splits_of(stretch))


def growth_with(stretch: Stretch, splits: Iterable[Floats]) -> Growth:
    """The same with given splits, each of shape (some rows, 1 + averages); any of them bounds the growth."""
    most = np.full(stretch.rows, np.inf)
    monitors = 1 + stretch.seen.weight.shape[1]
    paid = np.zeros((stretch.rows, monitors))
    # All to one monitor, and the splits.
    for shares in (*(np.tile(one, (stretch.rows, 1)) for one in np.eye(monitors)), *splits):
        part = stretch.first(len(shares))
        bills = paid_m(part, shares[: part.rows])
        total = bills.sum(axis=1)
        better = np.flatnonzero(total < most[: total.size])
        most[better], paid[better] = total[better], bills[better]
    return Growth(most - stretch.recorded_m, paid)


def splits_of(stretch: Stretch) -> Iterator[Floats]:
    """The best up to rows that lie farther and farther on."""
    for rows in horizons(stretch.rows):
        yield best_shares(stretch.first(rows))


def horizons(rows: int) -> list[int]:
    """Numbers of rows up to which the best split is sought, the last one all of them; one row needs none.

    The best split up to one row is good up to the rows around it too.
    """
    found = [2]
    while found[-1] < rows:
        found.append(min(max(found[-1] + 1, int((1.0 + GROWTH) * found[-1])), rows))
    return found if rows > 1 else []
