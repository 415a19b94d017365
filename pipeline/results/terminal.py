"""Tables and figures for people: boxes on a terminal, aligned plain text in a pipe."""

from __future__ import annotations

import json
import math
import re
import sys
import time
from collections.abc import Callable
from datetime import datetime
from typing import Any

import polars as pl
from rich.console import Console
from rich.table import Table

from schemas.errors import visible

_SAID_EVERY_S = 5.0
# Control characters that JSON itself lets stand.
_STEERING = re.compile("[\x7f-\x9f]")


def show_table(frame: pl.DataFrame, title: str = "") -> None:
    """Print a frame to standard output, whole."""
    if sys.stdout.isatty():
        Console().print(_boxed(frame, title))
    else:
        print(plain_table(frame, title))


def plain_table(frame: pl.DataFrame, title: str = "") -> str:
    """A frame as aligned text, two blanks between columns."""
    cells = [list(frame.columns), *([_text(value) for value in row] for row in frame.iter_rows())]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    right = [_is_number(dtype) for dtype in frame.dtypes]
    lines = [title] if title else []
    for row in cells:
        parts = [
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(row, widths, right, strict=True)
        ]
        lines.append("  ".join(parts).rstrip())
    return "\n".join(lines)


def tall(frame: pl.DataFrame, keys: tuple[str, ...]) -> pl.DataFrame:
    """A wide table turned: one line per column, one column per row, headed by its keys."""
    heads = [" ".join(str(part) for part in row if part not in (None, "")) for row in frame.select(keys).iter_rows()]
    names = [name for name in frame.columns if name not in keys]
    rows = [(name, *(_text(value) for value in frame[name].to_list())) for name in names]
    return pl.DataFrame(rows, schema=dict.fromkeys(["figure", *heads], pl.String), orient="row")


def to_json(value: Any) -> str:
    """JSON of frames, instants and plain values; what is not known is null."""
    text = json.dumps(_plain(value), indent=2, sort_keys=False, ensure_ascii=False)
    return _STEERING.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def duration_text(seconds: float) -> str:
    """A duration as a person says it: `8 s`, `3 min 20 s`, `2 h 5 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def _boxed(frame: pl.DataFrame, title: str) -> Table:
    table = Table(title=title or None, title_justify="left", header_style="bold")
    for name, dtype in frame.schema.items():
        table.add_column(name, justify="right" if _is_number(dtype) else "left", overflow="fold")
    for row in frame.iter_rows():
        table.add_row(*(_text(value).replace("[", r"\[") for value in row))
    return table


def _is_number(dtype: pl.DataType) -> bool:
    return dtype.is_numeric()


def _text(value: object) -> str:
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.6g}"
        case datetime():
            return value.isoformat(sep=" ", timespec="milliseconds").removesuffix("+00:00")
        case list():
            return " ".join(map(_text, value))
        case _:
            return visible(str(value)).replace("\n", r"\n")


def _plain(value: Any) -> Any:
    match value:
        case pl.DataFrame():
            return [_plain(row) for row in value.iter_rows(named=True)]
        case dict():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case datetime():
            return value.isoformat()
        case float() if not math.isfinite(value):
            return None
        case None | bool() | int() | float() | str():
            return value
        case _:
            return str(value)


def how_far(things: str) -> Callable[[int, int], None]:
    """Says on standard error every few seconds how many of how many things are done."""
    said_s = time.monotonic()

    def progress(done: int, total: int) -> None:
        nonlocal said_s
        if time.monotonic() - said_s >= _SAID_EVERY_S:
            said_s = time.monotonic()
            print(f"{done}/{total} {things}", file=sys.stderr, flush=True)

    return progress
