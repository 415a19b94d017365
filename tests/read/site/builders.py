"""Small sites as files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import polars as pl

from pipeline.storage.parquet import parquet_bytes

# Three elements east of each other at 50 N, about 100 m each, and one that branches off the first.
POINTS = {
    "a": [(4.0000, 50.0), (4.0007, 50.0), (4.0014, 50.0)],
    "b": [(4.0014, 50.0), (4.0028, 50.0)],
    "c": [(4.0028, 50.0), (4.0042, 50.0)],
    "d": [(4.0014, 50.0), (4.0028, 50.0001)],
}
LINKS = [("a", 1, "b", 0, "both"), ("b", 1, "c", 0, "both"), ("a", 1, "d", 0, "AB"), ("b", 0, "d", 0, "none")]


def track(height: float | None = None) -> pl.DataFrame:
    rows = [
        {"netelement_id": name, "measure_m": None, "latitude_deg": y, "longitude_deg": x, "height_m": height}
        for name, points in POINTS.items()
        for x, y in points
    ]
    kinds = {"measure_m": pl.Float64, "height_m": pl.Float64, "sigma_m": pl.Float64}
    return pl.DataFrame(rows).with_columns(pl.lit(None).alias("sigma_m")).cast(kinds)


def links() -> pl.DataFrame:
    columns = ["netelement_a", "position_a", "netelement_b", "position_b", "navigability"]
    return pl.DataFrame(LINKS, schema=columns, orient="row")


def balises(**changes: list[Any]) -> pl.DataFrame:
    columns: dict[str, list[Any]] = {
        "balise_id": ["v1", "v2"],
        "netelement_id": ["a", "c"],
        "measure_m": [10.0, 20.0],
        "kind": ["virtual", "physical"],
    }
    return pl.DataFrame(columns | changes)


def geojson() -> dict[str, Any]:
    features: list[dict[str, Any]] = [
        {
            "type": "Feature",
            "properties": {"id": name},
            "geometry": {"type": "LineString", "coordinates": [list(point) for point in points]},
        }
        for name, points in POINTS.items()
    ]
    for a, position_a, b, position_b, navigability in LINKS:
        properties = {
            "id": f"{a}-{b}",
            "type": "netrelation",
            "netelementA": a,
            "positionOnA": position_a,
            "netelementB": b,
            "positionOnB": position_b,
            "navigability": navigability,
        }
        point = {"type": "Point", "coordinates": [4.0, 50.0, 12.0]}
        features.append({"type": "Feature", "properties": properties, "geometry": point})
    return {"type": "FeatureCollection", "features": features}


def write(folder: Path, **tables: pl.DataFrame | dict[str, Any] | str) -> Path:
    """Tables as Parquet, dictionaries as GeoJSON, text as CSV; names are those of the files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in tables.items():
        if isinstance(content, pl.DataFrame):
            (folder / f"{name}.parquet").write_bytes(parquet_bytes(content))
        elif isinstance(content, dict):
            (folder / f"{name}.geojson").write_text(json.dumps(content))
        else:
            (folder / f"{name}.csv").write_text(content)
    return folder
