"""Column constructors of the table contracts: a dtype with its unit, meaning and golden-file tolerance.

`metadata["unit"]` documents; `metadata["tolerance"]` is the absolute tolerance by which
two results of the same input may differ before it counts as a change (floats only).
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

import dataframely as dy

_TOLERANCE_BY_UNIT = {
    "m": 1e-6,
    "m2": 1e-6,
    "m2/s": 1e-9,
    "m/s": 1e-6,
    "km/h": 1e-6,
    "s": 1e-6,
    "deg": 1e-10,
    "h": 1e-6,
    "1/h": 1e-9,
    "Hz": 1e-9,
    "1": 1e-9,
    "1/m": 1e-9,
}


def real(unit: str, meaning: str, **rules: Any) -> dy.Float64:
    """A nullable float.

    Args:
        unit: unit of the values, one of those with a tolerance.
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    rules.setdefault("nullable", True)
    metadata = {"unit": unit, "tolerance": rules.pop("tolerance", _TOLERANCE_BY_UNIT[unit])}
    return dy.Float64(description=meaning, metadata=metadata, **rules)


def count(meaning: str, **rules: Any) -> dy.Int64:
    """A number of things, never negative, never null unless said so.

    Args:
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.Int64(description=meaning, metadata={"unit": "1"}, min=0, **rules)


def flag(meaning: str, **rules: Any) -> dy.Bool:
    """A boolean.

    Args:
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.Bool(description=meaning, **rules)


def text(meaning: str, **rules: Any) -> dy.String:
    """A string.

    Args:
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.String(description=meaning, **rules)


def texts(meaning: str, **rules: Any) -> dy.List:
    """A list of strings.

    Args:
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.List(dy.String(nullable=False), description=meaning, **rules)


def counts(meaning: str, **rules: Any) -> dy.List:
    """A list of numbers of things.

    Args:
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.List(dy.Int64(nullable=False, min=0), description=meaning, metadata={"unit": "1"}, **rules)


def reals(unit: str, meaning: str, **rules: Any) -> dy.List:
    """A list of floats.

    Args:
        unit: unit of the values.
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.List(dy.Float64(nullable=False), description=meaning, metadata={"unit": unit}, **rules)


def ones_of(kind: type[StrEnum], meaning: str, **rules: Any) -> dy.List:
    """A list of values of an enumeration.

    Args:
        kind: the closed set of values.
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    inner = dy.Enum([member.value for member in kind], nullable=False)
    return dy.List(inner, description=meaning, **rules)


def one_of(kind: type[StrEnum], meaning: str, **rules: Any) -> dy.Enum:
    """A value of an enumeration.

    Args:
        kind: the closed set of values.
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.Enum([member.value for member in kind], description=meaning, **rules)


def instant(meaning: str, **rules: Any) -> dy.Datetime:
    """GNSS time of validity, UTC, nanoseconds.

    Args:
        meaning: what the column says, in a sentence.
        rules: as in dataframely (`nullable=False`, `min`, `max`).

    Returns:
        The column.
    """
    return dy.Datetime(time_unit="ns", time_zone="UTC", description=meaning, metadata={"unit": "UTC"}, **rules)
