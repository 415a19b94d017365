"""Known causes of a factor or a lag between two recorders."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

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
# Worn wheels, slip and curves: so far may a factor be off the unit that explains it; above the 3 % of bad odometers.
_NEAR = 0.045
# Units so near to 1 that a bad odometer could be taken for them.
_EXACT = 0.035

# Streams are late by so much besides [s].
_LATENCY_S = 2.2
# GPS time is ahead of UTC by so many seconds since (IERS Bulletin C); TAI by 19 s more.
_LEAPS = {2017.0: 18, 2015.5: 17, 2012.5: 16, 2009.0: 15, 2006.0: 14, 1999.0: 13}
TAI_OVER_GPS_S = 19
_DAY_S, _WEEK_S, _HOUR_S = 86_400, 604_800, 3_600
_ROLL_OVER_WEEKS = 1024
_HALF_HOUR_S = 1_800


@dataclass(frozen=True)
class Explained:
    """A cause in words, and the exact figure it stands for."""

    cause: str
    exact: float


def explain_factor(factor: float, speed: bool) -> Explained | None:
    """The unit that makes recorded values `factor` times what they should be; the nearest one."""
    units = SPEED_UNITS if speed else WAY_UNITS | _SUMMED
    name, exact = min(units.items(), key=lambda item: abs(factor / item[1] - 1.0))
    near = _EXACT if abs(exact - 1.0) < 0.15 else _NEAR
    return Explained(f"in {name}", exact) if abs(factor / exact - 1.0) <= near else None


def explain_lag(lag_s: float, t_ns: int, precision_s: float) -> Explained | None:
    """What makes two clocks differ by `lag_s`, known to within `precision_s`, at an instant; the simplest cause."""
    size = abs(lag_s)
    for explained in _lags(size, t_ns):
        if abs(size - explained.exact) <= max(precision_s, _LATENCY_S):
            return Explained(explained.cause, explained.exact if lag_s > 0 else -explained.exact)
    return None


def _lags(size_s: float, t_ns: int) -> Iterator[Explained]:
    """Candidates near a lag, the simplest first."""
    leap_s = leap_seconds(t_ns)
    seconds = {"": 0, " and GPS time taken as UTC": leap_s}
    yield Explained("GPS time taken as UTC", leap_s)
    yield Explained("TAI taken as GPS time", TAI_OVER_GPS_S)
    yield Explained("TAI taken as UTC", TAI_OVER_GPS_S + leap_s)
    for more, extra in seconds.items():
        for sign in (1, -1) if extra else (1,):
            yield from _calendar(size_s - sign * extra, t_ns, sign * extra, more)


def _calendar(rest_s: float, t_ns: int, extra_s: int, more: str) -> Iterator[Explained]:
    """Whole hours, days and weeks near a lag, to which `extra_s` is added."""
    hours = round(rest_s / _HOUR_S)
    if 1 <= hours <= 14:
        yield Explained(f"a time zone or summer time: {hours} h{more}", hours * _HOUR_S + extra_s)
    halves = round(rest_s / _HALF_HOUR_S)
    if 1 <= halves <= 28:
        yield Explained(f"a time zone: {halves / 2:g} h{more}", halves * _HALF_HOUR_S + extra_s)
    roll_overs = round(rest_s / (_ROLL_OVER_WEEKS * _WEEK_S))
    if roll_overs >= 1:
        cause = f"a roll-over of the GPS week: {_ROLL_OVER_WEEKS * roll_overs} weeks{more}"
        yield Explained(cause, roll_overs * _ROLL_OVER_WEEKS * _WEEK_S + extra_s)
    if (swapped_s := _swapped_s(t_ns)) is not None:
        yield Explained(f"day and month exchanged{more}", abs(swapped_s) + extra_s)
    weeks, days = round(rest_s / _WEEK_S), round(rest_s / _DAY_S)
    if weeks >= 1:
        yield Explained(f"a wrong week: {weeks} weeks{more}", weeks * _WEEK_S + extra_s)
    if days >= 1:
        yield Explained(f"a wrong day, or a roll-over of it: {days} days{more}", days * _DAY_S + extra_s)
    if days >= 1 and (odd := round((rest_s - days * _DAY_S) / _HOUR_S)):
        cause = f"a wrong day and a time zone: {days} days {odd:+d} h{more}"
        yield Explained(cause, days * _DAY_S + odd * _HOUR_S + extra_s)


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
