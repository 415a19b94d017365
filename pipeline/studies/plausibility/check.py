"""What one comparison says, its known causes (their figures are in `causes.toml`), and the lines that mend it."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from enum import StrEnum
from importlib.resources import files

import numpy as np
from pydantic import BaseModel, ConfigDict

from pipeline.read.ingest.timescale import leap_seconds
from schemas.arrays import NS_PER_S, Floats
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


# Worn wheels, slip and curves: so far may a factor be off the unit that explains it; bad odometers are off by 3 %.
_UNIT_SHARE = 0.045
# Streams are late by so much beyond what explains the lag of a clock.
_CLOCK_NEAR_S = 2.2
# A few independent errors show a sigma to so much.
_ACCURACY_TIMES = 2.5


class _Fact(BaseModel):
    """An entry of `causes.toml`, with no keys but those named."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ClockStep(_Fact):
    """Clocks are wrong by 1 to `most` times `step_s`; stated in `unit`."""

    code: MisfitCause
    step_s: int
    most: int
    unit: str
    unit_s: int


class CoordinateMistake(_Fact):
    """A mistake in writing positions; `factors` and `exchanged` mend it, as `[[ingest.correct]]` can, but minutes."""

    code: MisfitCause
    factors: dict[str, float] = {}
    exchanged: bool = False
    minutes: bool = False

    def mended(self, latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Floats]:
        """Latitude and longitude [deg] without it."""
        first, second = (longitude_deg, latitude_deg) if self.exchanged else (latitude_deg, longitude_deg)
        first = first * self.factors.get("latitude_deg", 1.0)
        second = second * self.factors.get("longitude_deg", 1.0)
        return (_from_minutes(first), _from_minutes(second)) if self.minutes else (first, second)


def _from_minutes(value: Floats) -> Floats:
    """Degrees of `dd.mmmm`, minutes behind the point, as a recording of NMEA divided by 100 has them."""
    whole = np.trunc(value)
    return np.asarray(whole + (value - whole) * 100.0 / 60.0)


class KnownCauses(_Fact):
    """All of `causes.toml`: units as how many of them make a metre (per second)."""

    speed_units: dict[str, float]
    distance_units: dict[str, float]
    accuracy_units: dict[str, float]
    clock_steps: tuple[ClockStep, ...]
    coordinate_mistakes: tuple[CoordinateMistake, ...]


KNOWN = KnownCauses.model_validate(tomllib.loads((files(__package__) / "causes.toml").read_text(encoding="utf-8")))


def explain_factor(factor: float, speed: bool) -> tuple[Cause, float] | None:
    """The unit that makes recorded values `factor` times what they should be, and its exact factor; the nearest one."""
    units = KNOWN.speed_units if speed else KNOWN.distance_units
    name, exact = min(units.items(), key=lambda unit: abs(factor / unit[1] - 1.0))
    # A unit so near to 1 that a bad odometer could be taken for it has to be matched more exactly.
    near = min(_UNIT_SHARE, abs(exact - 1.0) / 3.0)
    return (Cause(MisfitCause.UNIT, (name,)), exact) if abs(factor / exact - 1.0) <= near else None


def explain_accuracy(factor: float, stated_m: float) -> Cause | None:
    """What makes true deviations `factor` times the stated ones, of which the median is `stated_m`; the nearest one."""
    known = {Cause(MisfitCause.SIGMA_UNIT, (name,)): size for name, size in KNOWN.accuracy_units.items()}
    # Read as a variance, a sigma s gives sqrt(s); read as a sigma, a variance v = s^2 gives v.
    known[Cause(MisfitCause.SIGMA_FOR_VARIANCE)] = stated_m
    known[Cause(MisfitCause.VARIANCE_FOR_SIGMA)] = 1.0 / np.sqrt(stated_m)
    away = {cause: abs(np.log(factor / size)) for cause, size in known.items()}
    nearest = min(away, key=lambda cause: away[cause])
    return nearest if away[nearest] < np.log(_ACCURACY_TIMES) else None


def explain_lag(lag_s: float, t_ns: int, precision_s: float) -> tuple[Cause, float] | None:
    """What makes two clocks differ by `lag_s`, known to within `precision_s`, at an instant, and the exact lag."""
    near_s = max(precision_s, _CLOCK_NEAR_S)
    leap_s = leap_seconds(t_ns)
    if abs(abs(lag_s) - leap_s) <= near_s:
        return Cause(MisfitCause.GPS_AS_UTC), float(np.copysign(leap_s, lag_s))
    for step in KNOWN.clock_steps:
        count = round(abs(lag_s) / step.step_s)
        size_s = count * step.step_s
        rest_s = abs(lag_s) - size_s
        leaps_s = min(_possible_leaps(step, size_s, t_ns), key=lambda known_s: abs(rest_s - known_s))
        if 1 <= count <= step.most and abs(rest_s - leaps_s) <= near_s:
            words = f"{size_s / step.unit_s:g} {step.unit}" + (f" and {leaps_s:+d} s" if leaps_s else "")
            return Cause(step.code, (words,)), float(np.copysign(size_s + leaps_s, lag_s))
    return None


def _possible_leaps(step: ClockStep, size_s: int, t_ns: int) -> list[int]:
    """Seconds by which a clock is off besides such a step: a receiver that is weeks behind takes the leap seconds of a
    wrong day, or none. The recorder that `t_ns` is of may be the one of the right day or of the wrong one.
    """
    if step.code is not MisfitCause.GPS_WEEK:
        return [0]
    here_s = leap_seconds(t_ns)
    there_s = [leap_seconds(t_ns + sign * size_s * NS_PER_S) for sign in (-1, 1)]
    counts = {here_s, *there_s, *(here_s - other_s for other_s in there_s)} - {0}
    return [0, *(sign * count for count in sorted(counts) for sign in (-1, 1))]
