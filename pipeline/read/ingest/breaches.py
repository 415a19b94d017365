"""Breaches of an input contract, collected so that one error lists them all."""

from __future__ import annotations

from collections.abc import Sequence

from schemas.errors import InputError, listed


def refuse(breaches: Sequence[InputError]) -> None:
    """Raise one error for all breaches, none if there are none."""
    if not breaches:
        return
    if len(breaches) == 1:
        raise breaches[0]
    remedies = list(dict.fromkeys(breach.remedy for breach in breaches if breach.remedy))
    files = list(dict.fromkeys(str(breach.place).split(": ")[0] for breach in breaches))
    raise InputError(
        listed([line_of(breach) for breach in breaches]),
        place=", ".join(files),
        remedy=" ".join(remedies) or None,
    )


def line_of(breach: InputError) -> str:
    """The breach as one line of an error, without its remedy."""
    return str(InputError(breach.message, place=breach.place, found=breach.found, expected=breach.expected))
