"""CSV as programs and spreadsheets write it: encodings, separators, decimal commas, empty lines, a row of units."""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import polars as pl
import polars.selectors as cs

from pipeline.storage import files
from schemas.errors import InputError

CUT_ROW = "row that breaks off at the end of the file"
_SEPARATORS = (",", ";", "\t")
# A logger writes no more lines above its header.
_HEAD_LINES = 60
# Loggers of whole trains write some thousands; each column takes kilobytes, however few rows it has.
_MOST_COLUMNS = 10_000
_NO_ROW = r"#|sep=.$"  # a comment; Excel's own line, which names the separator
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
# Without a byte order mark: every other byte of European text is zero.
_UTF16_ZEROS = 0.3
# Decimal mark, and what may separate thousands beside it.
_MARKS = {",": "[.'\u2019 \u00a0\u202f]", ".": "[,'\u2019 \u00a0\u202f]"}


class LogTable(NamedTuple):
    """A table of a log, with its row of units. `cut`: rows that break off at the end (0 or 1), `short`: rows with fewer
    values than the header, `before`: lines of a logger above the header.
    """

    table: pl.DataFrame
    cut: int
    short: int
    units: tuple[str, ...]
    separator: str
    before: int = 0


def read_table(data: bytes, infer: bool) -> pl.DataFrame:
    """The table, as texts or (`infer`) with types by content; lines that start with # are left out.

    The separator is the one of comma, semicolon and tab that divides the header most. Names and texts lose the
    blanks around them. Raises ValueError or a polars error where there is no table.
    """
    return _parse_lines(_lines_without_comments(data), infer)


def read_log_table(log: Path, infer: bool) -> LogTable:
    """`read_table` of a log, without its row of units and without a last row that breaks off.

    A recorder that lost power leaves half a row: without a line end, and with fewer fields than the header.
    """
    data = files.read_bytes(log)
    try:
        return _whole_rows(data, infer)
    except (ValueError, csv.Error, pl.exceptions.PolarsError) as error:
        if isinstance(error, pl.exceptions.ComputeError):
            with suppress(csv.Error):
                _refuse_long_rows(_lines_without_comments(data), log)
        raise InputError(f"is not a CSV file: {str(error).splitlines()[0]}", place=str(log)) from None


def _whole_rows(data: bytes, infer: bool) -> LogTable:
    """The table without a last row that breaks off, and what was left out."""
    written = _lines_without_comments(data)
    lines = _lines_from_header(written)
    separator = _find_separator(lines)
    fields = _header_line(lines).count(separator)
    ended = data.rstrip(b" \0").endswith((b"\n", b"\r"))
    whole = lines
    cut = len(lines) > 1 and not ended and lines[-1].count(separator) < fields
    lines, units = _without_units(lines[:-1] if cut else lines, separator)
    short = sum(0 < line.count(separator) < fields for line in lines)
    return LogTable(_parse_lines(lines, infer), int(cut), short, units, separator, len(written) - len(whole))


def _refuse_wide(lines: list[str]) -> None:
    """Refuse a table of more columns than are read."""
    widest = max((line.count(separator) for line in lines[:_HEAD_LINES] for separator in _SEPARATORS), default=0)
    if widest >= _MOST_COLUMNS:
        raise ValueError(f"it has {widest + 1} columns; at most {_MOST_COLUMNS} are read")


def _lines_from_header(lines: list[str]) -> list[str]:
    """The lines from the header on; those that a logger writes above it have fewer values than the rows.

    The header is the first line that has as many values as the row behind it, none of them a number.
    """
    head = [number for number, line in enumerate(lines[:_HEAD_LINES]) if line.strip()]
    for separator in _SEPARATORS:
        counts = {number: lines[number].count(separator) for number in head}
        most = max(counts.values(), default=0)
        tops = [number for number in head if counts[number] == most]
        if most < 1 or len(tops) < 2 or tops[0] == head[0]:
            continue
        header, *rows = csv.reader([lines[number] for number in tops[:3]], delimiter=separator)
        if all(cell.strip() for cell in header[:-1]) and not any(map(_has_number, header)) and _look_like_rows(rows):
            return lines[tops[0] :]
    return lines


def _look_like_rows(rows: list[list[str]]) -> bool:
    """Numbers in the first row, or behind a row of units in the second."""
    return any(sum(map(_has_number, row)) * 2 > len(row) for row in rows[:2])


def _refuse_long_rows(lines: list[str], log: Path) -> None:
    """Refuse rows with more values than the header."""
    rows = enumerate(csv.reader(lines, delimiter=_find_separator(lines)), 1)
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
    """The lines, and the row behind the header where that holds only words and the next one a number."""
    rows = csv.reader([line for line in lines if line.strip()], delimiter=separator)
    head = [row for row, _ in zip(rows, range(3), strict=False)]
    if len(head) < 3:
        return lines, ()
    names, units, values = head
    is_units = len(units) == len(names) and any(cell.strip() for cell in units)
    if not is_units or any(map(_has_number, units)) or not any(map(_has_number, values)):
        return lines, ()
    for at, line in enumerate(lines):
        if [*csv.reader([line], delimiter=separator)] == [units]:
            return [*lines[:at], *lines[at + 1 :]], tuple(cell.strip() for cell in units)
    return lines, ()


def _has_number(cell: str) -> bool:
    """Whether a cell begins with a number."""
    return re.match(r"\s*[+-]?[.,]?[0-9]", cell) is not None


def _lines_without_comments(data: bytes) -> list[str]:
    """The lines that are no comments; the header may stand in the last comment before the first row."""
    written = text_of(data).splitlines()
    lines = [line for line in written if not re.match(_NO_ROW, line)]
    first = next((line for line in lines if line.strip()), None)
    if first is None:
        return lines
    before = [line for line in written[: written.index(first)] if line.startswith("#")]
    header = before[-1].lstrip("# ") if before else ""
    return [header, *lines] if _is_heading(header, first) else lines


def _is_heading(comment: str, row: str) -> bool:
    """Whether a comment names the columns of a row that has no names itself."""
    separator = max(_SEPARATORS, key=comment.count)
    (names,), (cells,) = (csv.reader([line], delimiter=separator) for line in (comment or " ", row))
    written = [cell.strip() for cell in cells]
    numbers = sum(map(_has_number, written))
    return (
        len(names) == len(cells) > 1
        and not any(map(_has_number, names))
        and 2 * numbers > len(cells)
        and all(name.strip() for name in names)
    )


def _header_line(lines: list[str]) -> str:
    """The first line that is not empty."""
    return next((line for line in lines if line.strip()), "")


def _find_separator(lines: list[str]) -> str:
    """The sign that divides the header most."""
    return max(_SEPARATORS, key=_header_line(lines).count)


def _parse_lines(lines: list[str], infer: bool) -> pl.DataFrame:
    """The lines as a table, without rows that are empty."""
    _refuse_wide(lines)
    separator = _find_separator(lines)
    body = "\n".join(lines).lstrip("\n")
    length = None if infer else 0
    frame = pl.read_csv(io.StringIO(body), separator=separator, infer_schema=infer, infer_schema_length=length)
    _refuse_shared_names(body, separator)
    frame.columns = [name.strip() for name in frame.columns]
    frame = frame.with_columns(pl.col(pl.String).str.strip_chars())
    texts = cs.string()
    return frame.filter(~pl.all_horizontal((texts.is_null() | (texts == "")), (~texts).is_null()))


def _refuse_shared_names(body: str, separator: str) -> None:
    """Refuse two columns of one name, which polars would rename."""
    first = pl.read_csv(io.StringIO(body), separator=separator, has_header=False, n_rows=1, infer_schema=False)
    counts = Counter(name.strip() for name in first.row(0) if name and name.strip())
    if shared := sorted(name for name, count in counts.items() if count > 1):
        raise ValueError(f"two columns have the same name: {', '.join(shared)}")


def with_decimal_points(log: LogTable) -> pl.DataFrame:
    """The table with numbers written another way made numbers: decimal commas, separated thousands.

    Decimal commas only where no number of the file has a decimal point. In a file separated by commas "1,234" may be a
    fraction or a thousand and more: unless another number decides, the table stays as it is.
    """
    texts = log.table.select(pl.col(pl.String).replace("", None))
    fitting = {mark: _number_columns(texts, mark) for mark in _MARKS}
    numbers = set.union(*fitting.values())
    has_point = any(dtype.is_float() for dtype in log.table.schema.values())
    marks = [mark for mark, names in fitting.items() if names == numbers and not (mark == "," and has_point)]
    if not marks or (len(marks) == len(_MARKS) and log.separator == ","):
        return log.table
    plain = pl.col(sorted(numbers)).replace("", None).str.replace("\u2212", "-").str.replace_all(_MARKS[marks[0]], "")
    return log.table.with_columns(plain.str.replace(marks[0], ".", literal=True).cast(pl.Float64))


def _number_columns(texts: pl.DataFrame, mark: str) -> set[str]:
    """The columns whose cells are all numbers with this decimal mark."""
    whole = rf"(?:[0-9]{{1,3}}(?:{_MARKS[mark]}[0-9]{{3}})+|[0-9]+)"
    number = rf"^\s*[+\-\u2212]?(?:{whole}(?:[{mark}][0-9]+)?|[{mark}][0-9]+)(?:[eE][+-]?[0-9]+)?\s*$"
    fits = texts.select(pl.all().str.contains(number).min()).rows(named=True)
    return {name for name, is_number in fits[0].items() if is_number} if texts.width else set()


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
