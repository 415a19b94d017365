"""Known causes of a factor, a lag or a shift between two recorders; their figures are in `causes.toml`."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np

from pipeline.studies.plausibility.check import KnownCause
from pipeline.studies.plausibility.robust import Shift
from schemas.arrays import Floats
from schemas.enums import MisfitCause

_KNOWN: dict[str, Any] = tomllib.loads((files(__package__) / "causes.toml").read_text(encoding="utf-8"))
# Worn wheels, slip and curves: so far may a factor be off the unit that explains it; bad odometers are off by 3 %.
_UNIT_SHARE = 0.045
# Streams are late by so much beside what explains the lag of a clock.
_CLOCK_NEAR_S = 2.2
# A survey is in a national datum if its shift is so near to the datum's: transformations differ by some metres.
_DATUM_NEAR_M = 12.0
_DATUM_NEAR_SHARE = 0.12


@dataclass(frozen=True)
class Explained:
    """Causes that explain a figure together, and the exact figure they stand for."""

    causes: tuple[KnownCause, ...]
    exact: float


def explain_factor(factor: float, speed: bool) -> Explained | None:
    """The unit that makes recorded values `factor` times what they should be; the nearest one."""
    units: dict[str, float] = _KNOWN["speed_units" if speed else "way_units"]
    name, exact = min(units.items(), key=lambda unit: abs(factor / unit[1] - 1.0))
    # A unit so near to 1 that a bad odometer could be taken for it has to be met more exactly.
    near = min(_UNIT_SHARE, abs(exact - 1.0) / 3.0)
    return Explained((KnownCause(MisfitCause.UNIT, (name,)),), exact) if abs(factor / exact - 1.0) <= near else None


def explain_lag(lag_s: float, t_ns: int, precision_s: float) -> Explained | None:
    """What makes two clocks differ by `lag_s`, known to within `precision_s`, at an instant; the simplest cause."""
    size_s = abs(lag_s)
    near_s = max(precision_s, _CLOCK_NEAR_S)
    explained = next((cause for cause in _lags(size_s, t_ns) if abs(size_s - cause.exact) <= near_s), None)
    return explained and Explained(explained.causes, float(np.copysign(explained.exact, lag_s)))


def _lags(size_s: float, t_ns: int) -> Iterator[Explained]:
    """Candidates near a lag, the simplest first: leap seconds, then steps of the clock without and with them."""
    leap_s = leap_seconds(t_ns)
    gps = KnownCause(MisfitCause.GPS_AS_UTC)
    yield Explained((gps,), leap_s)
    for extra_s in (0, leap_s, -leap_s):
        for step in _KNOWN["clock_steps"]:
            count = round((size_s - extra_s) / step["step_s"])
            if 1 <= count <= step["most"]:
                amount = f"{count * step['step_s'] / step['unit_s']:g} {step['unit']}"
                cause = KnownCause(MisfitCause(step["code"]), (amount,))
                yield Explained((cause, gps) if extra_s else (cause,), count * step["step_s"] + extra_s)


def leap_seconds(t_ns: int) -> int:
    """GPS time minus UTC at an instant [s]."""
    year = 1970 + t_ns / 1e9 / 31_556_952
    return next((leap for since, leap in _KNOWN["leap_seconds"].items() if year >= float(since)), 13)


@dataclass(frozen=True)
class CoordinateMistake:
    """A way to write positions wrongly; `factors` and `exchanged` mend it, as `[[ingest.correct]]` can, but minutes."""

    code: MisfitCause
    factors: Mapping[str, float] = field(default_factory=dict)
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


COORDINATE_MISTAKES = tuple(
    CoordinateMistake(**{**mistake, "code": MisfitCause(mistake["code"])}) for mistake in _KNOWN["coordinate_mistakes"]
)


@dataclass(frozen=True)
class Datum(Shift):
    """A national datum; the shift is that of a survey in it, read as WGS 84, from the positions here."""

    name: str
    epsg: int

    def explains(self, shift: Shift, one_heading: bool) -> bool:
        """Whether it is this shift; of a single heading only the part across it is known."""
        apart_m = np.array([self.east_m - shift.east_m, self.north_m - shift.north_m])
        across = np.array([shift.east_m, shift.north_m]) / shift.shift_m
        off_m = abs(float(apart_m @ across)) if one_heading else self.off_m(shift)
        return off_m < max(_DATUM_NEAR_M, _DATUM_NEAR_SHARE * shift.shift_m)


def datums_at(latitude_deg: float, longitude_deg: float) -> Iterator[Datum]:
    """The national datums in use around a place."""
    import pyproj  # takes a tenth of a second, and hardly any run needs it

    geod = pyproj.Geod(ellps="WGS84")
    for name, code in _KNOWN["datums"].items():
        area = pyproj.CRS.from_epsg(code).area_of_use
        west, south, east, north = (181.0, 0.0, 0.0, 0.0) if area is None else area.bounds
        if south <= latitude_deg <= north and west <= longitude_deg <= east:
            turn = pyproj.Transformer.from_crs(code, 4326, always_xy=True)
            longitude, latitude = turn.transform(longitude_deg, latitude_deg)
            azimuth_deg, _, distance_m = geod.inv(longitude, latitude, longitude_deg, latitude_deg)
            azimuth = np.radians(azimuth_deg)
            yield Datum(float(distance_m * np.sin(azimuth)), float(distance_m * np.cos(azimuth)), name, code)
