"""Columns of tables on a page: titles and units from their names, meanings from their contract, values with bounds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import dataframely as dy
import polars as pl

from pipeline.show.report.markup import UNKNOWN, Cell, number, table, value_cell
from pipeline.show.report.words import OPINIONS, TITLES, WORDS
from pipeline.stages.run_row.bounds import bound_columns

Row = Mapping[str, Any]
Special = Mapping[str, Callable[[Row], Cell]]
"""How the cells of some columns are made."""

_UNITS = {"_per_h": "1/h", "_mps": "m/s", "_hz": "Hz", "_m": "m", "_s": "s", "_h": "h"}
_MOST_NAMES = 8
# A table shows 2,000 runs: what is `bad` or in `doubt` above zero, and which words look how.
_TONES = {
    **dict.fromkeys(("unsafe_accepted", "failures_beyond_budget", "missed_detections", "exceeded"), "bad"),
    **dict.fromkeys(("accepted_ids", "common_missed"), "bad"),
    **dict.fromkeys(("unproven_accepted", "share_unknown", "unknown"), "doubt"),
    **dict.fromkeys(("lost", "missed", "not_available", "false_alarms"), "lost"),
}
_WORD_TONES = {"wrong": "bad", "exceeded": "bad", "unknown": "doubt", "right": "good", "kept": "good"}


def frame_table(
    identity: str,
    caption: str,
    frame: pl.DataFrame,
    names: Sequence[str] = (),
    contract: type[dy.Schema] | None = None,
    special: Special | None = None,
) -> str:
    """A frame as a table; `names`: all columns unless said otherwise. Bounds are next to their figure."""
    special = special or {}
    shown = list(names) or _figure_names(frame.columns)
    bounds = bound_columns(frame.columns)
    meanings = _column_meanings(contract)
    rows = [
        [special[name](row) if name in special else _value_cell(row, name, bounds.get(name)) for name in shown]
        for row in frame.iter_rows(named=True)
    ]
    return table(identity, caption, [(column_title(name), meanings.get(name, "")) for name in shown], rows)


def figures_table(identity: str, caption: str, row: Row, contract: type[dy.Schema]) -> str:
    """One row as a table downwards: the name of each column as in the data, its value with unit and bounds, and what
    it means.
    """
    meanings = _column_meanings(contract)
    bounds = bound_columns(row)
    rows = [
        [Cell(name, name), Cell(_value_text(row, name, bounds.get(name))), Cell(meanings[name], meanings[name])]
        for name in _figure_names(row)
    ]
    return table(identity, caption, [("figure", "column in the data"), ("value", ""), ("meaning", "")], rows)


def _figure_names(names: Collection[str]) -> list[str]:
    """The columns that are no bounds of others."""
    bounds = {bound for pair in bound_columns(names).values() for bound in pair}
    return [name for name in names if name not in bounds]


def _column_meanings(contract: type[dy.Schema] | None) -> dict[str, str]:
    """Meanings of the columns of a contract."""
    columns = {} if contract is None else contract.columns()
    return {name: column.description or "" for name, column in columns.items()}


def _split_unit(name: str) -> tuple[str, str]:
    """A column's name without its unit, and the ending that says the unit."""
    ending = next((ending for ending in _UNITS if name.endswith(ending)), "")
    return name.removesuffix(ending), ending


def column_title(name: str) -> str:
    """A column's title for people."""
    if name in TITLES:
        return TITLES[name]
    stem, ending = _split_unit(name)
    words = stem.replace("_", " ")
    return f"{words} [{_UNITS[ending]}]" if ending else words


def _value_cell(row: Row, name: str, bounds: tuple[str, str] | None) -> Cell:
    """A value of a column as a cell, with its bounds."""
    value = row[name]
    if bounds:
        return Cell(_bounded_text(value, row[bounds[0]], row[bounds[1]], UNKNOWN), value)
    if isinstance(value, list) and len(value) > _MOST_NAMES:
        value = [*value[:_MOST_NAMES], f"and {len(value) - _MOST_NAMES} more"]
    plain = value_cell(value, 4)
    if isinstance(value, str):
        opinion = name == "suspect"
        words = (OPINIONS if opinion else WORDS).get(value, value)
        return Cell(words, value, tone="" if opinion else _WORD_TONES.get(value, ""))
    return Cell(plain.text, plain.order, tone=_cell_tone(name, value))


def _cell_tone(name: str, value: object) -> str:
    """Tone of a value: bad, in doubt, or none."""
    if name == "within_budget":
        return "bad" if value is False else ""
    return _TONES.get(name, "") if value else ""


def _value_text(row: Row, name: str, bounds: tuple[str, str] | None) -> str:
    """A value of a column with bounds and unit, as text."""
    value = row[name]
    unit = _UNITS.get(_split_unit(name)[1], "")
    if bounds:
        text = _bounded_text(value, row[bounds[0]], row[bounds[1]], "not known")
    else:
        text = "not known" if value is None else value_cell(value, 4).text
    return text if text == "not known" else f"{text} {unit}".strip()


def _bounded_text(value: float | None, low: float | None, high: float | None, unknown: str) -> str:
    """A figure with its 95 % bounds; `at least` where only the lower one is known."""
    if value is None:
        return unknown if low is None else f"at least {number(low)}"
    return f"{number(value)} (95 %: {number(low)} to {number(high)})"
