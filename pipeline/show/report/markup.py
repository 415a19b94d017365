"""Pieces of a page: HTML whose text is escaped, and numbers for its script, the same bytes for the same content."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from functools import cache
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
import numpy.typing as npt

from schemas.frozen import frozen

Json = Any

UNKNOWN = "–"
_LONG = 40
# A table shows so many columns, which fit a screen and a sheet of paper; a switch shows the rest.
_SHOWN_COLUMNS = 10
# What a page takes along: it is one file.
_SHARED_SCRIPTS = ("tables.js", "scales.js", "plots.js", "plans.js")


@frozen
class Cell:
    """What is shown, what it is sorted by, and HTML instead of the text where there is some.

    `tone`: `bad` (wrong), `doubt` (not known), `lost` or `good`; a sign before the text says the same.
    """

    text: str
    order: float | str | None = None
    html: str | None = None
    tone: str = ""


def value_cell(value: object, digits: int = 3) -> Cell:
    """A value as a person reads it; numbers and instants sort by themselves."""
    match value:
        case None:
            return Cell(UNKNOWN)
        case bool():
            return Cell("yes" if value else "no", "yes" if value else "no")
        case int() | float():
            return Cell(number(value, digits), float(value))
        case datetime():
            return Cell(instant(value), value.isoformat())
        case list() | tuple():
            text = ", ".join(number(item, digits) if isinstance(item, float) else str(item) for item in value)
            return Cell(text or UNKNOWN, text)
        case _:
            return Cell(str(value), str(value))


def number(value: float | None, digits: int = 3) -> str:
    """A number with so many significant digits, whole numbers as they are."""
    if value is None:
        return UNKNOWN
    if isinstance(value, int) or (float(value).is_integer() and abs(value) < 1e9):
        return f"{int(value):,}".replace(",", "\u202f")
    if abs(value) >= 10 ** (digits - 1):
        return f"{value:,.{max(0, digits - 3)}f}".replace(",", "\u202f")
    return f"{value:.{digits}g}"


def instant(value: datetime) -> str:
    """UTC to the millisecond."""
    return value.strftime("%Y-%m-%d %H:%M:%S.") + f"{value.microsecond // 1000:03d}"


def link(href: str, text: str, **attributes: str) -> str:
    """A link; where there is no page to go to, the text alone."""
    if not href:
        return escape(text)
    extra = "".join(f' {name.replace("_", "-")}="{escape(value)}"' for name, value in attributes.items())
    return f'<a href="{escape(href)}"{extra}>{escape(text)}</a>'


def table(identity: str, caption: str, heads: Sequence[tuple[str, str]], rows: Sequence[Sequence[Cell]]) -> str:
    """A table whose columns have a title and a meaning; the script sorts it, and searches a long one.

    The first columns matter most: those beyond ten stand behind a switch that needs no script.
    """
    if not rows:
        return f'<p class="none">{escape(caption)}: none.</p>'
    numeric = [any(isinstance(item.order, float) for item in column) for column in zip(*rows, strict=True)]
    beyond = [number >= _SHOWN_COLUMNS for number in range(len(heads))]
    body = "\n".join(f"<tr>{''.join(map(_cell_html, row, numeric, beyond))}</tr>" for row in rows)
    titles = "".join(map(_heading_html, heads, numeric, beyond))
    switch = f'<label class="all"><input type="checkbox"> all {len(heads)} columns</label>' if any(beyond) else ""
    return (
        f'<div class="columns">{switch}<div class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}">'
        f'<table class="data" id="{identity}"><caption>{escape(caption)}</caption>'
        f"<thead><tr>{titles}</tr></thead><tbody>\n{body}\n</tbody></table></div></div>"
    )


def pairs(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values, text only."""
    items = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>" for name, value in rows)
    return f'<dl class="pairs">{items}</dl>'


def tiles(rows: Iterable[tuple[str, str, str]]) -> str:
    """The figures that matter, large: name, value and tone as of a cell."""
    items = "".join(
        f'<div class="tile {tone}"><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>' for name, value, tone in rows
    )
    return f'<dl class="tiles">{items}</dl>'


def section(identity: str, title: str, *content: str) -> str:
    """A section of a page with its heading."""
    inner = "\n".join(part for part in content if part)
    return f'<section id="{identity}"><h2>{escape(title)}</h2>\n{inner}\n</section>'


def figure(name: str, title: str, explanation: str = "") -> str:
    """A place for a drawing; the script fills it."""
    note = f"<p>{escape(explanation)}</p>" if explanation else ""
    return (
        f'<figure id="figure-{name}"><figcaption><h3>{escape(title)}</h3>{note}</figcaption>'
        f'<div class="plot" id="plot-{name}" role="img" aria-label="{escape(title)}"></div></figure>'
    )


def badge(kind: str, text: str = "") -> str:
    """A coloured word."""
    return f'<span class="badge {escape(kind)}">{escape(text or kind)}</span>'


def verdict_head(word: str, worst: str, reasons: str = "", figures_text: str = "") -> str:
    """The verdict as the first sentence of a page, coloured by it, and what speaks for it."""
    figures = f"<br>{escape(figures_text[0].upper() + figures_text[1:])}." if figures_text else ""
    why = f"<br><small>{escape(reasons)}</small>" if reasons else ""
    return f'<p class="verdict {escape(word)}"><strong>{escape(word)}</strong>: {escape(worst)}.{figures}{why}</p>'


def page(title: str, heading: str, body: str, data: str, script: str, foot: str) -> str:
    """A whole page in one file. The policy lets no script run but ours, and no request leave.

    `title` and `foot` stand on each sheet of paper.
    """
    shared = _own_file("report.css")
    printed = _print_css(title, foot)
    code = _script_code(script)
    styles = f"{_policy_digest(shared)} {_policy_digest(printed)}"
    policy = (
        f"default-src 'none'; script-src {_policy_digest(code)}; style-src {styles}; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    parts = {"heading": heading, "body": _number_captions(body), "data": data, "code": code, "shared": shared}
    return Template(_own_file("page.html")).substitute(parts, policy=policy, title=escape(title), printed=printed)


@cache
def _own_file(name: str) -> str:
    """Text of a file of this package."""
    return (files("pipeline.show.report") / name).read_text(encoding="utf-8")


@cache
def _script_code(script: str) -> str:
    """The code of a page's script, with what all share."""
    return "\n".join(_own_file(name) for name in (*_SHARED_SCRIPTS, script))


@cache
def _policy_digest(content: str) -> str:
    """The source of the policy that allows this very script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


def _print_css(head: str, foot: str) -> str:
    """What stands at the top and the bottom of each sheet of paper."""
    return (
        f"@page {{ @top-left {{ content: {_css_text(head)}; }} @bottom-left {{ content: {_css_text(foot)}; }}"
        ' @bottom-right { content: "page " counter(page) " of " counter(pages); } }'
    )


def _css_text(text: str) -> str:
    """A string of CSS in which no character of the text can end anything."""
    return '"' + re.sub(r"[^A-Za-z0-9 .,:]", lambda match: f"\\{ord(match[0]):x} ", text) + '"'


def _number_captions(body: str) -> str:
    """Figures and tables with their numbers, in the order of the page."""
    for opening, word in (("<figcaption><h3>", "Figure"), ("<caption>", "Table")):
        first, *parts = body.split(opening)
        body = first + "".join(f"{opening}{word} {number}. {part}" for number, part in enumerate(parts, start=1))
    return body


def _heading_html(head: tuple[str, str], numeric: bool, beyond: bool) -> str:
    """A heading of a table."""
    title, meaning = head
    kind = _class_attribute("number" * numeric, "more" * beyond)
    hint = f' title="{escape(meaning)}"' if meaning else ""
    return f'<th scope="col"{kind}{hint}>{escape(title)}</th>'


def _cell_html(item: Cell, numeric: bool, beyond: bool) -> str:
    """A cell of a table."""
    wide = not numeric and len(item.text) > _LONG
    classes = _class_attribute("number" * numeric, "long" * wide, item.tone, "more" * beyond)
    content = escape(item.text) if item.html is None else item.html
    return f"<td{_sort_attribute(item.order)}{classes}>{content}</td>"


def _sort_attribute(order: float | str | None) -> str:
    """The attribute that a cell is sorted by."""
    if order is None:
        return ""
    key = repr(order) if isinstance(order, float) else order
    return f' data-order="{escape(key)}"'


def _class_attribute(*names: str) -> str:
    """The attribute of classes; nothing without any."""
    given = " ".join(name for name in names if name)
    return f' class="{given}"' if given else ""


def pack_numbers(values: npt.ArrayLike, kind: str) -> dict[str, str]:
    """Little-endian numbers as base64; `kind` is `f4`, `u4` or `u1`. NaN stands for not known."""
    array = np.asarray(values).astype(f"<{kind}")
    return {"kind": kind, "data": base64.b64encode(array.tobytes()).decode("ascii")}


def pack_line(name: str, x: npt.ArrayLike, y: npt.ArrayLike) -> Json:
    """A named line of a drawing."""
    return {"name": name, "x": pack_numbers(x, "f4"), "y": pack_numbers(y, "f4")}


def script_json(value: Json) -> str:
    """JSON that may stand inside a script element."""
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False, sort_keys=True)
    # Neither an end tag nor a comment of HTML may arise from data.
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
