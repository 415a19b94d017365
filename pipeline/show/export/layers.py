"""Epochs, passages and hazards of a run as points with all their columns: GeoPackage and GeoParquet 1.1."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl

from pipeline.results.places import ground_of
from pipeline.storage.described import PREFIX
from pipeline.storage.parquet import parquet_bytes
from schemas.conform import meanings
from schemas.errors import UsageError
from schemas.run import RunTables, Site
from schemas.tables import CONTRACT_VERSION, TABLES

LAYERS = ("epochs", "passages", "hazards")
_GEOMETRY = {"geometry": {"unit": "deg", "meaning": "place on the rails, WGS 84, longitude first (WKB)"}}
_WKB_POINT = np.dtype([("little_endian", "u1"), ("kind", "<u4"), ("longitude", "<f8"), ("latitude", "<f8")])
# GeoPackage notes when it was written: with the date of this standard the same content gives the same bytes.
_WRITTEN = "2014-02-10T00:00:00Z"


def layers_of(tables: RunTables, site: Site) -> dict[str, pl.DataFrame]:
    """Tables with `run_id` in front and the place on the rails as `geometry`, null where it is not known."""
    return {name: _with_geometry(getattr(tables, name), tables.run_id, site) for name in LAYERS}


def _with_geometry(frame: pl.DataFrame, run_id: str, site: Site) -> pl.DataFrame:
    """A table with the point of each row, as well-known binary."""
    measure_m = frame["measure_m"].fill_null(float("nan")).to_numpy()
    ground = ground_of(site.track, frame["netelement_id"], measure_m)
    points = np.zeros(frame.height, _WKB_POINT)
    points["little_endian"] = 1
    points["kind"] = 1
    points["longitude"] = ground.longitude_deg
    points["latitude"] = ground.latitude_deg
    known = np.isfinite(ground.longitude_deg) & np.isfinite(ground.latitude_deg)
    wkb = [point.tobytes() if has_place else None for point, has_place in zip(points, known, strict=True)]
    return frame.select(pl.lit(run_id).alias("run_id"), pl.all(), pl.Series("geometry", wkb, pl.Binary))


def geoparquet_bytes(layer: pl.DataFrame, table: str, run_id: str) -> bytes:
    """One layer as GeoParquet, with the types of the contract, unit and meaning in each field."""
    column = {"encoding": "WKB", "geometry_types": ["Point"]}
    geo = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": column}}
    notes = {"table": table, "run_id": run_id, "contract": CONTRACT_VERSION}
    metadata = {"geo": json.dumps(geo), **{f"{PREFIX}{key}": value for key, value in notes.items()}}
    return parquet_bytes(layer, metadata, {**meanings(TABLES[table]), **_GEOMETRY})


def geopackage_bytes(layers: Mapping[str, pl.DataFrame], place: Path) -> bytes:
    """All layers in one GeoPackage: lists as words with blanks between them, times to the millisecond.

    Raises `UsageError` where pyogrio is not installed.
    """
    try:
        import pyogrio
        from pyogrio.raw import write_arrow
    except ImportError:
        remedy = "Install the extra `maps` (`pip install balise[maps]`), or take .parquet or .geojson."
        raise UsageError("cannot be written without the package pyogrio", place=str(place), remedy=remedy) from None
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _WRITTEN})
    try:
        with TemporaryDirectory() as folder:
            file = Path(folder, "layers.gpkg")
            for number, (name, layer) in enumerate(layers.items()):
                shape = {"geometry_name": "geometry", "geometry_type": "Point", "crs": "OGC:CRS84"}
                write_arrow(
                    _with_plain_types(layer).to_arrow(), file, layer=name, driver="GPKG", append=number > 0, **shape
                )
            return file.read_bytes()
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": None})


def _with_plain_types(layer: pl.DataFrame) -> pl.DataFrame:
    """The table with the types that a GeoPackage has."""
    lists = [name for name, kind in layer.schema.items() if isinstance(kind, pl.List)]
    enums = [name for name, kind in layer.schema.items() if isinstance(kind, pl.Enum)]
    times = [name for name, kind in layer.schema.items() if isinstance(kind, pl.Datetime)]
    return layer.with_columns(
        *(pl.col(name).cast(pl.List(pl.String)).list.join(" ") for name in lists),
        pl.col(enums).cast(pl.String),
        pl.col(times).dt.cast_time_unit("ms"),
    )
