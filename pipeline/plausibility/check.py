"""What one comparison of two streams says."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class State(StrEnum):
    """Outcome of a check; `impossible`: a known cause explains it, and no train can have it."""

    FITS = "fits"
    MISFIT = "misfit"
    IMPOSSIBLE = "impossible"
    NOT_CHECKED = "not checked"


@dataclass(frozen=True)
class Check:
    """One comparison: `found` in words with figures, its `cause`, and the lines of configuration that mend it.

    `lines` is TOML that can be appended to a file, `into` says to which; `advice` is what to do where no line mends it.
    """

    what: str
    state: State
    found: str
    cause: str = ""
    into: str = ""
    lines: str = ""
    advice: str = ""

    @property
    def sentence(self) -> str:
        """What does not fit, in one sentence."""
        return f"{self.what}: {self.found}" + (f" ({self.cause})" if self.cause else "")


def not_checked(what: str, why: str) -> Check:
    """A check that the data do not allow."""
    return Check(what, State.NOT_CHECKED, why)


def fits(what: str, found: str) -> Check:
    return Check(what, State.FITS, found)
