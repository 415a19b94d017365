"""Tables of text that fit a width.

Headings break at `_` and long texts at blanks, no word. A table that is too wide all the same is turned, one line per
column, where it has few rows; else those columns stay that matter most, their long texts below each row, and the last
line says how many are left out.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from itertools import zip_longest

from schemas.frozen import frozen

_GAP = 2
_HEADING_LINES = 3
# A text column is not folded to less than this, or than its longest word; one beyond reason breaks at its signs.
_NARROWEST = 10
_LONGEST_WORD = 40
_LONG_TEXT = 24
_INDENT = "    "
_NOTHING = ("-", "", "none")
_FEW_ROWS = 5


@frozen
class Column:
    """A column as text; numbers stand to the right and are never folded. `rank`: the smaller, the more it matters."""

    heading: str
    cells: Sequence[str]
    is_number: bool = False
    rank: float = math.inf

    @property
    def natural_width(self) -> int:
        """Characters that the column takes when nothing is folded."""
        return max(1, *map(len, [self.heading, *self.cells]))

    @property
    def least_width(self) -> int:
        """Characters below which it cannot be read."""
        widest = max(map(len, self.cells), default=0)
        if not self.is_number:
            words = (len(word) for cell in self.cells for word in cell.split())
            widest = min(widest, max(_NARROWEST, min(max(words, default=0), _LONGEST_WORD)))
        return max(widest, self.least_heading)

    @property
    def unfolded_width(self) -> int:
        """Characters that leave all but long texts in one line."""
        widest = max(map(len, self.cells), default=0)
        return max(min(widest, _LONG_TEXT), self.least_width)

    @property
    def is_empty(self) -> bool:
        """Whether it has rows and no value."""
        return bool(self.cells) and set(self.cells) <= {"-", ""}

    @property
    def least_heading(self) -> int:
        """The width at which the heading takes about three lines, and none of its words breaks."""
        longest = max(map(len, re.split(r"\s+|(?<=_)", self.heading)))
        return max(1, longest, math.ceil(len(self.heading) / _HEADING_LINES))


def fit_table(columns: Sequence[Column], width: int | None) -> list[str]:
    """The lines of a table that is no wider than `width` characters, headings first; None: as wide as it is."""
    if width is None or _total_width(naturals := [column.natural_width for column in columns]) <= width:
        return _lines(columns, [column.natural_width for column in columns], broken=False)
    least = [column.least_width for column in columns]
    if _total_width(least) <= width:
        return _lines(columns, _share_width(least, naturals, width), broken=True)
    rows = len(columns[0].cells)
    if 0 < rows <= _FEW_ROWS:
        turned = _transpose(columns, rows)
        if _total_width([column.least_width for column in turned]) <= width:
            return fit_table(turned, width)
    return _fit_by_rank(columns, width)


def _fit_by_rank(columns: Sequence[Column], width: int) -> list[str]:
    """The first column with a value and those of the least rank that fit, in their order.

    Texts that matter and are long, or do not fit beside the others, stand below each row. The last line says how many
    columns are left out.
    """
    first, *others = [column for column in columns if not column.is_empty] or columns[:1]
    chosen = [first]
    below = []
    for column in sorted(others, key=lambda column: column.rank):
        is_text = not column.is_number and column.rank < math.inf
        fits = _total_width([item.unfolded_width for item in (*chosen, column)]) <= width
        if is_text and (not fits or column.natural_width > 2 * _LONG_TEXT):
            below.append(column)
        elif fits:
            chosen.append(column)
    kept = [column for column in columns if column in chosen]
    widths = _share_width([column.unfolded_width for column in kept], [column.natural_width for column in kept], width)
    out = len(columns) - len(kept) - len(below)
    note = (
        f"{out} of {len(columns)} columns are left out: they do not fit {width} characters or hold"
        " no value. Ask for fewer columns, or for all with --json."
    )
    return [*_lines(kept, widths, broken=True, below=below, width=width), *(textwrap.wrap(note, width) if out else [])]


def _transpose(columns: Sequence[Column], rows: int) -> list[Column]:
    """One line per column of the table, one column per row."""
    heads = [""] if rows == 1 else [f"row {number}" for number in range(1, rows + 1)]
    names = Column("", [column.heading for column in columns])
    return [names, *(Column(head, [column.cells[row] for column in columns]) for row, head in enumerate(heads))]


def _share_width(least: list[int], wanted: list[int], width: int) -> list[int]:
    """Widths between `least` and `wanted`: what is left of the width goes to the narrowest wishes first."""
    widths = list(least)
    spare = width - _total_width(least)
    wishes = sorted((want - have, at) for at, (want, have) in enumerate(zip(wanted, least, strict=True)))
    for turn, (wish, at) in enumerate(wishes):
        more = max(0, min(wish, spare // (len(wishes) - turn)))
        widths[at] += more
        spare -= more
    return widths


def _lines(
    columns: Sequence[Column], widths: list[int], broken: bool, below: Sequence[Column] = (), width: int = 0
) -> list[str]:
    """Headings and rows; the columns `below` under each row, in lines of at most `width` characters."""
    rights = [column.is_number for column in columns]
    headings = [_fold_heading(c.heading, w) if broken else [c.heading] for c, w in zip(columns, widths, strict=True)]
    deepest = max(map(len, headings))
    lines = _row_lines([[""] * (deepest - len(part)) + part for part in headings], widths, rights)
    if not any(column.heading for column in columns):
        lines = []
    for row, cells in enumerate(zip(*(column.cells for column in columns), strict=True)):
        lines += _row_lines(
            [_fold_cell(cell, width) for cell, width in zip(cells, widths, strict=True)], widths, rights
        )
        for column in below:
            if column.cells[row] not in _NOTHING:
                lines += [
                    _INDENT + part
                    for part in _fold_cell(f"{column.heading}: {column.cells[row]}", width - len(_INDENT))
                ]
    return lines


def _row_lines(parts: list[list[str]], widths: list[int], rights: list[bool]) -> list[str]:
    """One row of the table, as many lines as its deepest cell."""
    signs = [">" if right else "<" for right in rights]
    return [
        (" " * _GAP).join(f"{c:{s}{w}}" for c, s, w in zip(cells, signs, widths, strict=True)).rstrip()
        for cells in zip_longest(*parts, fillvalue="")
    ]


class _Words(textwrap.TextWrapper):
    """Breaks at blanks; a word that is longer than the line behind its signs."""

    def _split(self, text: str) -> list[str]:
        """Pieces of a text that a line may end behind."""
        return [
            piece
            for word in super()._split(text)
            for piece in (re.split(r"(?<=[_/.,:=-])", word) if len(word) > self.width else [word])
            if piece
        ]


def _fold_cell(cell: str, width: int) -> list[str]:
    """A cell in lines of at most this width."""
    if len(cell) <= width:
        return [cell]
    return _Words(width, break_on_hyphens=False).wrap(cell) or [""]


class _Headings(textwrap.TextWrapper):
    """Breaks behind `_` and at blanks."""

    wordsep_re = re.compile(r"(\s+|(?<=_))")


def _fold_heading(heading: str, width: int) -> list[str]:
    """A heading in lines of at most this width."""
    return _Headings(width).wrap(heading) or [""]


def _total_width(widths: Sequence[int]) -> int:
    """Width of columns with the gaps between them."""
    return sum(widths) + _GAP * (len(widths) - 1)
