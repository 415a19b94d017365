"""Known causes of a factor, a lag or a shift between two recorders, and of positions that are written wrongly."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from pipeline.studies.plausibility.check import Cause
from pipeline.studies.plausibility.robust import Shift
from schemas.arrays import Floats
from schemas.config import PlausibilityConfig
from schemas.enums import MisfitCause

# How many of the unit make a metre, or of the speed a metre per second.
SPEED_UNITS = {
    "km/h": 3.6,
    "mph": 1 / 0.44704,
    "knots": 3600 / 1852,
    "mm/s": 1000.0,
    "cm/s": 100.0,
    "dm/s": 10.0,
    "feet/s": 1 / 0.3048,
    "tenths of km/h": 36.0,
    "hundredths of km/h": 360.0,
    "km/s": 0.001,
    "m/min": 60.0,
    "feet/min": 60 / 0.3048,
    "m/s, but divided by 3.6 as if they were km/h": 1 / 3.6,
    "mph, but converted as if they were km/h": 1 / 0.44704 / 3.6,
    "knots, but converted as if they were km/h": 1 / 1.852,
    "km/h, but converted as if they were mph": 3.6 * 0.44704,
    "km/h, but converted as if they were knots": 3.6 * 1852 / 3600,
    "m/s, but converted as if they were knots": 1852 / 3600,
    "m/s, but converted as if they were mph": 0.44704,
}
WAY_UNITS = {
    "mm": 1000.0,
    "cm": 100.0,
    "dm": 10.0,
    "km": 0.001,
    "hm": 0.01,
    "feet": 1 / 0.3048,
    "yards": 1 / 0.9144,
    "inches": 1 / 0.0254,
    "miles": 1 / 1609.344,
    "nautical miles": 1 / 1852,
}
# A speed that was summed up in its own unit instead of metres per second; cumulative only.
_SUMMED = {
    f"speeds summed up in {unit}": factor for unit, factor in SPEED_UNITS.items() if unit in ("km/h", "mph", "knots")
}
# GPS time is ahead of UTC by so many seconds since (IERS Bulletin C); TAI by 19 s more.
_LEAPS = {2017.0: 18, 2015.5: 17, 2012.5: 16, 2009.0: 15, 2006.0: 14, 1999.0: 13}
TAI_OVER_GPS_S = 19
# Whole ones of these are a cause.
_HOUR_S = 3_600
_DAY_S = 86_400
_WEEK_S = 604_800
_ZONES_S = (_HOUR_S, _HOUR_S // 2)
_ROLL_OVER_WEEKS = 1024


@dataclass(frozen=True)
class Explained:
    """Causes that explain a figure together, and the exact figure they stand for."""

    causes: tuple[Cause, ...]
    exact: float

    def has(self, code: MisfitCause) -> bool:
        return any(cause.code is code for cause in self.causes)


def explain_factor(factor: float, speed: bool, config: PlausibilityConfig) -> Explained | None:
    """The unit that makes recorded values `factor` times what they should be; the nearest one."""
    units = SPEED_UNITS if speed else WAY_UNITS | _SUMMED
    name, exact = min(units.items(), key=lambda item: abs(factor / item[1] - 1.0))
    # A unit so near to 1 that a bad odometer could be taken for it has to be met more exactly.
    near = min(config.unit_share, abs(exact - 1.0) / 3.0)
    return Explained((Cause(MisfitCause.UNIT, (name,)),), exact) if abs(factor / exact - 1.0) <= near else None


def explain_lag(lag_s: float, t_ns: int, precision_s: float, config: PlausibilityConfig) -> Explained | None:
    """What makes two clocks differ by `lag_s`, known to within `precision_s`, at an instant; the simplest cause."""
    size = abs(lag_s)
    for explained in _lags(size, t_ns):
        if abs(size - explained.exact) <= max(precision_s, config.clock_near_s):
            return Explained(explained.causes, explained.exact if lag_s > 0 else -explained.exact)
    return None


def _lags(size_s: float, t_ns: int) -> Iterator[Explained]:
    """Candidates near a lag, the simplest first."""
    leap_s = leap_seconds(t_ns)
    gps = Cause(MisfitCause.GPS_AS_UTC)
    yield Explained((gps,), leap_s)
    yield Explained((Cause(MisfitCause.TAI_AS_GPS),), TAI_OVER_GPS_S)
    yield Explained((Cause(MisfitCause.TAI_AS_UTC),), TAI_OVER_GPS_S + leap_s)
    for extra_s in (0, leap_s, -leap_s):
        for calendar in _calendar(size_s - extra_s, t_ns):
            more = (gps,) if extra_s else ()
            yield Explained(calendar.causes + more, calendar.exact + extra_s)


def _calendar(rest_s: float, t_ns: int) -> Iterator[Explained]:
    """Whole hours, weeks and days near a lag."""
    for zone_s in _ZONES_S:
        count = round(rest_s / zone_s)
        # Clocks on Earth are at most 14 h from each other.
        if count >= 1 and rest_s < 14.5 * _HOUR_S:
            yield Explained((_amount(MisfitCause.TIME_ZONE, f"{count * zone_s / _HOUR_S:g} h"),), count * zone_s)
    if (roll_overs := round(rest_s / (_ROLL_OVER_WEEKS * _WEEK_S))) >= 1:
        weeks = _ROLL_OVER_WEEKS * roll_overs
        yield Explained((_amount(MisfitCause.GPS_WEEK, f"{weeks} weeks"),), weeks * _WEEK_S)
    if (swapped_s := _swapped_s(t_ns)) is not None:
        yield Explained((Cause(MisfitCause.DAY_AND_MONTH),), abs(swapped_s))
    yield from _whole(MisfitCause.WRONG_WEEK, "weeks", rest_s, _WEEK_S)
    yield from _whole(MisfitCause.WRONG_DAY, "days", rest_s, _DAY_S)


def _whole(code: MisfitCause, unit: str, rest_s: float, unit_s: int) -> Iterator[Explained]:
    """Whole weeks or days near a lag, and these with a time zone."""
    if (count := round(rest_s / unit_s)) < 1:
        return
    cause = _amount(code, f"{count} {unit}")
    yield Explained((cause,), count * unit_s)
    if odd := round((rest_s - count * unit_s) / _HOUR_S):
        yield Explained((cause, _amount(MisfitCause.TIME_ZONE, f"{odd:+d} h")), count * unit_s + odd * _HOUR_S)


def _amount(code: MisfitCause, amount: str) -> Cause:
    return Cause(code, (amount,))


def leap_seconds(t_ns: int) -> int:
    """GPS time minus UTC at an instant [s]."""
    year = 1970 + t_ns / 1e9 / 31_556_952
    return next((leap for since, leap in _LEAPS.items() if year >= since), 13)


def _swapped_s(t_ns: int) -> float | None:
    """By how much the date moves if day and month are exchanged [s]; None where no such date exists."""
    date = datetime.fromtimestamp(t_ns // 1_000_000_000, UTC)
    if date.day > 12 or date.day == date.month:
        return None
    return (date.replace(month=date.day, day=date.month) - date).total_seconds()


_RADIAN_DEG = float(np.degrees(1.0))


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
        first, second = first * self.factors.get("latitude_deg", 1.0), second * self.factors.get("longitude_deg", 1.0)
        return (_from_minutes(first), _from_minutes(second)) if self.minutes else (first, second)


def _from_minutes(value: Floats) -> Floats:
    """Degrees of `dd.mmmm`, minutes behind the point, as a recording of NMEA divided by 100 has them."""
    whole = np.trunc(value)
    return np.asarray(whole + (value - whole) * 100.0 / 60.0)


COORDINATE_MISTAKES = (
    CoordinateMistake(MisfitCause.AXES_EXCHANGED, exchanged=True),
    CoordinateMistake(MisfitCause.LONGITUDE_SIGN, {"longitude_deg": -1.0}),
    CoordinateMistake(MisfitCause.LATITUDE_SIGN, {"latitude_deg": -1.0}),
    CoordinateMistake(MisfitCause.BOTH_SIGNS, {"latitude_deg": -1.0, "longitude_deg": -1.0}),
    CoordinateMistake(MisfitCause.RADIANS, {"latitude_deg": _RADIAN_DEG, "longitude_deg": _RADIAN_DEG}),
    CoordinateMistake(MisfitCause.MINUTES, minutes=True),
)

# Geographic systems of national surveys, whose coordinates look like WGS 84 and lie 50 to 700 m from it.
DATUMS = {
    "DHDN (Germany)": 4314,
    "ED50 (Europe)": 4230,
    "Belge 1972": 4313,
    "Amersfoort (Netherlands)": 4289,
    "OSGB36 (Great Britain)": 4277,
    "TM65 (Ireland)": 4299,
    "CH1903 (Switzerland)": 4149,
    "CH1903+ (Switzerland)": 4150,
    "MGI (Austria)": 4312,
    "NTF (France)": 4275,
    "S-JTSK (Czechia, Slovakia)": 4156,
    "Monte Mario (Italy)": 4265,
    "Pulkovo 1942(58)": 4179,
    "Pulkovo 1942": 4284,
    "HD72 (Hungary)": 4237,
    "RT90 (Sweden)": 4124,
    "KKJ (Finland)": 4123,
    "Lisbon (Portugal)": 4207,
    "Datum 73 (Portugal)": 4274,
    "GGRS87 (Greece)": 4121,
    "NAD27 (North America)": 4267,
    "Tokyo (Japan)": 4301,
    "MGI 1901 (former Yugoslavia)": 3906,
}


@dataclass(frozen=True)
class Datum(Shift):
    """A national datum; the shift is that of a survey in it, read as WGS 84, from the positions here."""

    name: str
    epsg: int

    def explains(self, shift: Shift, one_heading: bool, config: PlausibilityConfig) -> bool:
        """Whether it is this shift; of a single heading only the part across it is known."""
        east_m, north_m, size_m = shift.east_m, shift.north_m, shift.shift_m
        across_m = abs((self.east_m - east_m) * east_m + (self.north_m - north_m) * north_m) / size_m
        off_m = across_m if one_heading else self.off_m(shift)
        return off_m < max(config.datum_near_m, config.datum_near_share * size_m)


def datums_at(latitude_deg: float, longitude_deg: float) -> list[Datum]:
    """The national datums in use around a place."""
    # Imported here because it takes a tenth of a second, and hardly any run needs it.
    import pyproj

    found: list[Datum] = []
    geod = pyproj.Geod(ellps="WGS84")
    for name, code in DATUMS.items():
        area = pyproj.CRS.from_epsg(code).area_of_use
        west, south, east, north = (181.0, 0.0, 0.0, 0.0) if area is None else area.bounds
        if not (south <= latitude_deg <= north and west <= longitude_deg <= east):
            continue
        turn = pyproj.Transformer.from_crs(code, 4326, always_xy=True)
        longitude, latitude = turn.transform(longitude_deg, latitude_deg)
        azimuth_deg, _, distance_m = geod.inv(longitude, latitude, longitude_deg, latitude_deg)
        azimuth = np.radians(azimuth_deg)
        found.append(Datum(float(distance_m * np.sin(azimuth)), float(distance_m * np.cos(azimuth)), name, code))
    return found
