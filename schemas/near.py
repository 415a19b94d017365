"""What somebody may have meant by a name that does not exist."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_ALIKE = 0.6
_SHOWN = 3


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """The three that are most like a name, by its words and by its letters, however unlike they are.

    Args:
        name: what was written.
        known: the names there are.

    Returns:
        Three names at most, the most alike first.
    """

    def unlike(item: str) -> tuple[float, str]:
        """Sort key, lower where a name is more alike: letters in common and share of words in common."""
        words, others = (set(text.lower().split("_")) for text in (name, item))
        letters = difflib.SequenceMatcher(None, name.lower(), item.lower()).ratio()
        return -letters - len(words & others) / len(words | others), item

    return sorted(known, key=unlike)[:_SHOWN]


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """` (did you mean `antenna_height_m`?)` to put behind a message; empty where nothing is alike.

    Args:
        name: what was written.
        known: the names there are.

    Returns:
        The end of a message, with a space before it, or nothing.
    """
    by_lower = {item.lower(): item for item in known}
    near = difflib.get_close_matches(name.lower(), list(by_lower), n=_SHOWN, cutoff=_ALIKE)
    if not near:
        near = [item for item in by_lower if len(name) > 2 and name.lower() in item][:_SHOWN]
    return f" (did you mean {' or '.join(f'`{by_lower[item]}`' for item in near)}?)" if near else ""
