"""CSV as programs and spreadsheets write it: other encodings than UTF-8, other separators than the comma, empty lines,
a row of units.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import polars as pl
import polars.selectors as cs

from pipeline.storage import files
from schemas.errors import InputError

_SEPARATORS = (",", ";", "\t")
_NO_ROW = r"#|sep=.$"  # a comment; Excel's own line, which says what separates
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


# Without a byte order mark: every other byte of European text is zero.
_UTF16_ZEROS = 0.3


class LogTable(NamedTuple):
    """A table of a log; `cut` rows that break off at the end (0 or 1), rows with fewer values than the header; the row
    of units, if it has one.
    """

    table: pl.DataFrame
    cut: int
    short: int
    units: tuple[str, ...]
    separator: str


def read_table(data: bytes, infer: bool) -> pl.DataFrame:
    """The table, as texts or (`infer`) with types by content; lines that start with # are left out.

    The separator is the one of comma, semicolon and tab that divides the header most. Names and texts lose the
    blanks around them. Raises ValueError or a polars error where there is no table.
    """
    return _table(_lines(data), infer)


def read_log_table(log: Path, infer: bool) -> LogTable:
    """`read_table` of a log, without a last row that breaks off and without a row of units behind the header.

    A recorder that lost power leaves half a row: without a line end, and with fewer fields than the header. Raises
    `InputError` where the file cannot be read or holds no table.
    """
    try:
        return _whole_rows(files.read_bytes(log), infer)
    except (ValueError, csv.Error, pl.exceptions.PolarsError) as error:
        if isinstance(error, pl.exceptions.ComputeError):
            with suppress(csv.Error):
                _refuse_long_rows(_lines(log.read_bytes()), log)
        raise InputError(f"is not a CSV file: {str(error).splitlines()[0]}", place=str(log)) from None


def _whole_rows(data: bytes, infer: bool) -> LogTable:
    lines = _lines(data)
    separator = _separator(lines)
    header = next((line for line in lines if line.strip()), "")
    ended = data.rstrip(b" \0").endswith((b"\n", b"\r"))
    cut = len(lines) > 1 and not ended and lines[-1].count(separator) < header.count(separator)
    lines, units = _without_units(lines[:-1] if cut else lines, separator)
    table = _table(lines, infer)
    short = sum(0 < line.count(separator) < header.count(separator) for line in lines)
    return LogTable(table, int(cut), short, units, separator)


def _refuse_long_rows(lines: list[str], log: Path) -> None:
    rows = enumerate(csv.reader(lines, delimiter=_separator(lines)), 1)
    header = next((row for _, row in rows if row), [])
    for number, row in rows:
        if len(row) > len(header):
            raise InputError(
                "has more values than the header",
                place=f"{log}: line {number}, comments not counted",
                found=f"{len(row)}: {', '.join(row[:4])[:80]}",
                expected=f"at most {len(header)}: {', '.join(header[:4])[:80]}",
                remedy="The first line names the columns: begin the lines before it with #, and correct longer rows.",
            )


def _without_units(lines: list[str], separator: str) -> tuple[list[str], tuple[str, ...]]:
    """The lines without the row behind the header where that has words only, and the next one a number."""
    rows = csv.reader([line for line in lines if line.strip()], delimiter=separator)
    head = [row for row, _ in zip(rows, range(3), strict=False)]
    if len(head) < 3 or len(head[1]) != len(head[0]) or not any(cell.strip() for cell in head[1]):
        return lines, ()
    if any(_has_number(cell) for cell in head[1]) or not any(_has_number(cell) for cell in head[2]):
        return lines, ()
    at = next(
        (number for number, line in enumerate(lines) if [*csv.reader([line], delimiter=separator)] == [head[1]]), None
    )
    return (lines, ()) if at is None else ([*lines[:at], *lines[at + 1 :]], tuple(cell.strip() for cell in head[1]))


def _has_number(cell: str) -> bool:
    return re.match(r"\s*[+-]?[.,]?[0-9]", cell) is not None


def _lines(data: bytes) -> list[str]:
    return [line for line in text_of(data).splitlines() if not re.match(_NO_ROW, line)]


def _separator(lines: list[str]) -> str:
    header = next((line for line in lines if line.strip()), "")
    return max(_SEPARATORS, key=header.count)


def _table(lines: list[str], infer: bool) -> pl.DataFrame:
    separator = _separator(lines)
    body = "\n".join(lines).lstrip("\n")
    length = None if infer else 0
    frame = pl.read_csv(io.StringIO(body), separator=separator, infer_schema=infer, infer_schema_length=length)
    frame.columns = _names(body, separator, frame.columns)
    frame = frame.with_columns(pl.col(pl.String).str.strip_chars())
    texts = cs.string()
    return frame.filter(~pl.all_horizontal((texts.is_null() | (texts == "")), (~texts).is_null()))


def _names(body: str, separator: str, given: list[str]) -> list[str]:
    """Names without blanks around them; polars gives those that stand twice names of their own."""
    first = pl.read_csv(io.StringIO(body), separator=separator, has_header=False, n_rows=1, infer_schema=False)
    written = [name.strip() for name in first.row(0) if name and name.strip()]
    twice = sorted({name for name in written if written.count(name) > 1})
    if twice:
        raise ValueError(f"two columns have the same name: {', '.join(twice)}")
    return [name.strip() for name in given]


def comments_of(data: bytes) -> str:
    """The comment lines."""
    return "\n".join(line for line in text_of(data).splitlines() if line.startswith("#"))


def text_of(data: bytes) -> str:
    """The text: UTF-8, UTF-16 by its mark or its zeros, else Windows-1252 (Latin-1 and more)."""
    if data.startswith(_UTF16):
        return data.decode("utf-16")
    head = data[:1000]
    for zeros, encoding in ((head[1::2], "utf-16-le"), (head[::2], "utf-16-be")):
        if zeros.count(0) > _UTF16_ZEROS * max(len(head), 1):
            return data.decode(encoding)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        if re.search(rb"[\x00-\x08\x0e-\x1f]", data):
            raise
        return data.decode("cp1252", "strict")


def epsg_in(comments: str) -> str | None:
    """The EPSG code that a comment names (`# epsg: 31370`)."""
    named = re.search(r"epsg\s*[:=]\s*(?:EPSG:)?(\w+)", comments, re.IGNORECASE)
    return named.group(1) if named else None
