"""Times in CSV files: texts, counts since an epoch, Excel's days, GPS weeks; in one column or in two."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from pipeline.read.ingest.stamps import (
    LEAST_DAY,
    MOST_DAY,
    counts_within,
    day_is_unclear,
    gps_ns_of_weeks,
    orders_of_day,
    time_source,
    utc_of,
)
from pipeline.read.ingest.timescale import WEEK_NS
from schemas.arrays import NS_PER_S, runs_of
from schemas.config import StreamMapping
from schemas.errors import ConfigError, InputError

# Whole numbers below are seconds, above nanoseconds; between them lie milliseconds and microseconds.
_MOST_SECONDS = 9 * 10**9
_LEAST_NANOSECONDS = 10**17
# The first of these weeks is in August 1999: smaller numbers are weeks counted modulo 1024.
_LEAST_WEEK = 1024
_MOST_WEEK = 9999
_TEXT = (
    r"^(?:(?P<y>[0-9]{4})[-/.](?P<ym>[0-9]{1,2})[-/.](?P<yd>[0-9]{1,2})"
    r"|(?P<a>[0-9]{1,2})[-/.](?P<b>[0-9]{1,2})[-/.](?P<c>[0-9]{4}|[0-9]{2}))"
    r"[T ,]+(?P<h>[0-9]{1,2}):(?P<m>[0-9]{2})(?::(?P<s>[0-9]{2})(?:[.,](?P<f>[0-9]{1,9})[0-9]*)?)?"
    r" ?(?P<half>[AaPp][Mm])? ?(?P<zone>Z|UTC|GMT|[+-][0-9]{2}:?[0-9]{2})? ?(?P<letters>[A-Z]{3,4})?$"
)
_HOUR_NS = 3600 * NS_PER_S
# Rows so near to each other are of one recording without a pause.
_FOLLOWS_NS = 60 * NS_PER_S
_GERMAN_LETTERS = {"MESZ": "CEST", "MEZ": "CET"}
_FORMS = "2025-06-01T12:00:00.25, 01.06.2025 12:00:00, 6/1/2025 1:00 PM, or numbers"


def time_columns(table: pl.DataFrame, mapping: StreamMapping) -> list[str]:
    """The columns that `time = "field:..."` names: one, or two with a plus between them."""
    named = mapping.time.removeprefix("field:")
    parts = [part.strip() for part in named.split("+")]
    both = named not in table.columns and len(parts) == 2 and all(part in table.columns for part in parts)
    return parts if both else [named]


def parse_instants(table: pl.DataFrame, mapping: StreamMapping, path: Path) -> pl.Series:
    """UTC of each row, null where a cell is empty."""
    columns = [table[name] for name in time_columns(table, mapping)]
    place = f"{path}: column {' + '.join(column.name for column in columns)}"
    is_text = [column.dtype == pl.String for column in columns]
    if mapping.time_zone is not None and not (all(is_text) or mapping.time_epoch == "excel"):
        raise InputError(
            "holds numbers, which count the same everywhere",
            place=place,
            found=f"time_zone = {mapping.time_zone}",
            expected="texts or days of Excel, which may be of local time",
            remedy="Remove time_zone from the mapping.",
        )
    if len(columns) == 2 and mapping.time_epoch == "gps" and not any(is_text):
        return _from_week_and_seconds(columns[0], columns[1], mapping, place)
    if mapping.time_epoch == "excel" and not any(is_text):
        return _from_days(columns, mapping, place)
    if all(is_text):
        texts = columns[0] if len(columns) == 1 else columns[0] + " " + columns[1]
        return utc_of(_from_texts(texts, mapping, place), mapping.time_scale)
    if len(columns) == 1:
        return _parse_counts(columns[0], mapping, place)
    raise InputError(
        "holds no times",
        place=place,
        found=" and ".join(str(column.drop_nulls().first()) for column in columns),
        expected='a date and hh:mm:ss; with time_epoch = "gps" week and seconds; with "excel" days and their fraction',
    )


def _refuse_values(
    wrong: pl.Series, values: pl.Series, place: str, message: str, expected: str, remedy: str | None = None
) -> None:
    """Refuse a column with values that are wrong, and show the first of them."""
    if wrong.any():
        row = int(wrong.arg_max() or 0)
        raise InputError(
            message, place=place, found=f"{values[row]} in row {row + 1}", expected=expected, remedy=remedy
        )


def _from_week_and_seconds(week: pl.Series, tow: pl.Series, mapping: StreamMapping, place: str) -> pl.Series:
    """UTC of a GPS week and seconds of it; GPS time by definition, whatever `time_scale` says."""
    seconds = tow.cast(pl.Float64) * mapping.factors.get("t", 1.0)
    longest_s = WEEK_NS / NS_PER_S
    whole = ~week.is_between(_LEAST_WEEK, _MOST_WEEK).fill_null(True)
    _refuse_values(
        whole, week, place, "holds no GPS week", f"{_LEAST_WEEK} to {_MOST_WEEK}", "Write the whole week number."
    )
    beyond = ~seconds.is_between(0.0, longest_s).fill_null(True)
    remedy = "Give the seconds per unit: factors = { t = 1e-3 } for milliseconds."
    _refuse_values(beyond, tow, place, "holds no seconds of a week", f"0 to {longest_s:g} s", remedy)
    return utc_of(gps_ns_of_weeks(week.cast(pl.Int64), seconds), "gps")


def _from_days(columns: list[pl.Series], mapping: StreamMapping, place: str) -> pl.Series:
    """UTC of days with their fraction, which may stand in another column."""
    days = sum((column.cast(pl.Float64) for column in columns[1:]), columns[0].cast(pl.Float64))
    wrong = ~days.is_between(LEAST_DAY, MOST_DAY).fill_null(True)
    _refuse_values(wrong, days, place, "holds no days of Excel", f"{LEAST_DAY} to {MOST_DAY}")
    written = time_source(("days",), {"days": "float"}, mapping).instants(pl.DataFrame({"days": days}), "t")
    if mapping.time_zone is None:
        return written
    local_ns = written.to_physical()
    return _from_zone(local_ns, local_ns.is_not_null(), mapping.time_zone, place).cast(written.dtype)


def _from_texts(texts: pl.Series, mapping: StreamMapping, place: str) -> pl.Series:
    """Nanoseconds since 1970 of times as texts; without a zone as they stand."""
    texts = texts.str.strip_chars().replace("", None)
    parts = texts.str.extract_groups(_TEXT).struct.unnest()
    _refuse_values(parts["h"].is_null() & texts.is_not_null(), texts, place, "holds no times", _FORMS)
    if mapping.time_zone is None:
        lettered = parts["letters"].is_not_null() & parts["zone"].is_null()
        remedy = 'Name the place whose clock it is in the mapping: time_zone = "Europe/Berlin".'
        _refuse_values(
            lettered, texts, place, "holds times of a zone that its letters do not tell for certain", _FORMS, remedy
        )
    number = parts.select(pl.all().exclude("half", "zone", "letters", "f").cast(pl.Int64))
    day, month = ("a", "b") if _has_day_first(number["a"], number["b"], mapping.date_order, place) else ("b", "a")
    year = pl.when(pl.col("c") < 100).then(pl.col("c") + 2000).otherwise(pl.col("c"))
    late = parts["half"].str.to_lowercase()
    hour = pl.when(late.is_null()).then(pl.col("h")).otherwise(pl.col("h") % 12 + 12 * (late == "pm").cast(pl.Int64))
    try:
        civil = pl.datetime(
            pl.coalesce("y", year), pl.coalesce("ym", month), pl.coalesce("yd", day), hour, "m",
            pl.col("s").fill_null(0), time_unit="us",
        )  # fmt: skip
        whole = counts_within(number.select(civil.dt.timestamp("us")).to_series(), 1000) * 1000
    except pl.exceptions.PolarsError as error:
        raise InputError(f"holds no times: {str(error).splitlines()[0]}", place=place, expected=_FORMS) from None
    _refuse_values(whole.is_null() & texts.is_not_null(), texts, place, "holds no times", _FORMS)
    fraction = parts["f"].fill_null("0").str.pad_end(9, "0").cast(pl.Int64)
    written_ns = whole + fraction
    if mapping.time_zone is not None:
        written_ns = _from_zone(written_ns, parts["zone"].is_null(), mapping.time_zone, place)
        _refuse_other_letters(written_ns, parts["letters"], texts, mapping.time_zone, place)
    return written_ns - _offset_ns(parts["zone"])


def _from_zone(local_ns: pl.Series, local: pl.Series, zone: str, place: str) -> pl.Series:
    """UTC of what clocks of a place show, where times are local.

    Of an hour that they show twice, rows that follow each other tell which is which; else it is refused, and what they
    never show is too.
    """
    civil = local_ns.cast(pl.Datetime("ns"))
    try:
        first, second = (
            civil.dt.replace_time_zone(zone, ambiguous=which, non_existent="null").to_physical()
            for which in ("earliest", "latest")
        )
    except pl.exceptions.PolarsError:
        raise ConfigError(
            "is no time zone", place="time_zone", found=zone, expected="a name such as Europe/Berlin"
        ) from None
    never = local & first.is_null() & local_ns.is_not_null()
    if never.any():
        before_ns = local_ns[int(never.arg_max() or 0)] - 2 * _HOUR_NS
        utc_ns = pl.Series([before_ns]).cast(pl.Datetime("ns")).dt.replace_time_zone(zone).to_physical()[0]
        remedy = (
            f"If the logger does not change its clock in spring, say so: time_zone = {_fixed_zone(before_ns - utc_ns)}."
        )
        expected = "times that there are; clocks leave an hour out in spring"
        _refuse_values(never, civil, place, f"holds a time that clocks never show in {zone}", expected, remedy)
    instants, unclear = _resolve_repeated_hours(local_ns, first, second, local & (first != second))
    if unclear.any():
        row = int(unclear.arg_max() or 0)
        zones = " or ".join(_fixed_zone(local_ns[row] - utc_ns[row]) for utc_ns in (first, second))
        fixed = f"if one of them holds for all rows: time_zone = {zones}."
        remedy = f"Let the logger write UTC or the offset (+02:00), or, {fixed}"
        expected = "each time once, or rows that show the change; clocks show an hour twice in autumn"
        _refuse_values(unclear, civil, place, f"holds a time that is not clear in {zone}", expected, remedy)
    return pl.select(pl.when(local).then(instants).otherwise(local_ns)).to_series()


def _refuse_other_letters(utc_ns: pl.Series, letters: pl.Series, texts: pl.Series, zone: str, place: str) -> None:
    """Refuse letters behind times that are not those of the zone then: CET in summer is another hour than CEST."""
    then = utc_ns.cast(pl.Datetime("ns", "UTC")).dt.convert_time_zone(zone).dt.to_string("%Z")
    english = letters.replace(_GERMAN_LETTERS)
    wrong = english.is_not_null() & then.str.contains("^[A-Z]+$") & (english != then)
    remedy = "Name the zone of these letters, or one of a fixed offset, such as Etc/GMT-1."
    _refuse_values(
        wrong, texts, place, f"holds times whose letters are not those of {zone}", "letters of this zone", remedy
    )


def _fixed_zone(ahead_ns: int) -> str:
    """The name of the zone that is always so far ahead of UTC; the sign of these names is turned round."""
    hours = round(ahead_ns / _HOUR_NS)
    return f'"Etc/GMT{-hours:+d}"' if hours else '"UTC"'


def _resolve_repeated_hours(
    local_ns: pl.Series, first: pl.Series, second: pl.Series, twice: pl.Series
) -> tuple[pl.Series, pl.Series]:
    """The instants with each hour that is shown `twice` told apart by the order of its rows, and where it cannot be.

    Rows that follow each other within a minute show the one step back by the hour; without it, they are of the first
    hour where they go on from before it, of the second where they go on behind it.
    """
    instants = first.to_numpy().copy()
    unclear = np.zeros(instants.size, dtype=np.bool_)
    clock_ns = local_ns.fill_null(0).to_numpy()
    steps_ns = np.diff(clock_ns)
    back_ns = second.fill_null(0).to_numpy() - first.fill_null(0).to_numpy()
    for begin, end in zip(*runs_of(twice.fill_null(value=False).to_numpy()), strict=True):
        inside = steps_ns[begin:end]
        (turn,) = np.nonzero(np.abs(inside + back_ns[begin]) <= _FOLLOWS_NS) if inside.size else (np.zeros(0, int),)
        others = np.delete(inside, turn)
        follows = bool(np.all((others >= 0) & (others <= _FOLLOWS_NS)))
        before = begin > 0 and 0 <= steps_ns[begin - 1] <= _FOLLOWS_NS
        behind = end < steps_ns.size and 0 <= steps_ns[end] <= _FOLLOWS_NS
        rows = slice(begin, end + 1)
        if not follows or turn.size > 1 or (turn.size == 0 and before == behind):
            unclear[rows] = True
        elif turn.size or behind:
            later = slice(begin + int(turn[0]) + 1 if turn.size else begin, end + 1)
            instants[later] += back_ns[begin]
    return pl.Series(instants).set(first.is_null(), None), pl.Series(unclear)


def _offset_ns(zone: pl.Series) -> pl.Series:
    """Offset of time zones from UTC [ns]."""
    digits = zone.str.replace_all("[A-Z:]", "").str.extract(r"([0-9]{4})").fill_null("0000")
    minutes = digits.str.slice(0, 2).cast(pl.Int64) * 60 + digits.str.slice(2, 2).cast(pl.Int64)
    sign = pl.Series(np.where(zone.str.starts_with("-").fill_null(False).to_numpy(), -1, 1))
    return sign * minutes * 60 * NS_PER_S


def _has_day_first(first: pl.Series, second: pl.Series, asked: str, place: str) -> bool:
    """Whether dates such as 01.02.2025 begin with the day: decided over the whole file, never guessed."""
    fitting = orders_of_day(first, second)
    if not fitting or (asked != "auto" and asked not in fitting):
        raise InputError(
            "holds dates of another kind than date_order" if fitting else "holds dates of two kinds",
            place=place,
            found=" and ".join(fitting) or "days over 12 before and behind the month",
            expected="day or month first in all rows" if asked == "auto" else asked,
            remedy="Correct date_order." if fitting else "Correct the file.",
        )
    if asked == "auto" and day_is_unclear(first, second):
        unlike = pl.DataFrame({"first": first, "second": second}).filter(pl.col("first") != pl.col("second"))
        raise InputError(
            "holds dates that fit day first and month first",
            place=place,
            found="{} and {} of a year".format(*unlike.row(0)),
            expected="a day over 12 in some row",
            remedy='Give date_order = "day_first" or "month_first" in the mapping.',
        )
    return (asked if asked != "auto" else fitting[0]) == "day_first"


def _likely_unit(count: int) -> str:
    """The unit in which a time since 1970 lies between 1985 and 2065."""
    units_s = {"milliseconds": 1e-3, "microseconds": 1e-6}
    return next((f"; looks like {unit}" for unit, unit_s in units_s.items() if 5e8 < count * unit_s < 3e9), "")


def _parse_counts(recorded: pl.Series, mapping: StreamMapping, place: str) -> pl.Series:
    """Numbers: seconds, whole ones of 18 digits nanoseconds, and of another unit as `factors.t` says."""
    kind = "int" if recorded.dtype.is_integer() else "float"
    source = time_source((recorded.name,), {recorded.name: kind}, mapping)
    if recorded.dtype.is_integer() and source.unit_s is None:
        largest = int(np.abs(recorded.drop_nulls().to_numpy().astype(np.float64)).max(initial=0))
        if _MOST_SECONDS < largest < _LEAST_NANOSECONDS:
            raise InputError(
                f"time unit unknown{_likely_unit(largest)}",
                place=place,
                found=str(largest),
                expected="seconds or nanoseconds",
                remedy="Give the seconds per unit: factors = { t = 1e-3 } for milliseconds.",
            )
        recorded = recorded * (1 if largest >= _LEAST_NANOSECONDS else NS_PER_S)
    return source.instants(recorded.to_frame(), recorded.name)
