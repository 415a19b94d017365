"""A table brought to its contract before it is written: columns, dtypes, nulls, finite numbers, ranges."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from operator import is_

import dataframely as dy
import polars as pl

from schemas.frozen import frozen


@frozen
class _Rule:
    """What a contract asks of one column."""

    name: str
    dtype: pl.DataType
    nullable: bool
    finite: bool
    low: float | None
    high: float | None


def conform(frame: pl.DataFrame, schema: type[dy.Schema]) -> pl.DataFrame:
    """The frame with the contract's columns and dtypes, in its order, checked.

    Does what `schema.validate` does for these rules column by column: on a table of a hundred columns planning that
    query takes longer than a replay.

    Args:
        frame: a table with the columns of the contract at least.
        schema: the contract.

    Returns:
        The table.

    Raises:
        ValueError: a column is missing, or values breach the contract: a defect of the program; all breaches in one.
    """
    table = shaped(frame, schema)
    pairs = list(zip(table, _rules(schema), strict=True))
    breaches = [f"{rule.name} holds null" for series, rule in pairs if not rule.nullable and series.null_count()]
    breaches += [text for series, rule in pairs for text in _number_breaches(series, rule)]
    if breaches:
        raise ValueError(f"table {schema.__name__}: " + ", ".join(breaches))
    return table


def shaped(frame: pl.DataFrame, schema: type[dy.Schema]) -> pl.DataFrame:
    """The contract's columns and dtypes, in its order; the values are taken as they are.

    Args:
        frame: a table with the columns of the contract at least.
        schema: the contract.

    Returns:
        The table.

    Raises:
        ValueError: the frame lacks a column of the contract: a defect of the program.
    """
    recorded = frame.get_columns()
    series = {column.name: column for column in recorded}
    if missing := [rule.name for rule in _rules(schema) if rule.name not in series]:
        raise ValueError(f"table {schema.__name__}: no stage makes column {', '.join(missing)}")
    columns = [_cast(series[rule.name], rule.dtype) for rule in _rules(schema)]
    same = len(columns) == len(recorded) and all(map(is_, columns, recorded))
    return frame if same else pl.DataFrame(columns)


def table_of_rows(rows: Sequence[Mapping[str, object]], schema: type[dy.Schema]) -> pl.DataFrame:
    """Rows as a table of a contract; most runs have no hazard and no alarm, and columns are many.

    Args:
        rows: values by column name, one mapping per row; columns that are not named are null.
        schema: the contract.

    Returns:
        The table.
    """
    return pl.DataFrame(rows, schema=dtypes(schema)) if rows else _empty(schema).clone()


@lru_cache(maxsize=64)
def _empty(schema: type[dy.Schema]) -> pl.DataFrame:
    """A table of the contract without rows."""
    return pl.DataFrame([pl.Series(name, dtype=dtype) for name, dtype in dtypes(schema).items()])


def dtypes(schema: type[dy.Schema]) -> dict[str, pl.DataType]:
    """The contract's columns in their order, with their dtypes.

    Args:
        schema: the contract of a table.

    Returns:
        Dtypes by column name.
    """
    return {rule.name: rule.dtype for rule in _rules(schema)}


@lru_cache(maxsize=64)
def meanings(schema: type[dy.Schema]) -> dict[str, dict[str, str]]:
    """Unit and meaning of each column, as they stand in the fields of every file."""
    return {
        name: {"unit": str((column.metadata or {}).get("unit", "")), "meaning": column.description or ""}
        for name, column in schema.columns().items()
    }


def _cast(series: pl.Series, dtype: pl.DataType) -> pl.Series:
    """A series in a type."""
    return series if series.dtype == dtype else series.cast(dtype)


@lru_cache(maxsize=64)
def _rules(schema: type[dy.Schema]) -> tuple[_Rule, ...]:
    """Looked up once: a contract makes its columns and dtypes anew each time it is asked."""
    return tuple(
        _Rule(
            name,
            column.dtype,
            column.nullable,
            isinstance(column, dy.Float64),
            _bound(column, "min"),
            _bound(column, "max"),
        )
        for name, column in schema.columns().items()
    )


def _bound(column: dy.Column, name: str) -> float | None:
    """Bound of a column, if it has one."""
    bound = getattr(column, name, None)
    return bound if isinstance(bound, int | float) else None


def _number_breaches(series: pl.Series, rule: _Rule) -> Iterator[str]:
    """A float that is not finite, and a number beyond its range."""
    # A sum that is finite proves every summand finite, in one pass and without another column.
    if rule.finite and not math.isfinite(series.sum()):
        yield f"{rule.name} holds NaN or infinity"
    if rule.low is not None and _known(series.min(), rule.low) < rule.low:
        yield f"{rule.name} is below {rule.low}"
    if rule.high is not None and _known(series.max(), rule.high) > rule.high:
        yield f"{rule.name} is above {rule.high}"


def _known(value: object, otherwise: float) -> float:
    """The least or largest value; `otherwise` where a column holds none."""
    return value if isinstance(value, int | float) else otherwise
