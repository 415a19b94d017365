"""The error family: one message that names the place, the finding, the expectation and the remedy.

Ends at the command line, at the batch boundary that turns a failed run into a row, and where one part may fail alone.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

# C0 and C1 control characters but the line feed, what turns the direction of writing, and bytes that
# are no UTF-8.
_HIDDEN = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def visible(text: str) -> str:
    """The text with control characters, and bytes that are none, escaped: no log or file name steers a terminal.

    Args:
        text: any text.

    Returns:
        The text without characters that a terminal obeys.
    """
    return _HIDDEN.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class BaliseError(Exception):
    """A condition the user can act on.

    `place` is a file, optionally with topic or column (`gnss.parquet: column t`).
    """

    def __init__(
        self,
        message: str,
        *,
        place: str | None = None,
        found: str | None = None,
        expected: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.message = message
        self.place = place
        self.found = found
        self.expected = expected
        self.remedy = remedy
        super().__init__(message)

    def __str__(self) -> str:
        text = f"{self.place}: {self.message}" if self.place else self.message
        if self.found is not None:
            text += f"; found {self.found}"
        if self.expected is not None:
            text += f"; expected {self.expected}"
        if self.remedy is not None:
            text += self.remedy if text.endswith("\n") else f". {self.remedy}"
        return visible(text)

    def __reduce__(self) -> tuple[object, ...]:
        # Exceptions with keyword-only arguments do not survive the way between processes otherwise.
        state = (self.message, self.place, self.found, self.expected, self.remedy)
        return (_rebuild, (type(self), *state))


def _rebuild(
    kind: type[BaliseError],
    message: str,
    place: str | None,
    found: str | None,
    expected: str | None,
    remedy: str | None,
) -> BaliseError:
    """An error, rebuilt in another process."""
    return kind(message, place=place, found=found, expected=expected, remedy=remedy)


def listed(problems: Sequence[str]) -> str:
    """Problems of one file as one message: a single one as it is, several one below the other.

    Args:
        problems: one sentence each, at least one.

    Returns:
        The message.
    """
    if len(problems) == 1:
        return problems[0]
    return "\n  ".join([f"{len(problems)} problems in this file", *problems]) + "\n"


class UsageError(BaliseError):
    """A command called with arguments that cannot be met (exit 2)."""


class ConfigError(BaliseError):
    """A configuration, vehicle, scenario or fault file that breaks its contract (exit 2)."""


class SiteError(BaliseError):
    """A track, link, balise or route table that breaks its contract (exit 2)."""


class InputError(BaliseError):
    """A recorded log that breaks its contract: that run fails, others go on (exit 1)."""


class OutputError(BaliseError):
    """Results that cannot be written (exit 2)."""
