"""Columns of frames as numpy arrays: what null becomes."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import polars as pl

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]
Rows = Ints | Bools | slice
"""Some of the rows of an array: by their numbers, by a mask, or from one to another."""

NS_PER_S = 1_000_000_000


def floats(frame: pl.DataFrame, column: str) -> Floats:
    """A nullable numeric column, null as NaN.

    Args:
        frame: a table of n rows.
        column: name of the column.

    Returns:
        Shape (n,), in the unit of the column.
    """
    return frame[column].cast(pl.Float64).to_numpy()


def ints(series: pl.Series, unknown: int = -1) -> Ints:
    """Whole numbers, null as `unknown`.

    Args:
        series: whole numbers, n rows.
        unknown: what stands for null.

    Returns:
        Shape (n,).
    """
    return (series.fill_null(unknown) if series.null_count() else series).cast(pl.Int64).to_numpy()


def times_ns(frame: pl.DataFrame, column: str = "t") -> Ints:
    """A time column without nulls as int64 nanoseconds.

    Args:
        frame: a table of n rows.
        column: name of the column.

    Returns:
        Nanoseconds since 1970, shape (n,).
    """
    return frame[column].cast(pl.Datetime("ns")).cast(pl.Int64).to_numpy()


def flags(frame: pl.DataFrame, column: str) -> Bools:
    """A nullable boolean column, null as false.

    Args:
        frame: a table of n rows.
        column: name of the column.

    Returns:
        Shape (n,).
    """
    return truths(frame[column])


def truths(series: pl.Series) -> Bools:
    """Booleans, null as false.

    Args:
        series: booleans, n rows.

    Returns:
        Shape (n,).
    """
    return (series.fill_null(False) if series.null_count() else series).to_numpy().astype(np.bool_, copy=False)


def median(values: Floats | Ints) -> float:
    """The median of numbers of any shape, NaN where one of them is or where there is none.

    What `numpy.median` gives to the last bit; for the few hundred values that most are asked of, its handling of axes
    takes four times as long as the median.

    Args:
        values: numbers of any shape.

    Returns:
        The median, in the unit of the values.
    """
    flat = np.ravel(values).astype(np.float64, copy=False)
    half = flat.size // 2
    if flat.size < 2:
        return float(flat[0]) if flat.size else float("nan")
    # NaN is sorted to the end.
    ordered = np.partition(flat, (half - 1, half, flat.size - 1))
    if np.isnan(ordered[-1]):
        return float("nan")
    return float(ordered[half] if flat.size % 2 else 0.5 * (ordered[half - 1] + ordered[half]))


def rows_of(numbers: Ints) -> Rows:
    """Rows by growing numbers: a slice where they follow each other, which numpy takes several times faster.

    Args:
        numbers: of rows, growing, shape (n,).

    Returns:
        The same rows.
    """
    if numbers.size and numbers[-1] - numbers[0] + 1 == numbers.size:
        return slice(int(numbers[0]), int(numbers[-1]) + 1)
    return numbers


def runs_of(mask: Bools) -> tuple[Ints, Ints]:
    """First and last index of every run of true values.

    Args:
        mask: booleans, shape (n,).

    Returns:
        First and last indices, one each per run.
    """
    edges = np.diff(np.concatenate(([False], mask, [False])).astype(np.int8))
    return np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1


def spans_of(mask: Bools) -> list[tuple[int, int]]:
    """The runs of true values as pairs of first and last index.

    Args:
        mask: booleans, shape (n,).

    Returns:
        Pairs (first, last), in order.
    """
    firsts, lasts = runs_of(mask)
    return list(zip(firsts.tolist(), lasts.tolist(), strict=True))
