"""Plots of lines with bands, and strips of coloured pieces, as SVG; the same content gives the same bytes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from html import escape
from math import ceil, floor, isfinite, log10

from schemas.frozen import frozen

WIDTH, HEIGHT = 900.0, 420.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 62.0, 690.0, 16.0, 370.0
COLOURS = ("#1f5fa8", "#c4561a", "#2b8a3e", "#7a3fa0", "#a1821a", "#0b7285", "#b02a4a", "#555555")

Scale = Callable[[float], float]
Point = tuple[float, float]


def linear_scale(value: float) -> float:
    """The value itself, for axes without a scale."""
    return value


def symmetric_log_scale(value: float) -> float:
    """Linear about zero, logarithmic far from it, for times before and after."""
    return log10(1.0 + abs(value)) * (1.0 if value >= 0.0 else -1.0)


@frozen
class Axis:
    """Title, scale, and the values that it spans and names."""

    title: str
    low: float
    high: float
    ticks: Sequence[float]
    scale: Scale = linear_scale

    def share(self, value: float) -> float:
        """Where on the axis, 0 to 1; what lies beyond stands at its end."""
        low = self.scale(self.low)
        high = self.scale(self.high)
        return min(max((self.scale(value) - low) / (high - low), 0.0), 1.0)


@frozen
class Curve:
    """A named line; `band`: lower and upper y of each point; `marks`: points drawn as open triangles (more than)."""

    name: str
    points: Sequence[Point]
    colour: str
    dashed: bool = False
    band: Sequence[Point] = ()
    marks: Sequence[Point] = field(default=())


def even_ticks(low: float, high: float) -> list[float]:
    """At most ten multiples of 1, 2 or 5 times a power of ten from `low` to `high`."""
    power = 10.0 ** floor(log10((high - low) / 10.0))
    step = next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if (high - low) / (power * factor) <= 10.0)
    return [step * number for number in range(ceil(low / step), floor(high / step) + 1)]


def plot(title: str, x: Axis, y: Axis, curves: Sequence[Curve]) -> str:
    """The whole picture as one SVG element."""
    parts = [*_frame_svg(x, y), *(part for curve in curves for part in _curve_svg(curve, x, y)), *_legend_svg(curves)]
    return svg(title, HEIGHT, parts)


def svg(title: str, height: float, parts: Sequence[str]) -> str:
    """An SVG element that stands for itself, on white."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH:.0f} {height:.0f}" role="img" '
        f'aria-label="{escape(title)}" font-family="sans-serif" font-size="12">'
        f'<rect width="{WIDTH:.0f}" height="{height:.0f}" fill="#ffffff"/>{"".join(parts)}</svg>'
    )


def svg_text(x: float, y: float, words: str, anchor: str = "start") -> str:
    """A text of SVG."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="#222222">{escape(words)}</text>'


def _x_of(axis: Axis, value: float) -> float:
    """Where a value of the horizontal axis is drawn."""
    return _LEFT + axis.share(value) * (_RIGHT - _LEFT)


def _y_of(axis: Axis, value: float) -> float:
    """Where a value of the vertical axis is drawn."""
    return _BOTTOM - axis.share(value) * (_BOTTOM - _TOP)


def _frame_svg(x: Axis, y: Axis) -> list[str]:
    """The frame of a plot with its axes."""
    size = f'width="{_RIGHT - _LEFT}" height="{_BOTTOM - _TOP}"'
    box = f'<rect x="{_LEFT}" y="{_TOP}" {size} fill="none" stroke="#888888"/>'
    parts = [box, svg_text((_LEFT + _RIGHT) / 2, HEIGHT - 8, x.title, "middle"), svg_text(_LEFT, _TOP - 4, y.title)]
    for value in x.ticks:
        at = _x_of(x, value)
        parts += [_line_svg(at, _TOP, at, _BOTTOM), svg_text(at, _BOTTOM + 16, f"{value:g}", "middle")]
    for value in y.ticks:
        at = _y_of(y, value)
        parts += [_line_svg(_LEFT, at, _RIGHT, at), svg_text(_LEFT - 6, at + 4, f"{value:g}", "end")]
    return parts


def _line_svg(x1: float, y1: float, x2: float, y2: float) -> str:
    """A line of the grid."""
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="#dddddd"/>'


def _curve_svg(curve: Curve, x: Axis, y: Axis) -> list[str]:
    """A curve with its band."""
    at = [(_x_of(x, px), _y_of(y, py)) for px, py in curve.points if isfinite(py)]
    parts = []
    if curve.band:
        lows = [(_x_of(x, px), _y_of(y, low)) for (px, _), (low, _) in zip(curve.points, curve.band, strict=True)]
        highs = [(_x_of(x, px), _y_of(y, high)) for (px, _), (_, high) in zip(curve.points, curve.band, strict=True)]
        parts.append(
            f'<polygon points="{_svg_points([*lows, *reversed(highs)])}" fill="{curve.colour}" opacity="0.06"/>'
        )
    dash = ' stroke-dasharray="6 4"' if curve.dashed else ""
    parts.append(
        f'<polyline points="{_svg_points(at)}" fill="none" stroke="{curve.colour}" stroke-width="1.6"{dash}>'
        f"<title>{escape(curve.name)}</title></polyline>"
    )
    for px, py in curve.marks:
        left = _x_of(x, px)
        top = _y_of(y, py)
        corners = [(left - 5, top + 4), (left + 5, top + 4), (left, top - 5)]
        parts.append(f'<polygon points="{_svg_points(corners)}" fill="#ffffff" stroke="{curve.colour}"/>')
    return parts


def _svg_points(points: Sequence[Point]) -> str:
    """Points as an attribute of SVG."""
    return " ".join(f"{px:.1f},{py:.1f}" for px, py in points)


def _legend_svg(curves: Sequence[Curve]) -> list[str]:
    """The names of the curves."""
    parts = []
    left = _RIGHT + 10
    for number, curve in enumerate(curves):
        at = _TOP + 10 + 16 * number
        dash = ' stroke-dasharray="6 4"' if curve.dashed else ""
        parts.append(
            f'<line x1="{left}" y1="{at}" x2="{left + 24}" y2="{at}" stroke="{curve.colour}" stroke-width="2"{dash}/>'
        )
        parts.append(svg_text(_RIGHT + 40, at + 4, curve.name))
    return parts


_STRIP_LEFT, _STRIP_WIDTH = 150.0, 730.0
_LANE = 20.0
# From little to much.
_SHADES = ("#e8eef5", "#b9cfe6", "#f3d9a4", "#e79a5b", "#c0392b")


@frozen
class Piece:
    """From here to there on its strip [m], with a value for each lane, None where not known, and words to show."""

    begin_m: float
    end_m: float
    values: tuple[float | None, ...]
    words: str


def strips_svg(title: str, rows: Mapping[str, Sequence[Piece]], scales: Mapping[str, Sequence[float]]) -> str:
    """A strip for each of the named rows of pieces, in order; a lane for each scale: its limits between five shades."""
    longest_m = max(row[-1].end_m - row[0].begin_m for row in rows.values())
    parts = []
    top = 8.0
    for name, row in rows.items():
        begin_m = row[0].begin_m
        parts.append(svg_text(8.0, top + 24.0, f"{name} from {begin_m:.0f} m"))
        for piece in row:
            left = _STRIP_LEFT + (piece.begin_m - begin_m) / longest_m * _STRIP_WIDTH
            width = (piece.end_m - piece.begin_m) / longest_m * _STRIP_WIDTH - 0.6
            for lane, (value, limits) in enumerate(zip(piece.values, scales.values(), strict=True)):
                parts.append(_piece_svg(left, top + lane * _LANE, width, value, limits, piece.words))
        top += len(scales) * _LANE + 10.0
    for number, (what, limits) in enumerate(scales.items()):
        parts += _shade_legend_svg(top + 8.0 + 18.0 * number, what, limits)
    return svg(title, top + 8.0 + 18.0 * len(scales), parts)


def _piece_svg(left: float, top: float, width: float, value: float | None, limits: Sequence[float], words: str) -> str:
    """A piece of a strip, shaded by its value."""
    colour = "#ffffff" if value is None else _SHADES[sum(value > limit for limit in limits)]
    return (
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{max(width, 1.0):.1f}" height="{_LANE - 2:.0f}" fill="{colour}" '
        f'stroke="#999999" stroke-width="0.5"><title>{escape(words)}</title></rect>'
    )


def _shade_legend_svg(top: float, what: str, limits: Sequence[float]) -> list[str]:
    """What the shades of a lane mean."""
    names = [f"to {limits[0]:g}", *(f"to {limit:g}" for limit in limits[1:]), f"over {limits[-1]:g}"]
    parts = [svg_text(8.0, top + 11.0, what)]
    for number, (name, shade) in enumerate(zip(names, _SHADES, strict=True)):
        left = _STRIP_LEFT + 110.0 * number
        parts.append(f'<rect x="{left:.0f}" y="{top:.0f}" width="14" height="13" fill="{shade}" stroke="#999999"/>')
        parts.append(svg_text(left + 20.0, top + 11.0, name))
    return parts
