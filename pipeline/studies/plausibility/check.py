"""What one comparison says, and the lines of configuration that mend it."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from schemas.enums import MisfitCause, MisfitPlace
from schemas.frozen import frozen
from schemas.run import Stream
from schemas.words import CAUSES, MISFIT_PLACES

CONFIGURATION = "append to the configuration file"
VEHICLE_FILE = "append to the vehicle file"
IN_VEHICLE_FILE = "write instead in the vehicle file"


class FitState(StrEnum):
    """Outcome of a check; `impossible`: a known cause explains it, and no train can have it."""

    FITS = "fits"
    MISFIT = "misfit"
    IMPOSSIBLE = "impossible"
    NOT_CHECKED = "not checked"


@frozen
class Cause:
    """Why two streams do not fit, or in which of the two the cause lies; `figures`: a unit, an amount, a stream."""

    code: MisfitCause | MisfitPlace
    figures: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The cause as a clause."""
        sentence = MISFIT_PLACES[self.code] if isinstance(self.code, MisfitPlace) else CAUSES[self.code]
        return sentence.format(*self.figures)


@frozen
class Check:
    """One comparison: `found` in words with figures, its `causes`, and the lines that mend it.

    `lines` is text for a file, `into` says what to do with it; `advice` is what to do where no line mends it. A misfit
    `of_evidence` is one of the recorders that the judge believes: nothing is proved by them. `leap_s`: by so many whole
    leap seconds the clock of the positions may be off against the recorder's (to be added to their stamps), 0: by none.
    `in_time`: the stream whose clock is that of the positions.
    """

    what: str
    state: FitState
    found: str
    causes: tuple[Cause, ...] = ()
    lines: str = ""
    into: str = CONFIGURATION
    advice: str = ""
    of_evidence: bool = False
    leap_s: int = 0
    in_time: Stream | None = None

    @property
    def sentence(self) -> str:
        """The whole comparison as a sentence."""
        return f"{self.what}: {self.found}" + (f" ({self.cause})" if self.causes else "")

    @property
    def cause(self) -> str:
        """Why it does not fit, and whose fault that is, in words."""
        return ", ".join(cause.words for cause in self.causes)


def misfit(
    what: str, found: str, *codes: MisfitCause, lines: str = "", into: str = CONFIGURATION, advice: str = ""
) -> Check:
    """A misfit of causes that need no figure."""
    return Check(what, FitState.MISFIT, found, tuple(map(Cause, codes)), lines, into, advice)


def not_checked(what: str, why: str) -> Check:
    """A comparison that could not be made."""
    return Check(what, FitState.NOT_CHECKED, why)


def fits(what: str, found: str) -> Check:
    """A comparison that found nothing wrong."""
    return Check(what, FitState.FITS, found)


def correction(
    stream: str,
    factors: Mapping[str, float] | None = None,
    shift_s: float = 0.0,
    exchange: tuple[str, str] | None = None,
    solution: str | None = None,
) -> str:
    """One `[[ingest.correct]]` table, which can be appended to any configuration file."""
    lines = ["[[ingest.correct]]", f'stream = "{stream}"']
    if solution is not None:
        lines.append(f'solution = "{solution}"')
    if exchange is not None:
        lines.append(f'exchange = ["{exchange[0]}", "{exchange[1]}"]')
    if factors:
        lines.append(f"factors = {{ {', '.join(f'{name} = {_number(value)}' for name, value in factors.items())} }}")
    if shift_s:
        lines.append(f"shift_s = {_number(shift_s)}")
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    """A number as TOML has it, a float always."""
    text = repr(round(float(value), 12)) if abs(value) >= 1e-3 else repr(float(value))
    return text if any(sign in text for sign in ".e") else f"{text}.0"
