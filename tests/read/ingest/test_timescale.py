"""Leap seconds, by instants that IERS Bulletin C and IS-GPS-200 give."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from pipeline.read.ingest.timescale import leap_seconds, utc_from_gps, utc_of_week

# Seconds from 1970-01-01 to the GPS epoch 1980-01-06 by the calendar: 3657 days.
_GPS_EPOCH_S = 3657 * 86_400

# IERS Bulletin C: the first second of each new difference GPS - UTC, all that there were.
_BULLETINS = [
    ("1981-07-01", 1), ("1982-07-01", 2), ("1983-07-01", 3), ("1985-07-01", 4), ("1988-01-01", 5), ("1990-01-01", 6),
    ("1991-01-01", 7), ("1992-07-01", 8), ("1993-07-01", 9), ("1994-07-01", 10), ("1996-01-01", 11),
    ("1997-07-01", 12), ("1999-01-01", 13), ("2006-01-01", 14), ("2009-01-01", 15), ("2012-07-01", 16),
    ("2015-07-01", 17), ("2017-01-01", 18),
]  # fmt: skip


def _utc_s(date: str) -> int:
    return int(datetime.fromisoformat(date).replace(tzinfo=UTC).timestamp())


@pytest.mark.parametrize(("date", "ahead_s"), _BULLETINS)
def test_gps_time_is_ahead_by_one_more_from_the_first_second_of_each_bulletin(date: str, ahead_s: int) -> None:
    utc_s = _utc_s(date)
    assert leap_seconds(utc_s * 10**9) == ahead_s
    assert leap_seconds(utc_s * 10**9 - 1) == ahead_s - 1
    # The second before midnight and midnight, each on the scale of GPS.
    gps = np.array([utc_s - 1 + ahead_s - 1, utc_s + ahead_s], dtype=np.int64) * 10**9
    assert utc_from_gps(gps).tolist() == [(utc_s - 1) * 10**9, utc_s * 10**9]


def test_the_leap_second_itself_is_the_first_of_the_next_day() -> None:
    """23:59:60 has no stamp of its own: it is counted as 00:00:00, and time never runs backwards by more than it."""
    utc_s = _utc_s("2017-01-01")
    gps = (np.arange(-2.0, 3.0, 0.5) + utc_s + 17) * 1e9
    written = utc_from_gps(gps.astype(np.int64)) / 1e9 - utc_s
    assert written.tolist() == [-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 0.0, 0.5, 1.0, 1.5]


@pytest.mark.parametrize(
    ("week", "tow_s", "utc"),
    [
        (0, 0, "1980-01-06T00:00:00"),
        # IS-GPS-200: weeks are counted modulo 1024; these begin anew.
        (1024, 0, "1999-08-21T23:59:47"),
        (2048, 0, "2019-04-06T23:59:42"),
        # Week 1930 began on 2017-01-01 on the scale of GPS, 17 s before it did in UTC, 18 s with the leap second.
        (1930, 17, "2017-01-01T00:00:00"),
        (1930, 18, "2017-01-01T00:00:00"),
        (2356, 115_218, "2025-03-03T08:00:00"),
    ],
)
def test_weeks_and_seconds(week: int, tow_s: int, utc: str) -> None:
    assert utc_of_week(week, tow_s * 10**9) == _utc_s(utc) * 10**9
    assert _utc_s("1980-01-06") == _GPS_EPOCH_S
