"""Times of validity from what messages and records hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Literal

import polars as pl

from pipeline.read.ingest.timescale import GPS_EPOCH_NS, WEEK_NS, utc_from_gps
from schemas.arrays import NS_PER_S
from schemas.config import StreamMapping
from schemas.frozen import frozen

LATEST_NS = int(datetime(2200, 1, 1, tzinfo=UTC).timestamp()) * NS_PER_S  # leaves room in 64 bits for the GPS epoch
_DAY_S = 86_400
# 1970 in what is counted from other epochs: spreadsheets count days from 1899-12-30.
_EPOCHS_NS = {"unix": 0, "gps": GPS_EPOCH_NS, "excel": -25_569 * _DAY_S * NS_PER_S}
# Days of Excel in the years 1954 and 2119.
LEAST_DAY, MOST_DAY = 20_000, 80_000
LOG_TIME = "(log time)"
PUBLISH_TIME = "(publish time)"
_SECONDS = ("sec", "secs", "seconds")
_NANOSECONDS = ("nanosec", "nsec", "nsecs", "nanos")
# How fields are read that may hold a time, by what their first value is.
TIME_KINDS: Mapping[str, pl.DataType] = {"int": pl.Int64(), "float": pl.Float64(), "text": pl.String()}


@frozen
class TimeSource:
    """Fields of a stamp and what they count: whole `unit_s` since the epoch of `epoch` on `scale`."""

    fields: tuple[str, ...]
    types: Mapping[str, pl.DataType]
    unit_s: float | None = None
    scale: Literal["utc", "gps"] = "utc"
    epoch: Literal["unix", "gps", "excel"] = "unix"

    def of_field(self, path: str, other: str) -> TimeSource:
        """The same kind of stamp in another field of the message."""
        fields = tuple(other + name.removeprefix(path) for name in self.fields)
        types = dict(zip(fields, (self.types.get(name, pl.Int64()) for name in self.fields), strict=True))
        return replace(self, fields=fields, types=types)

    def instants(self, frame: pl.DataFrame, name: str) -> pl.Series:
        """Times in UTC; null where a part of the stamp is null, and where the date is one that no trial can have.

        Raises ValueError where the nanoseconds of a stamp make a second or more: it contradicts itself.
        """
        counted = self._parse_nanoseconds(frame).alias(name)
        epoch_ns = _EPOCHS_NS[self.epoch]
        return utc_of(counted + epoch_ns if epoch_ns else counted, self.scale)

    def _parse_nanoseconds(self, frame: pl.DataFrame) -> pl.Series:
        """Nanoseconds since 1970, or of the stamp's own epoch."""
        first = frame[self.fields[0]]
        if len(self.fields) == 2:
            rest = frame[self.fields[1]]
            if not _all_between(rest, 0, NS_PER_S - 1):
                row = int((~rest.is_between(0, NS_PER_S - 1).fill_null(True)).arg_max() or 0)
                raise ValueError(f"{rest[row]} nanoseconds beside whole seconds in message {row} of the topic")
            return counts_within(first, NS_PER_S) * NS_PER_S + rest
        dtype = self.types.get(self.fields[0], pl.Int64())
        if dtype == pl.String:
            # Beyond 64 bits polars goes round without a word, so the date is read in microseconds before.
            date = first.str.to_datetime("%+", time_unit="us", time_zone="UTC", strict=True).to_physical()
            t = first.str.to_datetime("%+", time_unit="ns", time_zone="UTC", strict=True).to_physical()
            return t.set(counts_within(date, 1000).is_null(), None)
        if dtype == pl.Int64:
            unit_ns = 1 if self.unit_s is None else round(self.unit_s * 1e9)
            return counts_within(first, unit_ns) * unit_ns
        return counts_within((first * ((1.0 if self.unit_s is None else self.unit_s) * 1e9)).round(), 1).cast(pl.Int64)


def utc_of(t_ns: pl.Series, scale: str) -> pl.Series:
    """UTC of nanoseconds since 1970 on the scale `utc` or `gps`."""
    if scale == "gps":
        utc = pl.Series(t_ns.name, utc_from_gps(t_ns.fill_null(0).to_numpy()))
        t_ns = utc.set(t_ns.is_null(), None) if t_ns.null_count() else utc
    return t_ns.cast(pl.Datetime("ns", "UTC"))


def gps_ns_of_weeks(week: pl.Series, tow_s: pl.Series) -> pl.Series:
    """Nanoseconds since 1970 on the GPS scale of weeks and seconds in them, to microseconds; null beyond both."""
    in_week_us = (tow_s.set(~tow_s.is_between(0.0, WEEK_NS / NS_PER_S), None) * 1e6).round()
    return GPS_EPOCH_NS + counts_within(week, WEEK_NS) * WEEK_NS + in_week_us.cast(pl.Int64) * 1000


def orders_of_day(first: pl.Series, second: pl.Series) -> list[str]:
    """The orders of day and month that all rows allow."""
    months = {"day_first": second, "month_first": first}
    return [order for order, month in months.items() if (month.drop_nulls() <= 12).all()]


def day_is_unclear(first: pl.Series, second: pl.Series) -> bool:
    """Whether the dates do not tell which is the day, and it matters: 03/03 is one day in both orders."""
    return len(orders_of_day(first, second)) > 1 and bool((first != second).any())


def counts_within(counts: pl.Series, unit_ns: int) -> pl.Series:
    """The counts of a unit since an epoch, null before it and after `LATEST_NS`: nothing then overflows 64 bits."""
    most = LATEST_NS // max(unit_ns, 1)
    return counts if _all_between(counts, 0, most) else counts.set(~counts.is_between(0, most), None)


def _all_between(counts: pl.Series, least: int, most: int) -> bool:
    """Whether no number is outside of both; nulls are fine."""
    if counts.dtype.is_float():  # their extremes pass over NaN
        return bool(counts.is_between(least, most).all())
    low = counts.min()
    return low is None or bool(least <= low and counts.max() <= most)  # type: ignore[operator]


def stamp_parts(fields: Mapping[str, str], path: str) -> tuple[str, ...]:
    """The fields of a stamp: seconds and nanoseconds, or the one field itself; empty if it is not there."""
    for seconds in _SECONDS:
        for nanoseconds in _NANOSECONDS:
            parts = (f"{path}.{seconds}", f"{path}.{nanoseconds}")
            if parts[0] in fields and parts[1] in fields:
                return parts
    return (path,) if path in fields and fields[path] != "null" else ()


def time_source(parts: Sequence[str], kinds: Mapping[str, str], mapping: StreamMapping | None) -> TimeSource:
    """How the stamp made of these fields is read."""
    records = (LOG_TIME, PUBLISH_TIME)
    types = {path: TIME_KINDS[kinds[path]] for path in parts if path not in records}
    if mapping is None:
        return TimeSource(tuple(parts), types)
    unit_s = mapping.factors.get("t", _DAY_S if mapping.time_epoch == "excel" else None)
    return TimeSource(tuple(parts), types, unit_s, mapping.time_scale, mapping.time_epoch)


@frozen
class CivilTime:
    """A UTC calendar in six fields, nanoseconds that may be negative, and flags of which bits 0 and 1
    say that date and time are valid.
    """

    calendar: tuple[str, str, str, str, str, str]
    nanoseconds: str
    valid: str

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields that make a time."""
        return (*self.calendar, self.nanoseconds, self.valid)

    @property
    def types(self) -> Mapping[str, pl.DataType]:
        """Their dtypes."""
        return {name: pl.Int64() for name in self.fields}

    def instants(self, frame: pl.DataFrame, name: str) -> pl.Series:
        """Times in UTC; null where the calendar is not valid yet (a receiver before its first fix)."""
        known = (pl.col(self.valid) & 3 == 3) & pl.col(self.calendar[0]).is_between(1970, 2199)
        year, month, day, hour, minute, second = (pl.when(known).then(field) for field in self.calendar)
        # A leap second (60) is the first second of the next minute; datetime() knows none.
        whole = pl.datetime(year, month, day, hour, minute, time_unit="us", time_zone="UTC").to_physical() * 1000
        at = whole + second * NS_PER_S + pl.when(known).then(self.nanoseconds)
        return frame.select(at.cast(pl.Datetime("ns", "UTC")).alias(name)).to_series()
