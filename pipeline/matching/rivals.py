"""Which net elements the train may have been on at each epoch, from what the search found at its steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.matching.search import Found
from pipeline.matching.trellis import Trellis
from pipeline.track.path import TravelledPath
from schemas.arrays import Floats, Ints


@dataclass(frozen=True)
class Posterior:
    """Per step of the search its net elements in order, and how probable each is by the whole run.

    `epoch[k]` is the row of step k; `first[k] : first[k + 1]` are its elements, as numbers of the path's track.
    """

    epoch: Ints
    first: Ints
    element: Ints
    probability: Floats


@dataclass(frozen=True)
class Rivals:
    """Per epoch the net elements that are possible: `element[first[k] : first[k + 1]]`, numbers into `ids`, ascending.

    The path's own element is always one of them. Every name stands once in `ids`.
    """

    ids: tuple[str, ...]
    first: Ints
    element: Ints

    def __len__(self) -> int:
        return len(self.first) - 1

    def at(self, epoch: int) -> list[str]:
        """Names of the elements possible at one epoch."""
        return [self.ids[number] for number in self.element[int(self.first[epoch]) : int(self.first[epoch + 1])]]


def posterior_of(trellis: Trellis, found: Found) -> Posterior:
    """Probability of each element at each step: of all its states together."""
    step = np.repeat(np.arange(len(trellis)), np.diff(trellis.first))
    count = trellis.network.count
    keys, inverse = np.unique(step * count + trellis.oriented // 2, return_inverse=True)
    probability = np.asarray(np.bincount(inverse, found.posterior, len(keys)), dtype=np.float64)
    first = np.searchsorted(keys // count, np.arange(len(trellis) + 1))
    return Posterior(trellis.steps.epoch, first, (keys % count).astype(np.int64), probability)


def rivals_of(posterior: Posterior, epochs: pl.DataFrame, path: TravelledPath, limit: float) -> Rivals:
    """Elements of a posterior of at least `limit` at the steps on both sides of each epoch, and its own."""
    ids = tuple(dict.fromkeys(path.track.ids))
    index = {name: number for number, name in enumerate(ids)}
    names = epochs["netelement_id"].replace_strict(index, default=None, return_dtype=pl.Int64)
    rows = np.flatnonzero(names.is_not_null().to_numpy())
    pairs = [np.column_stack([rows, names.drop_nulls().to_numpy()])]
    number = np.array([index[name] for name in path.track.ids], dtype=np.int64)
    pairs += [_at_steps(posterior, number, side, limit) for side in _sides(posterior, epochs.height)]
    keys = np.unique(np.concatenate(pairs) @ np.array([len(ids), 1]))
    return Rivals(ids, np.searchsorted(keys // len(ids), np.arange(epochs.height + 1)), keys % len(ids))


def _sides(posterior: Posterior, epochs: int) -> tuple[Ints, Ints]:
    """Per epoch the step at or before it, and the step at or after it."""
    row, last = np.arange(epochs), len(posterior.epoch) - 1
    before = np.searchsorted(posterior.epoch, row, side="right") - 1
    after = np.searchsorted(posterior.epoch, row, side="left")
    return np.maximum(before, 0), np.minimum(after, last)


def _at_steps(posterior: Posterior, number: Ints, step: Ints, limit: float) -> Ints:
    """Pairs of epoch and element number, of those that reach the limit at each epoch's step."""
    kept = posterior.probability >= limit
    first = np.concatenate([[0], np.cumsum(kept)])[posterior.first]
    element = number[posterior.element[kept]]
    count = np.diff(first)[step]
    row = np.repeat(np.arange(len(step)), count)
    inside = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    return np.column_stack([row, element[first[step][row] + inside]])
