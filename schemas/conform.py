"""A table brought to its contract before it is written: columns, dtypes, nulls, finite numbers, ranges."""

from __future__ import annotations

import dataframely as dy
import polars as pl


def conform(frame: pl.DataFrame, schema: type[dy.Schema]) -> pl.DataFrame:
    """The frame with the contract's columns and dtypes, in its order.

    A breach is a defect of the program: `ValueError`, all breaches in one. Does what `schema.validate` does for
    these rules in one pass: on a table of a hundred columns planning that query takes longer than a replay.
    """
    columns = schema.columns()
    table = shaped(frame, schema)
    breaches = [*_null_breaches(table, columns), *_number_breaches(table, columns)]
    if breaches:
        raise ValueError(f"table {schema.__name__}: " + ", ".join(breaches))
    return table


def shaped(frame: pl.DataFrame, schema: type[dy.Schema]) -> pl.DataFrame:
    """The contract's columns and dtypes, in its order; the values are taken as they are."""
    return frame.select(pl.col(name).cast(column.dtype) for name, column in schema.columns().items())


def _null_breaches(table: pl.DataFrame, columns: dict[str, dy.Column]) -> list[str]:
    nulls = table.null_count().row(0, named=True)
    return [f"{name} holds null" for name, column in columns.items() if nulls[name] and not column.nullable]


def _number_breaches(table: pl.DataFrame, columns: dict[str, dy.Column]) -> list[str]:
    """Floats that are not finite, and numbers beyond their range."""
    checks: dict[str, pl.Expr] = {}
    for name, column in columns.items():
        value = pl.col(name)
        if isinstance(column, dy.Float64):
            # A sum that is finite proves every summand finite, in one pass and without another column.
            checks[f"{name} holds NaN or infinity"] = value.sum().is_finite().not_()
        low, high = getattr(column, "min", None), getattr(column, "max", None)
        if isinstance(low, int | float):
            checks[f"{name} is below {low}"] = value.min() < low
        if isinstance(high, int | float):
            checks[f"{name} is above {high}"] = value.max() > high
    broken = table.select(check.alias(text) for text, check in checks.items()).row(0, named=True)
    return [text for text, holds in broken.items() if holds]
