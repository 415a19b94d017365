"""CSV as programs and spreadsheets write it: byte order marks, other separators than the comma, empty lines."""

from __future__ import annotations

import codecs
import io
import re
from pathlib import Path

import polars as pl

from schemas.errors import InputError

_SEPARATORS = (",", ";", "\t")
_MOST_COMMENTS = 50
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def read_table(data: bytes, infer: bool) -> pl.DataFrame:
    """The table, as texts or (`infer`) with types by content; lines that start with # are left out.

    The separator is the one of comma, semicolon and tab that divides the header most. Names and texts lose the
    blanks around them. Raises ValueError or a polars error where there is no table.
    """
    return _table(_lines(data), infer)


def read_log_table(log: Path, infer: bool) -> tuple[pl.DataFrame, int]:
    """`read_table` of a log, without a last row that breaks off, and the number of such rows (0 or 1).

    A recorder that lost power leaves half a row: without a line end, and with fewer fields than the header. Raises
    `InputError` where the file cannot be read or holds no table.
    """
    try:
        return _whole_rows(log.read_bytes(), infer)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", place=str(log)) from None
    except (ValueError, pl.exceptions.PolarsError) as error:
        raise InputError(f"is not a CSV file: {str(error).splitlines()[0]}", place=str(log)) from None


def _whole_rows(data: bytes, infer: bool) -> tuple[pl.DataFrame, int]:
    lines = _lines(data)
    separator = _separator(lines)
    header = next((line for line in lines if line.strip()), "")
    ended = data.rstrip(b" \0").endswith((b"\n", b"\r"))
    cut = len(lines) > 1 and not ended and lines[-1].count(separator) < header.count(separator)
    return _table(lines[:-1] if cut else lines, infer), int(cut)


def _lines(data: bytes) -> list[str]:
    return [line for line in text_of(data).splitlines() if not line.startswith("#")]


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
    return frame.filter(~pl.all_horizontal(_is_empty(name, dtype) for name, dtype in frame.schema.items()))


def _names(body: str, separator: str, given: list[str]) -> list[str]:
    """Names without blanks around them; polars gives those that stand twice names of their own."""
    first = pl.read_csv(io.StringIO(body), separator=separator, has_header=False, n_rows=1, infer_schema=False)
    written = [name.strip() for name in first.row(0) if name and name.strip()]
    twice = sorted({name for name in written if written.count(name) > 1})
    if twice:
        raise ValueError(f"two columns have the same name: {', '.join(twice)}")
    return [name.strip() for name in given]


def _is_empty(name: str, dtype: pl.DataType) -> pl.Expr:
    empty = pl.col(name).is_null()
    return empty | (pl.col(name) == "") if dtype == pl.String else empty


def comments_of(data: bytes) -> str:
    """The comment lines at the top."""
    return "\n".join(line for line in text_of(data).splitlines()[:_MOST_COMMENTS] if line.startswith("#"))


def text_of(data: bytes) -> str:
    """The text; UTF-8, or UTF-16 where a byte order mark says so."""
    return data.decode("utf-16") if data.startswith(_UTF16) else data.decode("utf-8-sig")


def epsg_in(comments: str) -> str | None:
    """The EPSG code that a comment names (`# epsg: 31370`)."""
    named = re.search(r"epsg\s*[:=]\s*(?:EPSG:)?(\w+)", comments, re.IGNORECASE)
    return named.group(1) if named else None
