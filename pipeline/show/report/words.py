"""The words of the pages (`words.toml`): titles of columns, what values are called for people, drawings."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

_FILE: dict[str, Any] = tomllib.loads((files("pipeline.show.report") / "words.toml").read_text(encoding="utf-8"))
TITLES: dict[str, str] = _FILE["titles"]
WORDS: dict[str, str] = _FILE["values"]
OPINIONS: dict[str, str] = _FILE["opinions"]


def plots_of(page: str) -> list[tuple[str, str, str]]:
    """Name, title and explanation of the drawings of a page (`run`, `campaign`), in their order."""
    return [(name, plot["title"], plot["told"]) for name, plot in _FILE["plots"][page].items()]


def plural(count: int, one: str) -> str:
    """`1 balise`, `3 balises`."""
    return f"{count} {one if count == 1 else one + 's'}"


def some_of(names: Sequence[str], most: int = 8) -> str:
    """The first of many names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
