"""The files of `balise line`: the page with classes and causes along each net element, tables, GeoJSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np
import polars as pl

from pipeline.results.places import ground_of
from pipeline.show.line_strips import SIGNS, strips
from pipeline.show.report.columns import frame_table
from pipeline.show.report.markup import page, pairs, script_json, section, tiles
from pipeline.storage import write_bytes
from pipeline.studies.line import LineResult, site_balises
from schemas.arrays import Floats, floats
from schemas.config import to_toml
from schemas.line import LineBalises, LineDirection, LinePieces, LineProposals, PieceClass
from schemas.version import SOFTWARE

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
    features = _piece_features(result) + _balise_features(result)
    return json.dumps({"type": "FeatureCollection", "features": features}, separators=(",", ":"), allow_nan=False)


def _piece_features(result: LineResult) -> list[dict[str, object]]:
    """A line of six points for each row of pieces; one piece has a row per direction."""
    pieces = result.line.pieces
    shares = np.linspace(0.0, 1.0, 6)
    measures = pieces.from_m[:, None] + (pieces.to_m - pieces.from_m)[:, None] * shares
    elements = pl.Series(np.repeat(pieces.element_names, shares.size), dtype=pl.String)
    lines = _coordinates(result, elements, measures.ravel()).reshape(-1, shares.size, 2).tolist()
    rows = result.pieces.iter_rows(named=True)
    return [_feature("LineString", lines[row["piece"]], {"kind": "piece", **row}) for row in rows]


def _balise_features(result: LineResult) -> list[dict[str, object]]:
    """The balises of proposals, as points of a map."""
    balises = result.balises
    points = _coordinates(result, balises["netelement_id"], floats(balises, "measure_m")).tolist()
    return [
        _feature("Point", point, {**row, "kind": "balise", "kind_of_balise": row["kind"]})
        for point, row in zip(points, balises.iter_rows(named=True), strict=True)
    ]


def _coordinates(result: LineResult, elements: pl.Series, measures_m: Floats) -> Floats:
    """Longitude and latitude of places on the track, to about a millimetre [deg]; shape (places, 2)."""
    ground = ground_of(result.line.site.track, elements, measures_m)
    return np.column_stack([ground.longitude_deg, ground.latitude_deg]).round(8)


def _feature(kind: str, coordinates: list[object], properties: dict[str, object]) -> dict[str, object]:
    """A GeoJSON feature."""
    return {"type": "Feature", "geometry": {"type": kind, "coordinates": coordinates}, "properties": properties}


def line_page(result: LineResult) -> str:
    """One offline page."""
    pieces = result.pieces
    balises = result.balises
    criteria = result.line.criteria
    passed = _passed_pieces(pieces)
    body = "\n".join(
        [
            _length_tiles(pieces),
            section("limits", "What these runs cannot say", _html_list(result.remarks)),
            section("line", "The line", _strip_legend(), *_strips(result, passed)),
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


def _length_tiles(pieces: pl.DataFrame) -> str:
    """Tiles with the lengths of suitable, unsuitable and unknown track."""
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
            rows.append(
                (f"{kind.value}, {side.value} measure", f"{length_m / 1000.0:.2f} km", tone if length_m else "")
            )
    return tiles(rows)


def _passed_pieces(pieces: pl.DataFrame) -> pl.DataFrame:
    """Pieces that some run says something of, what is bad first."""
    spoken = pl.sum_horizontal("passes", "unknown", "after_alarm", "claimed_wrongly") > 0
    order = pl.col("piece_class").cast(pl.String).replace_strict({"unsuitable": 0, "unknown": 1, "suitable": 2})
    return pieces.filter(spoken).sort(order, "piece", "direction", maintain_order=True)


def _html_list(texts: Sequence[str]) -> str:
    """Sentences as a list of HTML."""
    return f'<ul class="notice">{"".join(f"<li>{escape(text)}</li>" for text in texts)}</ul>'


def _strip_legend() -> str:
    """What the signs of the strips mean, for people."""
    words = ", ".join(f"{sign} {cause.value.replace('_', ' ')}" for cause, sign in SIGNS.items())
    return (
        '<p class="keys">Kilometres count from the begin of each line. Upper lane: travel with them, lower: against '
        "them. Full height suitable, half height unknown, full height with a letter unsuitable: "
        f"{escape(words)}. Balises of the first proposal below: | virtual, ‖ physical.</p>"
    )


def _strips(result: LineResult, passed: pl.DataFrame) -> list[str]:
    """Strips of all net elements that were passed, with the balises of the first proposal."""
    if passed.is_empty():
        return ['<p class="none">Nothing is drawn: no run says anything of any piece.</p>']
    pieces = result.pieces.filter(pl.col("netelement_id").is_in(passed["netelement_id"].unique().implode()))
    balises = result.balises
    first = balises.filter(pl.col("proposal") == balises["proposal"][0]) if balises.height else balises
    return strips(pieces, result.line.site.links, first)
