"""Breaches of an input contract, collected so that one error lists them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from schemas.errors import InputError, listed


@dataclass(frozen=True)
class Breach:
    """One departure from the contract; `place` is a file with topic or column."""

    place: str
    message: str
    found: str | None = None
    expected: str | None = None
    remedy: str | None = None


def refuse(breaches: Sequence[Breach]) -> None:
    """Raise one error for all breaches, none if there are none."""
    if not breaches:
        return
    if len(breaches) == 1:
        raise _as_error(breaches[0])
    remedies = list(dict.fromkeys(breach.remedy for breach in breaches if breach.remedy))
    raise InputError(
        listed([line_of(breach) for breach in breaches]),
        place=_common_place(breaches),
        remedy=" ".join(remedies) or None,
    )


def _as_error(breach: Breach) -> InputError:
    return InputError(
        breach.message,
        place=breach.place,
        found=breach.found,
        expected=breach.expected,
        remedy=breach.remedy,
    )


def line_of(breach: Breach) -> str:
    """The breach as one line of an error."""
    text = f"{breach.place}: {breach.message}"
    if breach.found is not None:
        text += f"; found {breach.found}"
    if breach.expected is not None:
        text += f"; expected {breach.expected}"
    return text


def _common_place(breaches: Sequence[Breach]) -> str:
    files = list(dict.fromkeys(breach.place.split(": ")[0] for breach in breaches))
    return ", ".join(files)
