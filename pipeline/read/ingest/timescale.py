"""Time scales: everything inside is UTC, nanoseconds since 1970."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from schemas.arrays import Ints

# First moments of a new difference GPS - UTC (IERS Bulletin C): 1 s in July 1981 to 18 s in January 2017.
_LEAPS = (
    (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7),
    (1994, 7), (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
)  # fmt: skip
_LEAP_UTC_NS = np.array(
    [int(datetime(year, month, 1, tzinfo=UTC).timestamp()) * 1_000_000_000 for year, month in _LEAPS],
    dtype=np.int64,
)
# The same moments on the GPS scale: by then the new second has been counted.
_LEAP_GPS_NS = _LEAP_UTC_NS + np.arange(1, len(_LEAPS) + 1, dtype=np.int64) * 1_000_000_000

WEEK_NS = 7 * 86_400 * 1_000_000_000
# IS-GPS-200, 3.3.4: GPS time starts at 1980-01-06T00:00:00 UTC.
GPS_EPOCH_NS = int(datetime(1980, 1, 6, tzinfo=UTC).timestamp()) * 1_000_000_000


def utc_from_gps(t_ns: Ints) -> Ints:
    """UTC of stamps whose calendar runs on GPS time (no leap seconds) [ns since 1970]."""
    leaps = np.searchsorted(_LEAP_GPS_NS, t_ns, side="right")
    return t_ns - leaps.astype(np.int64) * 1_000_000_000


def leap_seconds(utc_ns: int) -> int:
    """GPS time minus UTC at an instant [s]."""
    return int(np.searchsorted(_LEAP_UTC_NS, utc_ns, side="right"))


def utc_of_week(week: int, tow_ns: int) -> int:
    """UTC of a time of the week on the GPS scale [ns since 1970]."""
    return int(utc_from_gps(np.array([GPS_EPOCH_NS + week * WEEK_NS + tow_ns], dtype=np.int64))[0])
