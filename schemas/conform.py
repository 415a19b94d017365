"""A table brought to its contract before it is written: columns, dtypes, no null where none may be, never a NaN."""

from __future__ import annotations

import dataframely as dy
import polars as pl


def conform(frame: pl.DataFrame, schema: type[dy.Schema]) -> pl.DataFrame:
    """The frame with the contract's columns and dtypes, in its order.

    A breach is a defect of the program: `ValueError`. The ranges are left to `schema.validate`, which takes longer
    than the replay itself on a table of a hundred columns; tests hold every table against it.
    """
    columns = schema.columns()
    table = frame.select(pl.col(name).cast(column.dtype) for name, column in columns.items())
    floats = [name for name, column in columns.items() if isinstance(column, dy.Float64)]
    nan = table.select(pl.col(floats).is_nan().any()).row(0) if table.height and floats else ()
    breaches = [f"{name} holds NaN" for name, holds in zip(floats, nan, strict=False) if holds]
    nulls = table.null_count().row(0, named=True)
    breaches += [f"{name} holds null" for name, column in columns.items() if nulls[name] and not column.nullable]
    if breaches:
        raise ValueError(f"table {schema.__name__}: " + ", ".join(breaches))
    return table
