"""Times of validity from what messages and records hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import polars as pl

from pipeline.ingest.timescale import GPS_EPOCH_NS, utc_from_gps
from schemas.config import StreamMapping

LOG_TIME = "(log time)"
PUBLISH_TIME = "(publish time)"
# How fields are read that may hold a time, by what their first value is.
TIME_KINDS: Mapping[str, pl.DataType] = {"int": pl.Int64(), "float": pl.Float64(), "text": pl.String()}


@dataclass(frozen=True)
class TimeSource:
    """Fields of a stamp and what they count: whole `unit_s` since the epoch of `epoch` on `scale`."""

    fields: tuple[str, ...]
    types: Mapping[str, pl.DataType]
    unit_s: float | None = None
    scale: Literal["utc", "gps"] = "utc"
    epoch: Literal["unix", "gps"] = "unix"

    def of_field(self, path: str, other: str) -> TimeSource:
        """The same kind of stamp in another field of the message."""
        fields = tuple(other + name.removeprefix(path) for name in self.fields)
        types = dict(zip(fields, (self.types.get(name, pl.Int64()) for name in self.fields), strict=True))
        return replace(self, fields=fields, types=types)

    def instants(self, frame: pl.DataFrame, name: str) -> pl.Series:
        """Times in UTC; null where a part of the stamp is null."""
        t = self._nanoseconds(frame).alias(name)
        if self.epoch == "gps":
            t = t + GPS_EPOCH_NS
        if self.scale == "gps":
            utc = pl.Series(name, utc_from_gps(t.fill_null(0).to_numpy()))
            t = utc.set(t.is_null(), None) if t.null_count() else utc
        return t.cast(pl.Datetime("ns", "UTC"))

    def _nanoseconds(self, frame: pl.DataFrame) -> pl.Series:
        first = frame[self.fields[0]]
        if len(self.fields) == 2:
            return first * 1_000_000_000 + frame[self.fields[1]]
        dtype = self.types.get(self.fields[0], pl.Int64())
        if dtype == pl.String:
            return first.str.to_datetime("%+", time_unit="ns", time_zone="UTC", strict=True).to_physical()
        if dtype == pl.Int64:
            return first * (1 if self.unit_s is None else round(self.unit_s * 1e9))
        return (first * ((1.0 if self.unit_s is None else self.unit_s) * 1e9)).round().cast(pl.Int64)


def time_source(parts: Sequence[str], kinds: Mapping[str, str], mapping: StreamMapping | None) -> TimeSource:
    """How the stamp made of these fields is read."""
    records = (LOG_TIME, PUBLISH_TIME)
    types = {path: TIME_KINDS[kinds[path]] for path in parts if path not in records}
    if mapping is None:
        return TimeSource(tuple(parts), types)
    return TimeSource(tuple(parts), types, mapping.factors.get("t"), mapping.time_scale, mapping.time_epoch)


@dataclass(frozen=True)
class CivilTime:
    """A UTC calendar in six fields, nanoseconds that may be negative, and flags of which bits 0 and 1
    say that date and time are valid.
    """

    calendar: tuple[str, str, str, str, str, str]
    nanoseconds: str
    valid: str

    @property
    def fields(self) -> tuple[str, ...]:
        return (*self.calendar, self.nanoseconds, self.valid)

    @property
    def types(self) -> Mapping[str, pl.DataType]:
        return {name: pl.Int64() for name in self.fields}

    def instants(self, frame: pl.DataFrame, name: str) -> pl.Series:
        """Times in UTC; null where the calendar is not valid yet (a receiver before its first fix)."""
        year, *others = (pl.col(field) for field in self.calendar)
        month, day, hour, minute, second = others
        # A leap second (60) is the first second of the next minute; datetime() knows none.
        whole = pl.datetime(year, month, day, hour, minute, time_unit="ns", time_zone="UTC")
        known = (pl.col(self.valid) & 3 == 3) & month.is_between(1, 12) & day.is_between(1, 31)
        at = whole.to_physical() + second * 1_000_000_000 + pl.col(self.nanoseconds)
        instant = pl.when(known).then(at).cast(pl.Datetime("ns", "UTC"))
        return frame.select(instant.alias(name)).to_series()
