"""What a site holds, in figures for `inspect`."""

from __future__ import annotations

from collections import Counter

import numpy as np
import polars as pl

from pipeline.stages.track.network import network_of, surveyed_track
from pipeline.stages.track.survey import SurveyedTrack
from schemas.run import Finding, Site


def describe_site(site: Site) -> dict[str, object]:
    """Figures of a site by name; lengths and spacings in metres, `box_deg` south, west, north, east.

    `parts` counts connected pieces of network, `switches` ends from which more than one relation leads on.
    """
    track = surveyed_track(site)
    network = network_of(track, site.links)
    spacing = np.concatenate([np.diff(track.measure_m[part]) for _, _, part in track.elements()])
    known = track.sigma_m[np.isfinite(track.sigma_m)]
    kinds = [] if site.balises is None else site.balises["kind"].cast(str).to_list()
    branches = np.diff(network.successors.first)
    return {
        "elements": len(track.ids),
        "points": len(track.measure_m),
        "length_m": float(track.length_m.sum()),
        "longest_m": float(track.length_m.max()),
        "shortest_m": float(track.length_m.min()),
        "dimensions": _dimensions_word(track),
        "spacing_median_m": float(np.median(spacing)),
        "spacing_max_m": float(spacing.max()),
        "sigma_median_m": float(np.median(known)) if len(known) else None,
        "without_sigma": int(np.isnan(track.sigma_m).sum()),
        "relations": dict(sorted(Counter(site.links["navigability"].cast(str).to_list()).items())),
        "parts": len(np.unique(network.connected_part)),
        "switches": int((branches > 1).sum()),
        "open_ends": int((branches == 0).sum()),
        "balises": dict(sorted(Counter(kinds).items())),
        "route_elements": None if site.route is None else site.route.height,
        "box_deg": (
            float(track.latitude_deg.min()),
            float(track.longitude_deg.min()),
            float(track.latitude_deg.max()),
            float(track.longitude_deg.max()),
        ),
    }


def no_balises_finding(balises: pl.DataFrame | None) -> tuple[Finding, ...]:
    """A finding where a site has no balises, because then nothing is judged but positions."""
    if balises is not None and balises.height:
        return ()
    text = "the site has none: a replay ends with matching and monitors, and says nothing of balises"
    return (Finding("warning", "balises", text, "Add balises.csv, or make the site with --balises."),)


def elements_table(site: Site) -> pl.DataFrame:
    """Net elements with length [m], points, balises, and the elements a train can reach from either end."""
    track = surveyed_track(site)
    reached: dict[tuple[str, int], list[str]] = {}
    for a, a_end, b, b_end, navigability in site.links.iter_rows():
        if navigability != "none":
            reached.setdefault((a, a_end), []).append(b)
            reached.setdefault((b, b_end), []).append(a)
    counts = Counter([] if site.balises is None else site.balises["netelement_id"].to_list())
    rows = [
        (
            name,
            round(float(track.length_m[element]), 1),
            part.stop - part.start,
            counts[name],
            ", ".join(reached.get((name, 0), [])),
            ", ".join(reached.get((name, 1), [])),
        )
        for element, name, part in track.elements()
    ]
    columns = ("netelement_id", "length_m", "points", "balises", "before_start", "after_end")
    return pl.DataFrame(rows, schema=list(columns), orient="row")


def _dimensions_word(track: SurveyedTrack) -> str:
    """Whether a site has heights, for people."""
    flat = [bool(np.isnan(track.height_m[part]).any()) for _, _, part in track.elements()]
    if all(flat):
        return "2-D"
    return "3-D" if not any(flat) else f"mixed: {sum(flat)} of {len(flat)} elements 2-D"
