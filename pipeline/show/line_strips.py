"""The strips of `balise line`: net elements joined to lines by their links, drawn over an axis in kilometres."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

import polars as pl

from schemas.enums import BaliseKind, Navigability
from schemas.frozen import frozen
from schemas.line import LineCause, LineDirection, PieceClass

_TONES = {PieceClass.SUITABLE: "right", PieceClass.UNSUITABLE: "wrong", PieceClass.UNKNOWN: "unknown"}
SIGNS = {
    LineCause.UNSAFE_ACCEPTANCE: "U",
    LineCause.WRONG: "W",
    LineCause.WRONG_TRACK: "N",
    LineCause.CLAIMED_WRONGLY: "M",
    LineCause.OUTAGE: "O",
    LineCause.AMBIGUOUS: "T",
    LineCause.CONFIDENCE: "C",
    LineCause.ALARM: "A",
    LineCause.FEW_SATELLITES: "S",
}
# Of a drawing: what it is wide, and each row of a long line high.
_WIDTH = 1100.0
_LEFT = 40.0
_LANE = 22.0
_ROW = 118.0
_ROW_PIECES = 100
_TICKS_KM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_LETTER = 6.5


@frozen
class Stretch:
    """A net element on a line: its measure grows with the line's kilometres, or falls where it is `reversed`."""

    name: str
    reversed: bool
    begin_m: float
    length_m: float

    def distance_on_line_m(self, measure_m: float) -> float:
        """Distance of a measure from the begin of the line [m]."""
        return self.begin_m + (self.length_m - measure_m if self.reversed else measure_m)


Line = tuple[Stretch, ...]


def lines_of(lengths_m: Mapping[str, float], links: pl.DataFrame) -> list[Line]:
    """Net elements in the order in which a train runs over them, each on one line.

    A line begins where nothing is linked. Where the track branches it goes on over the first element of the survey.
    """
    beyond = _neighbours(lengths_m, links)
    order = list(lengths_m)
    taken: set[str] = set()
    lines = []
    loose = [(name, end) for name in order for end in (0, 1) if not beyond.get((name, end))]
    for start, entered in [*loose, *((name, 0) for name in order)]:
        if start not in taken:
            lines.append(_line_from(start, entered, lengths_m, beyond, taken))
    return lines


def _neighbours(lengths_m: Mapping[str, float], links: pl.DataFrame) -> dict[tuple[str, int], list[tuple[str, int]]]:
    """Ends that each end of a net element is linked to, in the order of the survey."""
    usable = links.filter(pl.col("navigability").cast(pl.String) != Navigability.NONE.value)
    beyond: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for a, end_a, b, end_b in usable.select("netelement_a", "position_a", "netelement_b", "position_b").iter_rows():
        if a in lengths_m and b in lengths_m:
            beyond.setdefault((a, end_a), []).append((b, end_b))
            beyond.setdefault((b, end_b), []).append((a, end_a))
    order = {name: number for number, name in enumerate(lengths_m)}
    return {end: sorted(others, key=lambda other: order[other[0]]) for end, others in beyond.items()}


def _line_from(
    start: str,
    entered: int,
    lengths_m: Mapping[str, float],
    beyond: Mapping[tuple[str, int], list[tuple[str, int]]],
    taken: set[str],
) -> Line:
    """A line of net elements, from one of its ends on."""
    stretches: list[Stretch] = []
    following: tuple[str, int] | None = (start, entered)
    begin_m = 0.0
    while following is not None:
        name, entered = following
        taken.add(name)
        stretches.append(Stretch(name, entered == 1, begin_m, lengths_m[name]))
        begin_m += lengths_m[name]
        following = next((end for end in beyond.get((name, 1 - entered), []) if end[0] not in taken), None)
    return tuple(stretches)


def strips(pieces: pl.DataFrame, links: pl.DataFrame, balises: pl.DataFrame) -> list[str]:
    """A drawing per line of the net elements in `pieces`; `balises`: those of one proposal."""
    ends = pieces.group_by("netelement_id", maintain_order=True).agg(pl.col("to_m").max())
    lines = lines_of(dict(ends.iter_rows()), links)
    parts = {str(name): part for (name,), part in pieces.group_by("netelement_id", maintain_order=True)}
    marks = {str(name): part for (name,), part in balises.group_by("netelement_id", maintain_order=True)}
    return [_strip(number, line, parts, marks) for number, line in enumerate(lines, start=1)]


def _strip(number: int, line: Line, pieces: Mapping[str, pl.DataFrame], balises: Mapping[str, pl.DataFrame]) -> str:
    """The strip of one line."""
    names = line[0].name if len(line) == 1 else f"{line[0].name} to {line[-1].name}"
    total_m = line[-1].begin_m + line[-1].length_m
    first = pieces[line[0].name].row(0, named=True)
    row_m = _ROW_PIECES * float(first["to_m"] - first["from_m"])
    count = max(1, int(-(-total_m // row_m)))
    title = f"Line {number}: {names}, {total_m / 1000.0:.2f} km"
    drawn = "".join(_row_svg(row * row_m, row_m, total_m, row * _ROW, line, pieces, balises) for row in range(count))
    return (
        f'<figure id="strip-{number}"><figcaption><h3>{escape(title)}</h3></figcaption><div class="plot strip">'
        f'<svg viewBox="0 0 {_LEFT + _WIDTH + 20:.0f} {count * _ROW:.0f}" role="img" aria-label="{escape(title)}">'
        f"{drawn}</svg></div></figure>"
    )


@frozen
class _Window:
    """A row of the drawing: from here to there on the line [m], and where that is drawn."""

    begin_m: float
    end_m: float
    scale: float
    top: float

    def x(self, at_m: float) -> float:
        """Where a place is drawn; places outside at the edge."""
        return _LEFT + (min(max(at_m, self.begin_m), self.end_m) - self.begin_m) * self.scale

    def shows_place(self, at_m: float) -> bool:
        """Whether the strip shows a place."""
        return self.begin_m <= at_m < self.end_m or at_m == self.end_m


def _row_svg(
    begin_m: float,
    row_m: float,
    total_m: float,
    top: float,
    line: Line,
    pieces: Mapping[str, pl.DataFrame],
    balises: Mapping[str, pl.DataFrame],
) -> str:
    """Both lanes, balises, an axis in kilometres, and where which net element lies."""
    window = _Window(begin_m, min(begin_m + row_m, total_m), _WIDTH / row_m, top)
    drawn = [_text_svg(4.0, top + 16, "→"), _text_svg(4.0, top + 42, "←"), *_axis_svg(window)]
    for stretch in line:
        if stretch.begin_m >= window.end_m or stretch.begin_m + stretch.length_m <= window.begin_m:
            continue
        drawn += [_piece_svg(piece, stretch, window) for piece in pieces[stretch.name].iter_rows(named=True)]
        drawn += _name_svg(stretch, window)
        if stretch.name in balises:
            drawn += _balise_svg(balises[stretch.name], stretch, window)
    return "".join(drawn)


def _axis_svg(window: _Window) -> Iterator[str]:
    """The axis of kilometres."""
    width_km = _WIDTH / window.scale / 1000.0
    step_km = next((step for step in _TICKS_KM if width_km / step <= 12), _TICKS_KM[-1])
    base = window.top + 72
    yield f'<path class="line track" d="M{_LEFT:.0f} {base:.0f}H{window.x(window.end_m):.1f}"/>'
    number = int(-(-window.begin_m // (1000.0 * step_km)))
    while number * step_km * 1000.0 <= window.end_m:
        x = window.x(number * step_km * 1000.0)
        yield f'<path class="line track" d="M{x:.1f} {base:.0f}v5"/>'
        yield _text_svg(x, base + 17, f"{number * step_km:.4g} km", "middle")
        number += 1


def _name_svg(stretch: Stretch, window: _Window) -> Iterator[str]:
    """Its name below the axis where there is room, and its begin."""
    x0 = window.x(stretch.begin_m)
    x1 = window.x(stretch.begin_m + stretch.length_m)
    if window.shows_place(stretch.begin_m):
        yield f'<path class="line soft" d="M{x0:.1f} {window.top + 92:.0f}v16"/>'
    if len(stretch.name) * _LETTER < x1 - x0:
        yield _text_svg((x0 + x1) / 2, window.top + 104, stretch.name, "middle", "name")


def _balise_svg(balises: pl.DataFrame, stretch: Stretch, window: _Window) -> Iterator[str]:
    """The balises of a stretch."""
    for at_m, kind in balises.select("measure_m", "kind").iter_rows():
        if window.shows_place(stretch.distance_on_line_m(at_m)):
            sign = "|" if kind == BaliseKind.VIRTUAL.value else "‖"
            yield _text_svg(window.x(stretch.distance_on_line_m(at_m)), window.top + 66, sign, "middle")


def _text_svg(x: float, y: float, words: str, anchor: str = "start", kind: str = "") -> str:
    """A text of SVG."""
    look = f' class="{kind}"' if kind else ""
    return f'<text{look} x="{x:.1f}" y="{y:.0f}" text-anchor="{anchor}">{escape(words)}</text>'


def _piece_svg(piece: Mapping[str, Any], stretch: Stretch, window: _Window) -> str:
    """A piece in the lane of its direction on the line; nothing where it lies in another row."""
    first, last = sorted((stretch.distance_on_line_m(piece["from_m"]), stretch.distance_on_line_m(piece["to_m"])))
    if last <= window.begin_m or first >= window.end_m:
        return ""
    kind = PieceClass(piece["piece_class"])
    cause = LineCause(piece["cause"])
    x = window.x(first)
    width = max(window.x(last) - x - 0.6, 0.5)
    along = (piece["direction"] == LineDirection.GROWING.value) != stretch.reversed
    top = window.top + (2.0 if along else 28.0)
    height = _LANE / 2 if kind is PieceClass.UNKNOWN else _LANE
    summary = f"{kind.value}, {cause.value}; {piece['passes']} passes, {piece['lost']} lost"
    place = f"{stretch.name}, {piece['from_m']:.0f} to {piece['to_m']:.0f} m, {piece['direction']}"
    sign = SIGNS.get(cause, "") if kind is PieceClass.UNSUITABLE else ""
    letter = _text_svg(x + width / 2, top + 16, sign, "middle", "name") if sign else ""
    return (
        f'<g><title>{escape(f"{place}: {summary}")}</title><rect class="bars tone-{_TONES[kind]}" x="{x:.1f}" '
        f'y="{top + _LANE - height:.0f}" width="{width:.1f}" height="{height:.0f}"/>{letter}</g>'
    )
