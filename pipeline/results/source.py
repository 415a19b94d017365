"""Tables that polars reads part by part, so that every part goes through our own reader."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import product

import polars as pl
from polars.io.plugins import register_io_source

Parts = Callable[[list[str], pl.Expr | None], Iterator[pl.DataFrame]]


def source_of(schema: Mapping[str, pl.DataType], parts: Parts) -> pl.LazyFrame:
    """A frame whose rows `parts` yields when a query asks for them: the columns named, in this order.

    `parts` may use the condition to leave parts out; rows are chosen here. A word that is none of an enum's raises
    `InvalidOperationError`: a query for it would find nothing, and say nothing.
    """

    def batches(
        columns: list[str] | None, predicate: pl.Expr | None, most: int | None, _: int | None
    ) -> Iterator[pl.DataFrame]:
        """Rows of the parts, with the columns asked for, until as many as asked for are there."""
        wanted = columns or list(schema)
        _check_words(predicate, schema)
        yield pl.DataFrame(schema=schema).select(wanted)
        for part in parts(wanted, predicate):
            rows = part if predicate is None else part.filter(predicate)
            yield rows if most is None else rows.head(most)
            most = None if most is None else most - rows.height
            if most is not None and most <= 0:
                return

    return register_io_source(batches, schema=schema)


def conjuncts(predicate: pl.Expr | None) -> Iterator[pl.Expr]:
    """The conditions that must all hold."""
    waiting = [] if predicate is None else [predicate]
    while waiting:
        condition = waiting.pop()
        inputs = condition.meta.pop()
        if len(inputs) == 2 and any((a & b).meta.eq(condition) for a, b in (inputs, inputs[::-1])):
            waiting += inputs
        else:
            yield condition


def _check_words(predicate: pl.Expr | None, schema: Mapping[str, pl.DataType]) -> None:
    """Each word that a column of words is compared with must be one of its own."""
    for condition in conjuncts(predicate):
        inputs = condition.meta.pop()
        kinds = [schema.get(item.meta.output_name()) for item in inputs if item.meta.is_column()]
        words = [pl.select(item).item() for item in inputs if item.meta.is_literal()]
        for kind, word in product(kinds, words):
            if isinstance(kind, pl.Enum) and isinstance(word, str) and word not in kind.categories:
                raise pl.exceptions.InvalidOperationError(f'conversion from `str` to `enum` failed for value "{word}"')
