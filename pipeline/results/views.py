"""Ready-made questions over the tables of a result (`views.toml`): named like tables, answered when they are asked."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.resources import files

import polars as pl

from schemas.frozen import frozen


@frozen
class View:
    """A question: its SQL over tables and other views, and (name, unit, meaning) of the columns of its answer.

    `needs`: the name under which a second result has to be given (`--with old=OUT`); empty for most.
    """

    name: str
    meaning: str
    sql: str
    columns: tuple[tuple[str, str, str], ...]
    needs: str = ""


@cache
def views() -> Mapping[str, View]:
    """All of them by name, each after those that it asks itself."""
    given = tomllib.loads((files("pipeline.results") / "views.toml").read_text(encoding="utf-8"))
    return {
        name: View(name, view["meaning"], view["sql"], tuple(map(tuple, view["columns"])), view.get("needs", ""))
        for name, view in given.items()
    }


def views_in_query(sql: str, prefix: str = "") -> list[View]:
    """The views that a query names, and those that these name, in an order in which each can be answered."""
    named = {view.name for view in views().values() if may_name(sql, f"{prefix}{view.name}")}
    for view in reversed(list(views().values())):
        if view.name in named:
            named |= {other for other in views() if other != view.name and may_name(view.sql, other)}
    return [view for view in views().values() if view.name in named]


def may_name(sql: str, name: str) -> bool:
    """Whether a query may name this table."""
    return re.search(rf"\b{name}\b", sql, re.IGNORECASE) is not None


def answer_views(these: Iterable[View], tables: Mapping[str, pl.LazyFrame]) -> dict[str, pl.LazyFrame]:
    """The views by name, each over the tables and the views before it."""
    known = dict(tables)
    found: dict[str, pl.LazyFrame] = {}
    for view in these:
        found[view.name] = known[view.name] = pl.SQLContext(known).execute(view.sql)
    return found
