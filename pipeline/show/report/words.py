"""The words of the pages (`schemas/words.toml`): titles of columns, what values are called for people, drawings."""

from __future__ import annotations

from collections.abc import Sequence

from schemas import words

TITLES: dict[str, str] = words.WORDS["titles"]
WORDS: dict[str, str] = words.WORDS["values"]
OPINIONS: dict[str, str] = words.WORDS["opinions"]


def plots_of(page: str) -> list[tuple[str, str, str]]:
    """Name, title and explanation of the drawings of a page (`run`, `campaign`), in their order."""
    return [(name, plot["title"], plot["text"]) for name, plot in words.WORDS["plots"][page].items()]


def count_words(count: int, singular: str) -> str:
    """`1 balise`, `3 balises`."""
    return f"{count} {singular if count == 1 else singular + 's'}"


def first_names(names: Sequence[str], most: int = 8) -> str:
    """The first of many names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
