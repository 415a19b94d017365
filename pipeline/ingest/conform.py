"""A recorded frame made to fit its stream's contract: lossless conversions, else a breach."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import dataframely as dy
import polars as pl

from pipeline.ingest.breaches import Breach
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import Stream

Defaults = Mapping[str, str | float | bool]
DEFAULTS: Defaults = {"solution": "primary"}
NEVER_EMPTY: tuple[Stream, ...] = ("gnss", "odometer")
# Numbers of no stream are larger, in whatever unit (receivers write variances up to 1e13 m2 for "not known"); their
# squares and products stay finite.
_LARGEST = 1e15
_EXACT_INTEGER = 2**53  # above it not every integer is a float


def conform(frame: pl.DataFrame, stream: Stream, place: str, breaches: list[Breach]) -> pl.DataFrame:
    """The stream's columns with the contract's types, in the contract's order; rows are left as they stand.

    Breaches are appended; the frame returned is of use only if none were.
    """
    if frame.height == 0 and stream in NEVER_EMPTY:
        breaches.append(Breach(place, "has no rows", expected="at least one", remedy="Record the stream."))
    result = conform_to(STREAM_SCHEMAS[stream].columns(), frame, place, breaches, DEFAULTS)
    if stream == "odometer":
        _check_odometer(result, place, breaches)
    return result


def conform_to(
    columns: Mapping[str, dy.Column], frame: pl.DataFrame, place: str, breaches: list[Breach], defaults: Defaults
) -> pl.DataFrame:
    """As `conform`, for any columns; `defaults` fill those that are absent, and nulls in those that are there."""
    conformed = {
        name: _column(frame, name, column, place, breaches, defaults)
        for name, column in columns.items()
        if name in frame.columns or name in defaults or _may_be_absent(name, column, frame, place, breaches)
    }
    return pl.DataFrame({name: series for name, series in conformed.items() if series is not None})


def _may_be_absent(name: str, column: dy.Column, frame: pl.DataFrame, place: str, breaches: list[Breach]) -> bool:
    if column.nullable:
        return True
    breaches.append(
        Breach(
            f"{place}: column {name}",
            "is missing",
            found=", ".join(frame.columns) or "no columns",
            expected=type_name(column),
            remedy="Add the column.",
        )
    )
    return False


def _column(
    frame: pl.DataFrame, name: str, column: dy.Column, place: str, breaches: list[Breach], defaults: Defaults
) -> pl.Series | None:
    where = f"{place}: column {name}"
    if name not in frame.columns:
        return pl.Series(name, [defaults.get(name)], dtype=column.dtype).new_from_index(0, frame.height)
    series = _converted(frame[name], column)
    if name in defaults and not isinstance(series, str) and series.null_count():
        series = series.fill_null(defaults[name])
    if isinstance(series, str):
        breaches.append(Breach(where, "has the wrong type", found=series, expected=type_name(column), remedy=_RETYPE))
        return None
    _check_values(series, column, where, breaches)
    return series


_RETYPE = "Write the column with that type."


def type_name(column: dy.Column) -> str:
    """The contract's type in words."""
    if isinstance(column, dy.Enum):
        return "one of " + " ".join(column.categories)
    return str(column.dtype)


def _converted(series: pl.Series, column: dy.Column) -> pl.Series | str:
    """The series in the contract's type, or what was found where that would lose or invent something."""
    target = column.dtype
    if series.dtype == target:
        return series
    if series.null_count() == len(series):
        return pl.Series(series.name, [None], dtype=target).new_from_index(0, len(series))
    return _CONVERSIONS[type(column)](series, target)


def _to_float(series: pl.Series, target: pl.DataType) -> pl.Series | str:
    if series.dtype in (pl.Float32, pl.Float16) or series.dtype.is_decimal():
        return series.cast(target)
    if series.dtype.is_integer():
        low, high = series.min(), series.max()
        if low >= -_EXACT_INTEGER and high <= _EXACT_INTEGER:  # type: ignore[operator]
            return series.cast(target)
        return f"{series.dtype} beyond 2^53"
    return str(series.dtype)


def _to_integer(series: pl.Series, target: pl.DataType) -> pl.Series | str:
    if not series.dtype.is_numeric():
        return str(series.dtype)
    cast = series.cast(target, strict=False)
    if cast.null_count() == series.null_count() and (cast.cast(series.dtype, strict=False) == series).all():
        return cast
    return f"{series.dtype} with values that are not 64-bit integers"


def _to_instant(series: pl.Series, target: pl.DataType) -> pl.Series | str:
    if not isinstance(series.dtype, pl.Datetime):
        return str(series.dtype)
    if series.dtype.time_zone is None:
        return f"{series.dtype} without a time zone"
    unit = series.dtype.time_unit
    in_utc = series.dt.convert_time_zone("UTC")
    factor = {"ms": 1_000_000, "us": 1_000, "ns": 1}[unit]
    limit = (2**63 - 1) // factor
    counts = series.to_physical()
    if -limit <= counts.min() and counts.max() <= limit:  # type: ignore[operator]
        return in_utc.cast(target)
    return f"{series.dtype} beyond the years 1677 to 2262"


def _to_enum(series: pl.Series, target: pl.DataType) -> pl.Series | str:
    if not isinstance(series.dtype, pl.String | pl.Categorical | pl.Enum):
        return str(series.dtype)
    texts = series.cast(pl.String)
    known = target.categories.to_list()  # type: ignore[attr-defined]
    strange = sorted(set(texts.drop_nulls().unique().to_list()) - set(known))
    return ", ".join(repr(value) for value in strange[:5]) if strange else texts.cast(target)


def _to_text(series: pl.Series, target: pl.DataType) -> pl.Series | str:
    if isinstance(series.dtype, pl.Categorical | pl.Enum):
        return series.cast(target)
    return str(series.dtype)


def _to_flag(series: pl.Series, _: pl.DataType) -> pl.Series | str:
    return str(series.dtype)


_CONVERSIONS: dict[type[dy.Column], Callable[[pl.Series, pl.DataType], pl.Series | str]] = {
    dy.Float64: _to_float,
    dy.Int64: _to_integer,
    dy.Datetime: _to_instant,
    dy.Enum: _to_enum,
    dy.String: _to_text,
    dy.Bool: _to_flag,
}


def _check_values(series: pl.Series, column: dy.Column, where: str, breaches: list[Breach]) -> None:
    if not column.nullable and series.null_count():
        rows = rows_text(series.is_null())
        breaches.append(Breach(where, "has missing values", found=f"null in {rows}", expected="a value in every row"))
    if isinstance(column, dy.Float64) and not all_finite(series):
        strange = ~series.is_finite().fill_null(True)
        value = series.filter(strange)[0]
        breaches.append(
            Breach(
                where,
                "has values that are not finite numbers",
                found=f"{value} in {rows_text(strange)}",
                expected="finite numbers, null where unknown",
                remedy="Write null where a value is not known.",
            )
        )
    elif isinstance(column, dy.Float64 | dy.Int64):
        _check_range(series, column, where, breaches)


def all_finite(series: pl.Series) -> bool:
    """Whether no value is NaN or infinite (nulls are fine)."""
    total = series.sum()  # NaN and infinity survive a sum, so one pass says that all is well
    return total is None or math.isfinite(total) or bool(series.is_finite().all())


def _check_range(series: pl.Series, column: dy.Float64 | dy.Int64, where: str, breaches: list[Breach]) -> None:
    low, high = series.min(), series.max()
    if low is None or high is None:
        return
    least = -_LARGEST if column.min is None else column.min
    most = _LARGEST if column.max is None else column.max
    over = getattr(column, "min_exclusive", None)
    if low < least:  # type: ignore[operator]
        breaches.append(_out_of_range(where, low, series < least, f"at least {least:g}"))
    if over is not None and low <= over:
        breaches.append(_out_of_range(where, low, series <= over, f"more than {over:g}"))
    if high > most:  # type: ignore[operator]
        breaches.append(_out_of_range(where, high, series > most, f"at most {most:g}"))


def _out_of_range(where: str, value: object, mask: pl.Series, expected: str) -> Breach:
    found = f"{value} in {rows_text(mask.fill_null(False))}"
    return Breach(where, "is out of range", found=found, expected=expected, remedy="Correct the recording.")


def rows_text(mask: pl.Series) -> str:
    """Which rows are meant: the first, and how many."""
    first, count = mask.arg_max(), int(mask.sum())
    return f"row {first}" if count == 1 else f"{count} rows, first {first}"


def _check_odometer(frame: pl.DataFrame, place: str, breaches: list[Breach]) -> None:
    if not {"distance_m", "speed_mps"} <= set(frame.columns):
        return
    neither = frame["distance_m"].is_null() & frame["speed_mps"].is_null()
    if neither.any():
        breaches.append(
            Breach(
                f"{place}: columns distance_m, speed_mps",
                "are both empty",
                found=f"null in {rows_text(neither)}",
                expected="distance or speed in every row",
                remedy="Record one of the two, or leave the stream out.",
            )
        )
