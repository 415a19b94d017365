"""The files of `balise line`: the page with classes and causes along each net element, tables, GeoJSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.results.places import ground_of
from pipeline.show.report.columns import frame_table
from pipeline.show.report.markup import page, pairs, script_json, section, tiles
from pipeline.storage import write_bytes
from pipeline.studies.line import LineResult, site_balises
from schemas.arrays import floats
from schemas.config import to_toml
from schemas.line import LineBalises, LineCause, LineDirection, LinePieces, LineProposals, PieceClass
from schemas.version import SOFTWARE

_TONES = {PieceClass.SUITABLE: "right", PieceClass.UNSUITABLE: "wrong", PieceClass.UNKNOWN: "unknown"}
_SIGNS = {
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
_WIDTH = 1100.0
_LANE = 22.0
_ROW_PIECES = 100
_OPEN = ("piece_class", "cause", "netelement_id", "from_m", "to_m", "direction", "passes", "right", "lost")
_COLUMNS = (*_OPEN, "wrong_in_use", "few_satellites", "claimed_wrongly", "unknown", "unjudged", "after_alarm",
            "loss_share", "unsafe_high",
            "passes_needed", "hours_of_day", "days", "monitors", "largest_undetected_m")  # fmt: skip


def write_line(result: LineResult, to: Path) -> list[Path]:
    """Page, tables, GeoJSON and the balises of each proposal; the page first."""
    criteria = result.line.criteria
    proposed = result.balises
    files = {
        "index.html": line_page(result),
        "pieces.csv": result.pieces.write_csv(),
        "proposals.csv": result.proposals.write_csv(),
        "proposed_balises.csv": proposed.write_csv(),
        "line.geojson": line_geojson(result),
        "criteria.toml": to_toml(criteria),
    }
    for (name,), balises in proposed.group_by("proposal", maintain_order=True):
        files[f"{name}/balises.csv"] = site_balises(balises, criteria).write_csv()
    for name, content in files.items():
        write_bytes(to / name, content.encode())
    return [to / name for name in files]


def line_geojson(result: LineResult) -> str:
    """Pieces as lines and proposed balises as points (RFC 7946)."""
    line = result.line
    pieces = result.line.pieces
    steps = np.linspace(0.0, 1.0, 6)
    measures = pieces.from_m[:, None] + (pieces.to_m - pieces.from_m)[:, None] * steps
    ground = ground_of(
        line.site.track, pl.Series(np.repeat(pieces.names, steps.size), dtype=pl.String), measures.ravel()
    )
    places = (
        np.round(np.column_stack([ground.longitude_deg, ground.latitude_deg]), 8).reshape(-1, steps.size, 2).tolist()
    )
    features = [
        _feature("LineString", places[row["piece"]], {"kind": "piece", **row})
        for row in result.pieces.iter_rows(named=True)
    ]
    at = ground_of(line.site.track, result.balises["netelement_id"], floats(result.balises, "measure_m"))
    spots = np.round(np.column_stack([at.longitude_deg, at.latitude_deg]), 8).tolist()
    features += [
        _feature("Point", spot, {**row, "kind": "balise", "kind_of_balise": row["kind"]})
        for spot, row in zip(spots, result.balises.iter_rows(named=True), strict=True)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features}, separators=(",", ":"), allow_nan=False)


def _feature(kind: str, coordinates: list[object], properties: dict[str, object]) -> dict[str, object]:
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def line_page(result: LineResult) -> str:
    """One offline page."""
    pieces = result.pieces
    balises = result.balises
    criteria = result.line.criteria
    passed = _with_passes(pieces)
    body = "\n".join(
        [
            _tiles(pieces),
            section("limits", "What these runs cannot say", _list(result.remarks)),
            section("line", "The line", _key(), *_strips(pieces, balises)),
            section(
                "proposals",
                "Proposals side by side",
                frame_table("t-proposals", "Proposals", result.proposals, contract=LineProposals),
            ),
            section("balises", "Proposed balises", frame_table("t-balises", "Balises", balises, contract=LineBalises)),
            section("pieces", "Pieces", frame_table("t-pieces", "Pieces with passes", passed, _COLUMNS, LinePieces)),
            section("criteria", "Criteria", pairs((name, str(value)) for name, value in criteria.model_dump().items())),
        ]
    )
    title = f"Line: criteria {criteria.name} {criteria.version}"
    source = f"Criteria by {criteria.source}. No conformity with any procedure is claimed."
    heading = f"<h1>{escape(title)}</h1><p>{escape(source)}</p>"
    return page(title, heading, body, script_json({}), "line.js", SOFTWARE)


def _tiles(pieces: pl.DataFrame) -> str:
    tones = {PieceClass.SUITABLE: "good", PieceClass.UNSUITABLE: "bad", PieceClass.UNKNOWN: "doubt"}
    rows = []
    for side in LineDirection:
        of_side = pieces.filter(pl.col("direction") == side.value)
        for kind, tone in tones.items():
            length_m = (
                of_side.filter(pl.col("piece_class") == kind.value)
                .select((pl.col("to_m") - pl.col("from_m")).sum())
                .item()
            )
            rows.append((f"{kind.value}, {side.value} measure", f"{length_m / 1000.0:.2f} km", tone))
    return tiles(rows)


def _with_passes(pieces: pl.DataFrame) -> pl.DataFrame:
    """Pieces that some run says something of, what is bad first."""
    spoken = pl.sum_horizontal("passes", "unknown", "after_alarm", "claimed_wrongly") > 0
    order = pl.col("piece_class").cast(pl.String).replace_strict({"unsuitable": 0, "unknown": 1, "suitable": 2})
    return pieces.filter(spoken).sort(order, "piece", "direction", maintain_order=True)


def _list(texts: Sequence[str]) -> str:
    return f'<ul class="notice">{"".join(f"<li>{escape(text)}</li>" for text in texts)}</ul>'


def _key() -> str:
    words = ", ".join(f"{sign} {cause.value.replace('_', ' ')}" for cause, sign in _SIGNS.items())
    return (
        '<p class="keys">Upper lane growing, lower lane falling measure. Full height suitable, half height unknown, '
        f"full height with a letter unsuitable: {escape(words)}. Balises of the first proposal below: "
        "| virtual, ‖ physical.</p>"
    )


def _strips(pieces: pl.DataFrame, balises: pl.DataFrame) -> list[str]:
    """A drawing per net element that was passed, long ones over several rows."""
    spoken = _with_passes(pieces)["netelement_id"].unique()
    shown = pieces.filter(pl.col("netelement_id").is_in(spoken.implode()))
    first = balises.filter(pl.col("proposal") == balises["proposal"][0]) if balises.height else balises
    drawings = []
    for (name,), of_element in shown.group_by("netelement_id", maintain_order=True):
        start = int(of_element["piece"].min() or 0)  # type: ignore[arg-type]
        for (row,), part in of_element.group_by((pl.col("piece") - start) // _ROW_PIECES, maintain_order=True):
            drawings.append(_strip(str(name), part, first.filter(pl.col("netelement_id") == name), int(row)))
    return drawings


def _strip(name: str, part: pl.DataFrame, balises: pl.DataFrame, row: int) -> str:
    begin_m, end_m = float(part["from_m"].min()), float(part["to_m"].max())  # type: ignore[arg-type]
    scale = _WIDTH / max(_ROW_PIECES * (end_m - begin_m) / (part.height / 2), 1e-9)
    marks = [_block(piece, begin_m, scale) for piece in part.iter_rows(named=True)]
    for at_m, kind in (
        balises.filter(pl.col("measure_m").is_between(begin_m, end_m)).select("measure_m", "kind").iter_rows()
    ):
        x = 40.0 + (at_m - begin_m) * scale
        marks.append(f'<text x="{x:.1f}" y="66" text-anchor="middle">{"|" if kind == "virtual" else "‖"}</text>')
    title = f"{name}, {begin_m:.0f} to {end_m:.0f} m"
    caption = f"<figcaption><h3>{escape(title)}</h3></figcaption>"
    return (
        f'<figure id="strip-{escape(name)}-{row}">{caption}<div class="plot"><svg viewBox="0 0 1160 72" role="img" '
        f'aria-label="{escape(title)}"><text x="4" y="16">→</text><text x="4" y="42">←</text>{"".join(marks)}</svg>'
        "</div></figure>"
    )


def _block(piece: dict[str, object], begin_m: float, scale: float) -> str:
    kind = PieceClass(str(piece["piece_class"]))
    cause = LineCause(str(piece["cause"]))
    from_m = float(str(piece["from_m"]))
    to_m = float(str(piece["to_m"]))
    x = 40.0 + (from_m - begin_m) * scale
    width = max((to_m - from_m) * scale - 0.6, 0.5)
    top = 2.0 if piece["direction"] == LineDirection.GROWING.value else 28.0
    height = _LANE / 2 if kind is PieceClass.UNKNOWN else _LANE
    summary = f"{kind.value}, {cause.value}; {piece['passes']} passes, {piece['lost']} lost"
    title = f"{from_m:.0f} to {to_m:.0f} m, {piece['direction']}: {summary}"
    sign = _SIGNS.get(cause, "") if kind is PieceClass.UNSUITABLE else ""
    letter = (
        f'<text class="name" x="{x + width / 2:.1f}" y="{top + 16:.0f}" text-anchor="middle">{sign}</text>'
        if sign
        else ""
    )
    return (
        f'<g><title>{escape(title)}</title><rect class="bars tone-{_TONES[kind]}" x="{x:.1f}" '
        f'y="{top + _LANE - height:.0f}" width="{width:.1f}" height="{height:.0f}"/>{letter}</g>'
    )
