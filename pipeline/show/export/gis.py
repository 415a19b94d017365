"""Results and sites as GeoJSON (RFC 7946) and GPX 1.1."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import polars as pl

from pipeline.results.places import GroundPositions, ground_of
from pipeline.show.export.events import hazard_text
from pipeline.show.export.positions import positions_of
from schemas.arrays import Floats
from schemas.run import RunTables, Site

Feature = dict[str, Any]

# Of the drawing alone: over a longer pause no line is drawn. By `lds.crossing_gap_s` a log at 0.5 Hz would be single
# points.
_GAP_S = 10.0
_DIGITS = 8


def run_geojson(tables: RunTables, site: Site) -> str:
    """Matched track as one line per stretch of one state of the LDS; hazards and passages as points."""
    features: list[Feature] = []
    for solution in tables.epochs["solution"].unique(maintain_order=True):
        features += _track_features(solution, tables.epochs.filter(pl.col("solution") == solution), site)
    features += [_point("hazard", row, ground) for row, ground in _rows_with_place(tables.hazards, site)]
    features += [_point("passage", row, ground) for row, ground in _rows_with_place(tables.passages, site)]
    return _feature_collection(features)


def run_gpx(tables: RunTables, site: Site) -> str:
    """Matched track of each solution with its times, a segment per stretch without a gap; hazards as waypoints."""
    waypoints = [
        f"<wpt {_lat_lon(*ground[:2])}><time>{_utc(row['t_hazard'])}</time>"
        f"<name>{escape(str(row['hazard']))} {row['hazard_id']}</name><desc>{escape(hazard_text(row))}</desc></wpt>"
        for row, ground in _rows_with_place(tables.hazards, site)
    ]
    tracks = []
    for solution in tables.epochs["solution"].unique(maintain_order=True):
        matched = positions_of(tables.epochs.filter(pl.col("solution") == solution), site).matched
        segments = "".join(f"<trkseg>\n{''.join(_gpx_points(part))}</trkseg>\n" for part in _split_at_gaps(matched))
        tracks.append(f"<trk><name>{escape(solution)}</name>\n{segments}</trk>")
    head = '<gpx version="1.1" creator="balise" xmlns="http://www.topografix.com/GPX/1/1">'
    name = f"<metadata><name>{escape(tables.run_id)}</name></metadata>"
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', head, name, *waypoints, *tracks, "</gpx>", ""])


def track_geojson(site: Site) -> str:
    """Net elements as lines."""
    features = []
    for (name,), points in site.track.group_by("netelement_id", maintain_order=True):
        line = [_geojson_place(*row) for row in points.select("latitude_deg", "longitude_deg", "height_m").iter_rows()]
        features.append(_feature("LineString", line, {"kind": "netelement", "netelement_id": str(name)}))
    return _feature_collection(features)


def balises_geojson(site: Site) -> str:
    """Balises as points; nothing where the site has none."""
    if site.balises is None:
        return _feature_collection([])
    return _feature_collection([_point("balise", row, ground) for row, ground in _rows_with_place(site.balises, site)])


def _track_features(solution: str, epochs: pl.DataFrame, site: Site) -> Iterator[Feature]:
    """The matched positions of a solution, as lines."""
    states = epochs.select("t", state=pl.col("lds_state").cast(pl.String))
    matched = positions_of(epochs, site).matched.join(states, on="t", how="left", maintain_order="left")
    for part in _split_at_gaps(matched):
        ends = part.with_columns(pl.col("state").rle_id().alias("piece"))
        for _, piece in ends.group_by("piece", maintain_order=True):
            line = [
                _geojson_place(*row) for row in piece.select("latitude_deg", "longitude_deg", "height_m").iter_rows()
            ]
            properties = {
                "kind": "track",
                "solution": solution,
                "lds_state": piece["state"][0],
                "t_start": _utc(piece["t"][0]),
                "t_end": _utc(piece["t"][-1]),
                "epochs": piece.height,
            }
            # A line needs two places; a state of one epoch is a point.
            yield _feature("LineString", line, properties) if len(line) > 1 else _feature("Point", line[0], properties)


def _split_at_gaps(matched: pl.DataFrame) -> Iterator[pl.DataFrame]:
    """Positions without a gap in time."""
    gaps = (pl.col("t").diff() > pl.duration(milliseconds=int(_GAP_S * 1000))).fill_null(value=False).cum_sum()
    for _, part in matched.with_columns(stretch=gaps).group_by("stretch", maintain_order=True):
        yield part


def _rows_with_place(frame: pl.DataFrame, site: Site) -> Iterator[tuple[dict[str, Any], tuple[float, float, float]]]:
    """Rows with a place on the track, and the place."""
    measure: Floats = frame["measure_m"].fill_null(float("nan")).to_numpy()
    ground: GroundPositions = ground_of(site.track, frame["netelement_id"], measure)
    columns = (ground.latitude_deg, ground.longitude_deg, ground.height_m)
    for number, row in enumerate(frame.iter_rows(named=True)):
        latitude, longitude, height = (float(column[number]) for column in columns)
        if latitude == latitude:
            yield row, (latitude, longitude, height)


def _point(kind: str, row: Mapping[str, Any], ground: tuple[float, float, float]) -> Feature:
    """A point of the map, with its properties."""
    plain = {name: _utc(value) if isinstance(value, datetime) else value for name, value in row.items()}
    named = {"kind_of_balise" if name == "kind" else name: value for name, value in plain.items()}
    return _feature("Point", _geojson_place(*ground), {"kind": kind, **named})


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> Feature:
    """A GeoJSON feature."""
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _feature_collection(features: list[Feature]) -> str:
    """Features in one GeoJSON document."""
    document = {"type": "FeatureCollection", "features": features}
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def _geojson_place(latitude: float, longitude: float, height: float | None) -> list[float]:
    """GeoJSON's order: longitude, latitude, height where it is known."""
    place = [round(longitude, _DIGITS), round(latitude, _DIGITS)]
    return place if height is None or height != height else [*place, round(height, 3)]


def _gpx_points(part: pl.DataFrame) -> Iterator[str]:
    """Points of a GPX track."""
    for t, latitude, longitude, height in part.select("t", "latitude_deg", "longitude_deg", "height_m").iter_rows():
        elevation = "" if height is None else f"<ele>{height:.3f}</ele>"
        yield f"<trkpt {_lat_lon(latitude, longitude)}>{elevation}<time>{_utc(t)}</time></trkpt>\n"


def _lat_lon(latitude: float, longitude: float) -> str:
    """Latitude and longitude as attributes of GPX."""
    return f"lat={quoteattr(f'{latitude:.{_DIGITS}f}')} lon={quoteattr(f'{longitude:.{_DIGITS}f}')}"


def _utc(t: datetime) -> str:
    """A time in ISO 8601, in UTC."""
    return t.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
