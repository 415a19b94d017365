"""A recorded frame made to fit its stream's contract: lossless conversions, else a breach, all in one error."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import dataframely as dy
import polars as pl

from schemas.config import IngestConfig
from schemas.errors import InputError, listed
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import Stream

Defaults = Mapping[str, str | float | bool]
DEFAULTS: Defaults = {"solution": "primary", "sensor": "primary"}
NEVER_EMPTY: tuple[Stream, ...] = ("gnss", "odometer")
# Numbers of no stream are larger, in whatever unit (receivers write variances up to 1e13 m2 for "not known"); their
# squares and products stay finite.
_LARGEST = 1e15
_EXACT_INTEGER = 2**53  # above it not every integer is a float


def conform(frame: pl.DataFrame, stream: Stream, place: str, breaches: list[InputError]) -> pl.DataFrame:
    """The stream's columns with the contract's types, in the contract's order; rows are left as they stand.

    Breaches are appended; the frame returned is of use only if none were.
    """
    if frame.height == 0 and stream in NEVER_EMPTY:
        breaches.append(InputError("has no rows", place=place, expected="at least one", remedy="Record the stream."))
    result = conform_to(STREAM_SCHEMAS[stream].columns(), frame, place, breaches, DEFAULTS)
    measured = [result[name] for name in ("distance_m", "speed_mps") if name in result.columns]
    if stream == "odometer" and len(measured) == 2 and all(series.null_count() for series in measured):
        counters = measured[0], measured[1]
        if (
            all(counter.null_count() for counter in counters)
            and (neither := counters[0].is_null() & counters[1].is_null()).any()
        ):
            breaches.append(
                InputError(
                    "are both empty",
                    place=f"{place}: columns distance_m, speed_mps",
                    found=f"null in {rows_text(neither)}",
                    expected="distance or speed in every row",
                    remedy="Record one of the two, or leave the stream out.",
                )
            )
    return result


def refuse_too_many(rows: int, place: str, config: IngestConfig) -> None:
    """Refuse a stream that takes more memory than any journey needs."""
    if rows > config.rows_limit:
        raise InputError(
            "has too many rows",
            place=place,
            found=str(rows),
            expected=f"at most {config.rows_limit}",
            remedy="If so many were recorded, write a larger `rows_limit` under [ingest] in the configuration file.",
        )


def conform_to(
    columns: Mapping[str, dy.Column], frame: pl.DataFrame, place: str, breaches: list[InputError], defaults: Defaults
) -> pl.DataFrame:
    """As `conform`, for any columns; `defaults` fill those that are absent, and nulls in those that are there."""
    conformed: dict[str, pl.Series] = {}
    for name, column in columns.items():
        where = f"{place}: column {name}"
        if name in frame.columns:
            series = _converted(frame[name], column)
            if isinstance(series, str):
                wrong = {"found": series, "expected": type_name(column), "remedy": "Write the column with that type."}
                breaches.append(InputError("has the wrong type", place=where, **wrong))
                continue
            conformed[name] = series.fill_null(defaults[name]) if name in defaults and series.null_count() else series
            breaches += _strange_values(conformed[name], column, where)
        elif name in defaults or column.nullable:
            default = pl.Series(name, [defaults.get(name)], dtype=column.dtype)
            conformed[name] = default.new_from_index(0, frame.height)
        else:
            absent = {"found": ", ".join(frame.columns) or "no columns", "expected": type_name(column)}
            breaches.append(InputError("is missing", place=where, **absent, remedy="Add the column."))
    return pl.DataFrame(conformed)


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
    return _lossless(series, column, target)


# What is found where reading a column would lose something.
_LOSSES: dict[type[dy.Column], str] = {
    dy.Float64: " beyond 2^53",
    dy.Int64: " with values that are not 64-bit integers",
    dy.Datetime: " beyond the years 1677 to 2262",
}


def _may_be(column: dy.Column, dtype: pl.DataType) -> bool:
    """Whether the column may be read from such a type at all."""
    if isinstance(column, dy.Float64 | dy.Int64):
        return dtype.is_numeric()
    if isinstance(column, dy.Enum | dy.String):
        # Ids are names, and some are written as numbers.
        is_id = isinstance(column, dy.String) and dtype.is_integer()
        return is_id or isinstance(dtype, pl.String | pl.Categorical | pl.Enum)
    return isinstance(column, dy.Datetime) and isinstance(dtype, pl.Datetime)


def _lossless(series: pl.Series, column: dy.Column, target: pl.DataType) -> pl.Series | str:
    """The series as the type of the contract, or what was found instead where that would lose something."""
    if not _may_be(column, series.dtype):
        return str(series.dtype)
    if isinstance(series.dtype, pl.Datetime):
        if series.dtype.time_zone is None:
            return f"{series.dtype} without a time zone"
        series = series.dt.convert_time_zone("UTC")
    if isinstance(column, dy.Enum) and len(series) > 1 and _is_constant(series):
        one = _lossless(series.head(1), column, target)
        return one if isinstance(one, str) else one.new_from_index(0, len(series))
    cast = series.cast(target, strict=False)
    if isinstance(column, dy.Enum):
        if cast.null_count() == series.null_count():
            return cast
        strange = series.cast(pl.String).filter(cast.is_null() & series.is_not_null()).unique().sort()
        return ", ".join(repr(value) for value in strange.head(5))
    if isinstance(column, dy.Float64):  # of 32 bits and decimal ones fit, of integers not every one is a float
        exact = series.dtype.is_integer() and series.is_between(-_EXACT_INTEGER, _EXACT_INTEGER).all()
        whole = exact or not series.dtype.is_integer()
    else:
        whole = cast.null_count() == series.null_count() and (cast.cast(series.dtype, strict=False) == series).all()
    return cast if whole else f"{series.dtype}{_LOSSES.get(type(column), '')}"


def _is_constant(series: pl.Series) -> bool:
    """Whether every row holds the same value."""
    return series.null_count() == 0 and bool((series == series[0]).all())


def _strange_values(series: pl.Series, column: dy.Column, where: str) -> Iterator[InputError]:
    """One breach for each kind of value that the contract does not allow."""
    if not column.nullable and series.null_count():
        found = f"null in {rows_text(series.is_null())}"
        yield InputError("has missing values", place=where, found=found, expected="a value in every row")
    if isinstance(column, dy.Float64) and not all_finite(series):
        strange = ~series.is_finite().fill_null(True)
        yield InputError(
            "has values that are not finite numbers",
            place=where,
            found=f"{series.filter(strange)[0]} in {rows_text(strange)}",
            expected="finite numbers, null where unknown",
            remedy="Write null where a value is not known.",
        )
    elif isinstance(column, dy.Float64 | dy.Int64) and series.null_count() < len(series):
        least = -_LARGEST if column.min is None else column.min
        most = _LARGEST if column.max is None else column.max
        over = getattr(column, "min_exclusive", None)
        low = series.min()
        high = series.max()
        if low < least:  # type: ignore[operator]
            yield _out_of_range(where, low, series < least, f"at least {least:g}")
        if over is not None and low <= over:
            yield _out_of_range(where, low, series <= over, f"more than {over:g}")
        if high > most:  # type: ignore[operator]
            yield _out_of_range(where, high, series > most, f"at most {most:g}")


def all_finite(series: pl.Series) -> bool:
    """Whether no value is NaN or infinite (nulls are fine)."""
    total = series.sum()  # NaN and infinity survive a sum, so one pass says that all is well
    return total is None or math.isfinite(total) or bool(series.is_finite().all())


def _out_of_range(where: str, value: object, mask: pl.Series, expected: str) -> InputError:
    """The breach for the rows (`mask`) of a column that lie outside a limit."""
    found = f"{value} in {rows_text(mask.fill_null(False))}"
    return InputError("is out of range", place=where, found=found, expected=expected, remedy="Correct the recording.")


def rows_text(mask: pl.Series) -> str:
    """Which rows are meant: the first, and how many."""
    count = int(mask.sum())
    return f"row {mask.arg_max()}" if count == 1 else f"{count} rows, first {mask.arg_max()}"


def refuse(breaches: Sequence[InputError]) -> None:
    """Raise one error for all breaches, none if there are none."""
    if not breaches:
        return
    if len(breaches) == 1:
        raise breaches[0]
    remedies = list(dict.fromkeys(breach.remedy for breach in breaches if breach.remedy))
    files = list(dict.fromkeys(str(breach.place).split(": ")[0] for breach in breaches))
    raise InputError(
        listed([line_of(breach) for breach in breaches]),
        place=", ".join(files),
        remedy=" ".join(remedies) or None,
    )


def line_of(breach: InputError) -> str:
    """The breach as one line of an error, without its remedy."""
    return str(InputError(breach.message, place=breach.place, found=breach.found, expected=breach.expected))
