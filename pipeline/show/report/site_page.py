"""A site to look at: one page with the plan of its elements and balises, and tables of what is there and doubtful."""

from __future__ import annotations

from html import escape

import numpy as np
import polars as pl

from pipeline.read.site.describe import elements_table
from pipeline.results.places import element_lines_m, ground_of, origin_of, plane_m
from pipeline.show.inspection import findings_table
from pipeline.show.report.columns import frame_table
from pipeline.show.report.markup import Json, figure, pack_line, page, script_json, section, tiles
from schemas.arrays import floats
from schemas.inputs import Balises
from schemas.run import Site
from schemas.version import SOFTWARE

_BALISES = ("balise_id", "netelement_id", "measure_m", "kind", "direction", "location_accuracy_m")


def site_page(name: str, site: Site) -> str:
    """The page, in one file that opens offline."""
    elements = elements_table(site)
    findings = findings_table(site.findings)
    balises = (Balises.create_empty() if site.balises is None else site.balises).select(_BALISES)
    doubtful = (findings["severity"] != "note").sum()
    figures = [
        ("Net elements", str(elements.height), ""),
        ("Track", f"{elements['length_m'].sum() / 1000:.2f} km", ""),
        ("Balises", str(balises.height), "" if balises.height else "doubt"),
        ("To look at", str(doubtful), "doubt" if doubtful else "good"),
    ]
    hint = "Draw a box to zoom in; a double click shows all. Elements carry their ids at their middle."
    body = "\n".join(
        [
            tiles(figures),
            section("plan", "Plan", figure("site", "Net elements and balises, in metres", hint)),
            section("findings", "What is doubtful", frame_table("findings", "Findings", findings)),
            section("elements", "Net elements", frame_table("elements", "Net elements", elements)),
            section("balises", "Balises", frame_table("balises", "Balises", balises, contract=Balises)),
        ]
    )
    heading = f"<h1>Site {escape(name)}</h1>"
    # Metres east and north of the first point.
    elements_m = [pack_line(*line) for line in element_lines_m(site)]
    plan = {"origin": origin_of(site), "elements": elements_m, "balises": _balise_marks(site)}
    return page(f"Site {name}", heading, body, script_json(plan), "site.js", SOFTWARE)


def _balise_marks(site: Site) -> list[Json]:
    """Balises with their places in the plan."""
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
