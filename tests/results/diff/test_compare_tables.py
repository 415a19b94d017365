"""The comparer itself: whatever is changed in a table, it must find; whatever is not, it must not."""

import math
from functools import lru_cache
from typing import Any

import dataframely as dy
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.results.diff import compare_tables
from pipeline.results.diff.rules import Rules
from schemas.columns import count, flag, instant, one_of, real, text, texts
from schemas.enums import Hazard
from schemas.tables import TABLES, Epochs
from tests.tables import epochs


class Sample(dy.Schema):
    t = instant("time")
    name = text("name", nullable=True)
    number = count("number")
    kind = one_of(Hazard, "class")
    good = flag("flag", nullable=True)
    ids = texts("list")
    place_m = real("m", "place")
    loose_m = real("m", "place known to a metre", tolerance=1.0)


BASE: dict[str, list[Any]] = {
    "t": [10, 20, 30],
    "name": ["a", None, "c"],
    "number": [1, 2, 3],
    "kind": ["VB_SHIFT", "VB_JUMP_1A", "VB_JUMP_1B"],
    "good": [True, False, None],
    "ids": [["x"], [], ["y", "z"]],
    "place_m": [4_000_000.0, None, -3.0],
    "loose_m": [1.0, 2.0, math.inf],
}


def sample(**columns: list[Any]) -> pl.DataFrame:
    dtypes = {name: column.dtype for name, column in Sample.columns().items()}
    return pl.DataFrame(BASE | columns, schema=dtypes)


def found(b: pl.DataFrame, a: pl.DataFrame | None = None, **kwargs: Any) -> list[tuple[str, str]]:
    differences = compare_tables(sample() if a is None else a, b, Sample, **kwargs)
    return [(item.kind, item.column) for item in differences]


def test_the_same_is_the_same() -> None:
    assert found(sample()) == []
    assert found(sample().clear(), sample().clear()) == []


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("t", [10, 20, 31]),
        ("name", ["a", None, "d"]),
        ("name", ["a", "", "c"]),
        ("name", [None, None, "c"]),
        ("number", [1, 2, 4]),
        ("kind", ["VB_SHIFT", "VB_JUMP_1A", "VB_JUMP_1A"]),
        ("good", [True, False, True]),
        ("good", [True, True, None]),
        ("ids", [["x"], [], ["z", "y"]]),
        ("ids", [["x"], ["x"], ["y", "z"]]),
        ("place_m", [4_000_000.0, None, -3.000002]),
        ("place_m", [4_000_000.00001, None, -3.0]),
        ("place_m", [4_000_000.0, 0.0, -3.0]),
        ("place_m", [None, None, -3.0]),
        ("place_m", [math.nan, None, -3.0]),
        ("place_m", [math.inf, None, -3.0]),
        ("loose_m", [1.0, 2.0, -math.inf]),
        ("loose_m", [1.0, 3.1, math.inf]),
        ("loose_m", [1.0, 2.0, 1e300]),
    ],
)
def test_any_other_value_is_found(column: str, values: list[Any]) -> None:
    changed = sample(**{column: values})
    assert found(changed) == [("values", column)]
    assert found(sample(), changed) == [("values", column)]


@pytest.mark.parametrize(
    ("column", "values"),
    [
        ("place_m", [4_000_000.0000005, None, -3.0]),
        ("loose_m", [2.0, 1.0, math.inf]),
        ("loose_m", [0.5, 2.9, math.inf]),
    ],
)
def test_within_the_column_s_own_tolerance(column: str, values: list[Any]) -> None:
    assert found(sample(**{column: values})) == []


def test_no_relative_tolerance() -> None:
    """30 m of 4000 km are 30 m, though a relative tolerance of 1e-5 calls them the same."""
    assert found(sample(place_m=[4_000_030.0, None, -3.0])) == [("values", "place_m")]


def test_nan_on_both_sides_is_not_the_same() -> None:
    broken = sample(place_m=[math.nan, None, -3.0])
    assert found(broken, broken) == [("values", "place_m")]


def test_how_much_and_where() -> None:
    (difference,) = compare_tables(sample(), sample(loose_m=[9.0, 7.0, math.inf]), Sample)
    assert difference.rows == 2
    assert str(difference) == (
        "sample.loose_m: 2 of 3 rows differ, first row 0: 1.0 became 9.0; by up to 8, tolerance 1"
    )


class TestSchema:
    def test_lost_column(self) -> None:
        assert found(sample().drop("good")) == [("schema", "good")]

    def test_new_column(self) -> None:
        assert found(sample().with_columns(more=1)) == [("schema", "more")]

    def test_another_order(self) -> None:
        assert found(sample().select(*reversed(BASE))) == [("schema", "")]

    @pytest.mark.parametrize("dtype", [pl.Int32, pl.Float64])
    def test_another_type_of_the_same_values(self, dtype: type[pl.DataType]) -> None:
        assert found(sample().with_columns(pl.col("number").cast(dtype))) == [("schema", "number")]

    def test_another_unit_of_time(self) -> None:
        assert found(sample().with_columns(pl.col("t").cast(pl.Datetime("us", "UTC")))) == [("schema", "t")]
        assert found(sample().with_columns(pl.col("t").dt.replace_time_zone(None))) == [("schema", "t")]

    def test_another_set_of_an_enum(self) -> None:
        wider = pl.Enum([*(item.value for item in Hazard), "more"])
        assert found(sample().with_columns(pl.col("kind").cast(wider))) == [("schema", "kind")]
        assert found(sample().with_columns(pl.col("kind").cast(pl.String))) == [("schema", "kind")]

    def test_values_are_compared_all_the_same(self) -> None:
        changed = sample(number=[1, 2, 9]).drop("good")
        assert found(changed) == [("schema", "good"), ("values", "number")]

    def test_lost_key(self) -> None:
        assert found(sample().drop("name"), keys=("name",)) == [("schema", "name")]


class TestRows:
    def test_one_row_less(self) -> None:
        assert found(sample().head(2)) == [("rows", "")]
        assert found(sample().clear()) == [("rows", "")]

    def test_another_order(self) -> None:
        assert ("values", "number") in found(sample().reverse())

    def test_by_key_one_row_more_is_one_difference(self) -> None:
        longer = pl.concat([sample(name=["q", "r", "s"]).head(1), sample()])
        differences = compare_tables(sample(), longer, Sample, keys=("name",))
        assert [str(item) for item in differences] == ["sample: 1 rows new, first: name q"]

    def test_by_key_rows_lost_and_changed(self) -> None:
        shorter = sample(number=[1, 2, 7]).tail(2)
        differences = compare_tables(sample(), shorter, Sample, keys=("name",))
        assert [(item.kind, item.column, item.rows) for item in differences] == [
            ("rows", "", 1),
            ("values", "number", 1),
        ]

    def test_a_key_that_stands_twice_counts_by_its_turn(self) -> None:
        twice = pl.concat([sample(), sample(number=[5, 6, 7])])
        assert found(twice, twice, keys=("name",)) == []
        other = pl.concat([sample(), sample(number=[5, 6, 8])])
        assert found(other, twice, keys=("name",)) == [("values", "number")]

    def test_null_is_a_key_like_any(self) -> None:
        assert found(sample(number=[1, 9, 3]), keys=("name",)) == [("values", "number")]


def test_a_column_outside_the_contract_is_compared_exactly() -> None:
    a, b = (sample().with_columns(more=pl.lit(value)) for value in (1.0, 1.0 + 1e-12))
    assert found(b, a) == [("values", "more")]


def test_columns_left_out_on_both_sides_are_no_difference() -> None:
    assert found(sample().drop("good"), sample().drop("good")) == []


@pytest.mark.parametrize("table", sorted(TABLES))
def test_every_float_of_the_contract_has_a_tolerance(table: str) -> None:
    floats = [name for name, column in TABLES[table].columns().items() if isinstance(column, dy.Float64)]
    assert all(Rules().tolerance(table, name, TABLES[table].columns()[name]) > 0 for name in floats)
    assert all(Rules().tolerance(table, name, TABLES[table].columns()[name]) <= 1e-6 for name in floats)


@lru_cache(maxsize=1)
def _wide() -> pl.DataFrame:
    return epochs([0, 1, 2, 3, 4])


def test_a_change_in_any_column_of_a_wide_table_is_found() -> None:
    """Each column is changed in one row, in turn for each of the five rows; the others are not named."""
    frame, names = _wide(), list(Epochs.columns())
    for row in range(5):
        chosen = names[row::5]
        changed = frame.with_columns(
            pl.when(pl.int_range(pl.len()) == row)
            .then(_other(frame, name, row, 2e-6))
            .otherwise(pl.col(name))
            .alias(name)
            for name in chosen
        )
        assert [item.column for item in compare_tables(frame, changed, Epochs)] == chosen


@settings(deadline=None, max_examples=8)
@given(
    row=st.integers(0, 4),
    column=st.sampled_from(list(Epochs.columns())),
    change=st.floats(2e-6, 1e6) | st.floats(-1e6, -2e-6),
)
def test_any_single_change_in_a_wide_table_is_found(row: int, column: str, change: float) -> None:
    frame = _wide()
    changed = frame.with_columns(
        pl.when(pl.int_range(pl.len()) == row)
        .then(_other(frame, column, row, change))
        .otherwise(pl.col(column))
        .alias(column)
    )
    assert [item.column for item in compare_tables(frame, changed, Epochs)] == [column]


def _other(frame: pl.DataFrame, column: str, row: int, change: float) -> pl.Expr:
    dtype, value = frame.schema[column], frame[column][row]
    if dtype.is_float():
        return pl.lit(change if value is None else value + change)
    if dtype == pl.Boolean:
        return ~pl.col(column)
    if isinstance(dtype, pl.Enum):
        return pl.lit(next(item for item in dtype.categories if item != value)).cast(dtype)
    if dtype == pl.String:
        return pl.lit("another")
    if isinstance(dtype, pl.Datetime):
        return pl.col(column) + pl.duration(nanoseconds=1)
    if isinstance(dtype, pl.List):
        return pl.lit(["another"], dtype=dtype)
    return pl.lit(-1 if value is None else -value, dtype=dtype)
