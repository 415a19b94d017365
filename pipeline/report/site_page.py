"""A site to look at: one page with the plan of its elements and balises, and tables of what is there and doubtful."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
import polars as pl

from pipeline.export.places import element_lines_m, ground_of, origin_of, plane_m
from pipeline.report.markup import Json, cell, figure, packed_line, page, script_json, section, table, tiles
from pipeline.site.describe import elements_table
from schemas.arrays import floats
from schemas.run import Site
from schemas.version import SOFTWARE


def site_page(name: str, site: Site) -> str:
    """The page, in one file that opens offline."""
    elements = elements_table(site)
    findings = [(one.severity, one.place, one.message, one.remedy) for one in site.findings]
    doubtful = sum(severity != "note" for severity, *_ in findings)
    km = f"{elements['length_m'].sum() / 1000:.2f} km"
    columns = ("balise_id", "netelement_id", "measure_m", "kind", "location_accuracy_m")
    rows = [] if site.balises is None else site.balises.select(columns).rows()
    balises = len(rows)
    figures = [
        ("Net elements", str(elements.height), ""),
        ("Track", km, ""),
        ("Balises", str(balises), "" if balises else "doubt"),
        ("To look at", str(doubtful), "doubt" if doubtful else "good"),
    ]
    told = "Draw a box to zoom in; a double click shows all. Elements carry their ids at their middle."
    body = "\n".join(
        [
            tiles(figures),
            section("plan", "Plan", figure("site", "Net elements and balises, in metres", told)),
            section("findings", "What is doubtful", _rows("findings", "Findings", _FINDING_HEADS, findings)),
            section("elements", "Net elements", _rows("elements", "Net elements", _ELEMENT_HEADS, elements.rows())),
            section("balises", "Balises", _rows("balises", "Balises", _BALISE_HEADS, rows)),
        ]
    )
    heading = f"<h1>Site {escape(name)}</h1>"
    # Metres east and north of the first point.
    plan = {"elements": [packed_line(*line) for line in element_lines_m(site)], "balises": _marks(site)}
    return page(f"Site {name}", heading, body, script_json(plan), "site.js", SOFTWARE)


_FINDING_HEADS = [(name, "") for name in ("severity", "place", "what", "what to do")]
_ELEMENT_HEADS = [
    ("net element", "its id"),
    ("length [m]", ""),
    ("points", ""),
    ("balises", ""),
    ("before its start", "elements that a train can reach from there"),
    ("after its end", "elements that a train can reach from there"),
]
_BALISE_HEADS = [(name, "") for name in ("balise", "net element", "measure [m]", "kind", "accuracy [m]")]


def _rows(identity: str, caption: str, heads: list[tuple[str, str]], rows: Sequence[tuple[object, ...]]) -> str:
    return table(identity, caption, heads, [[cell(value, 6) for value in row] for row in rows])


def _marks(site: Site) -> list[Json]:
    if site.balises is None:
        return []
    on_track = site.balises.filter(pl.col("netelement_id").is_in(site.track["netelement_id"].unique().to_list()))
    ground = ground_of(site.track, on_track["netelement_id"], floats(on_track, "measure_m"))
    x, y = plane_m(ground, origin_of(site))
    return [
        {
            "id": row["balise_id"],
            "kind": row["kind"],
            "x": round(float(east), 2),
            "y": round(float(north), 2),
            "place": f"{row['netelement_id']} at {row['measure_m']:.1f} m",
        }
        for row, east, north in zip(on_track.iter_rows(named=True), x, y, strict=True)
        if np.isfinite(east)
    ]
