"""Small tools between arrays and tables, against what they stand in for."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from schemas.arrays import median, rows_of
from schemas.conform import dtypes, table_of_rows
from schemas.tables import Hazards


@pytest.mark.parametrize("size", [1, 2, 3, 10, 101, 1000])
def test_the_median_is_that_of_numpy_to_the_last_bit(size: int) -> None:
    draw = np.random.default_rng(size)
    beyond = np.where(draw.random(size) < 0.6, np.inf, 1.0)
    for values in (draw.normal(size=size), draw.integers(-(2**40), 2**40, size), beyond):
        assert median(values) == np.median(values)
    assert np.isnan(median(np.append(draw.normal(size=size), np.nan)))
    assert np.isnan(median(np.zeros(0)))


@pytest.mark.parametrize("numbers", [[], [0], [3, 4, 5], [0, 2, 3], [1, 4]])
def test_rows_by_number_are_the_same_rows_as_a_slice(numbers: list[int]) -> None:
    values = np.arange(6.0)
    rows = np.array(numbers, dtype=np.int64)
    np.testing.assert_array_equal(values[rows_of(rows)], values[rows])
    assert isinstance(rows_of(np.array([3, 4, 5])), slice)


def test_rows_of_no_run_make_a_table_of_the_same_columns() -> None:
    kinds = dtypes(Hazards)
    assert table_of_rows([], Hazards).schema == pl.DataFrame([dict.fromkeys(kinds)], schema=kinds).schema
    assert table_of_rows([{"hazard_id": 3}], Hazards)["hazard_id"].to_list() == [3]
