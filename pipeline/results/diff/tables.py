"""What changed between two tables: schemas and whole numbers exactly, floats by their column's tolerance.

The tolerance is absolute and stands in the contract (`metadata["tolerance"]`); there is no relative
one, which would call positions tens of metres apart the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import dataframely as dy
import polars as pl

from pipeline.results.diff.rules import Rules
from schemas.frozen import frozen

NO_RULES = Rules()


@frozen
class Difference:
    """One difference between two tables; `rows` counts the rows concerned."""

    table: str
    kind: Literal["schema", "rows", "values"]
    column: str
    message: str
    rows: int = 0

    @property
    def place(self) -> str:
        """`table.column`, or the table alone."""
        return f"{self.table}.{self.column}" if self.column else self.table

    def __str__(self) -> str:
        return f"{self.place}: {self.message}"


def compare_tables(
    a: pl.DataFrame, b: pl.DataFrame, contract: type[dy.Schema], keys: tuple[str, ...] = (), rules: Rules = NO_RULES
) -> list[Difference]:
    """The differences of one table against another.

    By `keys`, one row more is one difference. A column without a tolerance in rules or contract is compared exactly.
    NaN, which no table may hold, is always a difference.

    Args:
        a: table of the first result.
        b: table of the second one.
        contract: schema with the tolerance of each column, in the unit of the column.
        keys: columns by which rows are paired; empty: as they stand.
        rules: what may differ.

    Returns:
        The differences, none where the tables are the same.
    """
    name = contract.__name__.lower()
    a, b = (rules.compared_columns(name, frame) for frame in (a, b))
    differences = [Difference(name, "schema", *what) for what in _schema_differences(a, b)]
    was, became = a.schema, b.schema  # each look at a schema makes the types of all columns anew
    common = [column for column, dtype in was.items() if became.get(column) == dtype]
    if not set(keys) <= set(common):
        return differences
    if keys:
        counted, a, b = _pair_rows(name, a, b, keys)
        differences += counted
    elif a.height != b.height:
        rows = abs(a.height - b.height)
        return [*differences, Difference(name, "rows", "", f"{a.height} rows became {b.height}", rows)]
    columns = contract.columns()
    for column in common:
        tolerance = rules.tolerance(name, column, columns.get(column))
        if (differing := _values_differ(a[column], b[column], tolerance)) is not None:
            differences.append(Difference(name, "values", column, *differing))
    return differences


def _schema_differences(a: pl.DataFrame, b: pl.DataFrame) -> Iterator[tuple[str, str]]:
    """Column, or none where it is about all of them, and what became of it."""
    was, became = a.schema, b.schema
    both = [column for column in was if column in became]
    yield from ((column, "column is lost") for column in was if column not in became)
    yield from ((column, "column is new") for column in became if column not in was)
    if both != [column for column in became if column in was]:
        yield "", "columns stand in another order"
    for column in both:
        if was[column] != became[column]:
            yield column, f"{was[column]} became {became[column]}"


def _pair_rows(
    table: str, a: pl.DataFrame, b: pl.DataFrame, keys: tuple[str, ...]
) -> tuple[list[Difference], pl.DataFrame, pl.DataFrame]:
    """The rows that stand in both, in the order of `a`; a key that stands twice counts by its turn."""
    by = [*keys, "_turn"]
    a, b = (frame.with_columns(_turn=pl.int_range(pl.len()).over(list(keys))) for frame in (a, b))
    differences = []
    for word, rows in (("lost", _join_rows(a, b, by, "anti")), ("new", _join_rows(b, a, by, "anti"))):
        if rows.height:
            first = ", ".join(f"{key} {_value_words(rows[key][0])}" for key in keys)
            differences.append(Difference(table, "rows", "", f"{rows.height} rows {word}, first: {first}", rows.height))
    kept = _join_rows(a, b, by, "semi")
    partners = _join_rows(kept.select(by), b, by, "left").select(b.columns)
    return differences, kept.drop("_turn"), partners.drop("_turn")


def _join_rows(a: pl.DataFrame, b: pl.DataFrame, by: list[str], how: Literal["anti", "semi", "left"]) -> pl.DataFrame:
    """Join with equal nulls, in the order of `a`."""
    return a.join(b, on=by, how=how, nulls_equal=True, maintain_order="left")


def _values_differ(a: pl.Series, b: pl.Series, tolerance: float) -> tuple[str, int] | None:
    """What differs, and in how many rows."""
    differs = a.ne_missing(b)
    if a.dtype.is_integer() and tolerance > 0.0:
        differs &= ~((a.cast(pl.Float64) - b.cast(pl.Float64)).abs() <= tolerance).fill_null(value=False)
    if a.dtype.is_float():
        near = ((a - b).abs() <= tolerance).fill_null(value=False)
        differs = (differs & ~near) | a.is_nan().fill_null(value=False) | b.is_nan().fill_null(value=False)
    rows = int(differs.sum())
    if rows == 0:
        return None
    first = differs.arg_true()[0]
    message = (
        f"{rows} of {a.len()} rows differ, first row {first}: {_value_words(a[first])} became {_value_words(b[first])}"
    )
    if a.dtype.is_float():
        largest = (a - b).abs().filter(differs).drop_nans().max()
        if isinstance(largest, float):
            message += f"; by up to {largest:.3g}, tolerance {tolerance:.3g}"
    return message, rows


def _value_words(value: object) -> str:
    """A value for people."""
    if value is None:
        return "null"
    if isinstance(value, pl.Series):
        return str(value.to_list())
    return repr(value) if isinstance(value, float) else str(value)
