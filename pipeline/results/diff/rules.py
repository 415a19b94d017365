"""What two results may differ in: tolerances of columns, and columns that are left out, of a command or a file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated

import dataframely as dy
import polars as pl
from pydantic import Field

from schemas.config import Settings, settings_from, toml_of
from schemas.errors import UsageError
from schemas.frozen import frozen
from schemas.near import nearest
from schemas.tables import TABLES


class RulesFile(Settings):
    """`diff.toml`: columns as `availability`, in every table, or `runs.availability`; tolerances in their unit."""

    tolerance: dict[str, Annotated[float, Field(ge=0, allow_inf_nan=False)]] = Field(default={})
    ignore: tuple[str, ...] = ()


@frozen
class Rules:
    """`tolerances` and `ignored` by `(table, column)`; a column without a tolerance has that of the contract."""

    tolerances: Mapping[tuple[str, str], float] = field(default_factory=dict)
    ignored: frozenset[tuple[str, str]] = frozenset()

    def tolerance(self, table: str, name: str, column: dy.Column | None) -> float:
        """Absolute tolerance of a column [its unit]; zero where neither a rule nor the contract names one."""
        of_contract = float((column.metadata or {}).get("tolerance", 0.0)) if column is not None else 0.0
        return self.tolerances.get((table, name), of_contract)

    def compared_columns(self, table: str, frame: pl.DataFrame) -> pl.DataFrame:
        """The columns that are compared."""
        return frame.drop([name for of_table, name in self.ignored if of_table == table], strict=False)


def rules_of(tolerances: Iterable[str], ignored: Iterable[str], file: Path | None) -> Rules:
    """`COLUMN=VALUE` and columns as given with the command, on top of those of a file. Raises `UsageError`."""
    given = RulesFile() if file is None else _read_rules(file)
    allowed = dict(given.tolerance)
    for text in tolerances:
        column, _, allowance = text.partition("=")
        allowed[column] = _number(allowance, f"--tolerance {text}")
    found: dict[tuple[str, str], float] = {}
    for name, value in allowed.items():
        for table, column in _places_of_column(name):
            if not isinstance(TABLES[table].columns()[column], dy.Float64 | dy.Int64):
                raise UsageError("is no number", place=f"tolerance of {name}", remedy="Leave it out with --ignore.")
            found[table, column] = value
    left_out = frozenset(place for name in (*given.ignore, *ignored) for place in _places_of_column(name))
    keys = sorted({column for _, column in left_out} & {"solution", "t"})
    if keys:
        raise UsageError("tells the rows apart", place=f"--ignore {keys[0]}", expected="a column of figures")
    return Rules(found, left_out)


def _read_rules(file: Path) -> RulesFile:
    """A file of rules."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise UsageError(f"cannot be read: {error.strerror}", place=str(file)) from None
    return settings_from(toml_of(content, str(file)), RulesFile, str(file))


def _number(text: str, place: str) -> float:
    """A number, or a refusal that names its place."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value < math.inf:
        raise UsageError("is no tolerance", place=place, expected="COLUMN=VALUE, for example availability=0.001")
    return value


def _places_of_column(name: str) -> list[tuple[str, str]]:
    """The places of a column: one table where the name says which, else all that have it."""
    table, _, column = name.rpartition(".")
    among = TABLES if not table else {table: TABLES[table]} if table in TABLES else {}
    places = [(of_table, column) for of_table, schema in among.items() if column in schema.columns()]
    if not places:
        known = {f"{of_table}." * bool(table) + one for of_table, schema in TABLES.items() for one in schema.columns()}
        near = " or ".join(f"`{one}`" for one in nearest(name, known))
        raise UsageError(f"there is no column {name} (did you mean {near}?)", place="tolerance or ignore")
    return places
