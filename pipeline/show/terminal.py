"""Tables and figures for people: aligned text that fits the terminal."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

import polars as pl

from pipeline.show.layout import Column, fit_table
from schemas.errors import visible

_SAID_EVERY_S = 5.0
_CHANGED_EVERY_S = 0.2
_BOLD = "\x1b[1m"
_PLAIN = "\x1b[0m"
# Right is green, wrong red, not known grey; the word itself says it where there are no colours.
_COLOURS = {"unsafe": "\x1b[1;31m", "failed": "\x1b[31m", "unproven": "\x1b[90m", "safe": "\x1b[32m"}
_VERDICT_WORD = re.compile(r"(?<![\w-])(?:unsafe|failed|unproven|safe)(?![\w-])")
# Where not all columns fit, these stay, the first of them first.
_MATTERS = (
    *("verdict", "run_id", "key", "value", "unsafe_accepted", "failures", "failures_beyond_budget", "hazards"),
    *("hazards_1a", "hazards_1b", "hazards_shift", "hazards_wrong_track", "missed_detections"),
    *("why", "faults", "reasons", "error", "availability"),
)
# Control characters that JSON itself lets stand.
_STEERING = re.compile("[\x7f-\x9f]")


def show_table(frame: pl.DataFrame, title: str = "") -> None:
    """Print a frame to standard output, every row, no wider than the terminal."""
    lines = table_lines(frame, screen_width())
    if sys.stdout.isatty() and not os.environ.get("NO_COLOR"):
        title = f"{_BOLD}{title}{_PLAIN}" if title else ""
        lines = [_colour_verdicts(line) for line in lines]
    print("\n".join([title, *lines] if title else lines))
    if frame.width and not frame.height:
        print("(no rows)")


def show_tables(tables: Mapping[str, pl.DataFrame]) -> None:
    """Print tables under their titles, with an empty line after each."""
    for title, table in tables.items():
        show_table(table, title)
        print()


def show_text(text: str) -> None:
    """Print a sentence: on a terminal in lines that fit, in a pipe in one."""
    if sys.stdout.isatty():
        width = shutil.get_terminal_size().columns
        text = textwrap.fill(text, width, break_long_words=False, break_on_hyphens=False)
    print(text)


def table_lines(frame: pl.DataFrame, width: int | None = None) -> list[str]:
    """A frame as aligned text, two blanks between columns, in lines of at most `width` characters."""
    columns = [
        Column(name, [_value_text(value) for value in frame[name].to_list()], dtype.is_numeric(), _column_rank(name))
        for name, dtype in frame.schema.items()
    ]
    return fit_table(columns, width) if columns else []


def _column_rank(name: str) -> float:
    """How much a column matters; the smaller, the more."""
    return _MATTERS.index(name) if name in _MATTERS else math.inf


def screen_width() -> int | None:
    """Characters of a line: of the terminal, in a pipe what `COLUMNS` says, else without limit."""
    if sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit():
        return shutil.get_terminal_size().columns
    return None


def _colour_verdicts(line: str) -> str:
    """A line with its verdicts coloured."""
    return _VERDICT_WORD.sub(lambda match: f"{_COLOURS[match[0]]}{match[0]}{_PLAIN}", line)


def turn_table(frame: pl.DataFrame, keys: tuple[str, ...]) -> pl.DataFrame:
    """A wide table turned: one line per column, one column per row, headed by its keys."""
    heads = [" ".join(str(part) for part in row if part not in (None, "")) for row in frame.select(keys).iter_rows()]
    names = [name for name in frame.columns if name not in keys]
    rows = [(name, *(_value_text(value) for value in frame[name].to_list())) for name in names]
    return pl.DataFrame(rows, schema=dict.fromkeys(["figure", *heads], pl.String), orient="row")


def to_json(value: Any) -> str:
    """JSON of frames, instants and plain values; what is not known is null."""
    text = json.dumps(_plain_value(value), indent=2, sort_keys=False, ensure_ascii=False)
    return _STEERING.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def duration_text(seconds: float) -> str:
    """A duration as a person says it: `8 s`, `3 min 20 s`, `2 h 5 min`."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    minutes, rest = divmod(whole, 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def _value_text(value: object) -> str:
    """A value as text of a table."""
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
            return " ".join(map(_value_text, value))
        case _:
            return visible(str(value)).replace("\n", r"\n")


def _plain_value(value: Any) -> Any:
    """A value as JSON holds it."""
    match value:
        case pl.DataFrame():
            return [_plain_value(row) for row in value.iter_rows(named=True)]
        case dict():
            return {str(key): _plain_value(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain_value(item) for item in value]
        case datetime():
            return value.isoformat()
        case float() if not math.isfinite(value):
            return None
        case None | bool() | int() | float() | str():
            return value
        case _:
            return str(value)


def progress_printer(things: str) -> Callable[[int, int], None]:
    """Says on standard error how many of how many things are done: in one line that changes, in a pipe every 5 s.

    The time left is that of the things done so far, which need not take as long as the others.
    """
    on_terminal = sys.stderr.isatty()
    begun_s = time.monotonic()
    said_s = time.monotonic() - (_SAID_EVERY_S if on_terminal else 0.0)

    def print_progress(done: int, total: int) -> None:
        """Print how many are done, every so often."""
        nonlocal said_s
        last = on_terminal and done == total
        if last or time.monotonic() - said_s >= (_CHANGED_EVERY_S if on_terminal else _SAID_EVERY_S):
            said_s = time.monotonic()
            left = "" if done in (0, total) else duration_text((said_s - begun_s) / done * (total - done))
            text = f"{done}/{total} {things}" + (f", {left} left" if left else "")
            # What is left of a longer line is wiped out.
            begin, end = ("\r\x1b[K", "\n" if last else "") if on_terminal else ("", "\n")
            print(f"{begin}{text}", end=end, file=sys.stderr, flush=True)

    return print_progress
