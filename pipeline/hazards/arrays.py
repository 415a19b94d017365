"""Array operations for several modules of this area."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from schemas.arrays import Bools, Floats, Ints


def words(kinds: Sequence[str], codes: Ints) -> pl.Series:
    """Words of a closed set by their number, null for -1."""
    rows = np.where(codes < 0, len(kinds), codes)
    return pl.Series([*kinds, None], dtype=pl.Enum(kinds)).gather(pl.Series(rows))


def runs_of(mask: Bools) -> tuple[Ints, Ints]:
    """First and last index of each stretch of true values."""
    padded = np.concatenate(([False], mask, [False])).astype(np.int8)
    edges = np.diff(padded)
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1


def interpolate_known(at: Floats, x: Floats, y: Floats, gap: float) -> Floats:
    """Linear interpolation of `y(x)`, NaN beyond the ends and between samples more than `gap` apart.

    `x` does not fall; samples with unknown `y` are left out.
    """
    known = np.isfinite(y)
    x, y = x[known], y[known]
    result = np.full(at.size, np.nan)
    if x.size == 0:
        return result
    right = np.searchsorted(x, at, side="left")
    inside = (right < x.size) & ((right > 0) | (at == x[0]))
    right = np.clip(right, 0, x.size - 1)
    left = np.maximum(right - 1, 0)
    near = inside & ((x[right] - x[left] <= gap) | (at == x[right]))
    result[near] = np.interp(at[near], x, y)
    return result
