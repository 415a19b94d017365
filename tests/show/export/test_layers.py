"""GeoPackage and GeoParquet of a run: every row, its place on the rails, and a file that says what it is."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import polars as pl
import pyarrow.parquet as pq
import pytest

from pipeline.show.export import export_run
from schemas.errors import UsageError
from tests.show.export.conftest import Result


def test_geoparquet_holds_the_tables_and_their_places(result: Result, tmp_path: Path) -> None:
    to = tmp_path / "run.parquet"
    files, missing = export_run(result.out, "jump_two", to, result.site)
    assert ([file.name for file in files], missing) == (
        ["run.parquet", "run.passages.parquet", "run.hazards.parquet"],
        [],
    )
    for file, table in zip(files, ("epochs", "passages", "hazards"), strict=True):
        found = pl.read_parquet(file)
        assert found.drop("run_id", "geometry").equals(getattr(result.tables, table))
        metadata = pq.read_schema(file).metadata
        assert (metadata[b"balise.run_id"], metadata[b"balise.table"]) == (b"jump_two", table.encode())
        geo = json.loads(metadata[b"geo"])
        assert geo["columns"][geo["primary_column"]] == {"encoding": "WKB", "geometry_types": ["Point"]}
    assert pq.read_schema(to).field("confidence_m").metadata[b"unit"] == b"m"


def test_a_place_is_that_of_the_survey(result: Result, tmp_path: Path) -> None:
    """The epoch nearest to a survey point lies within the distance that their measures say (1 degree > 71 km here)."""
    export_run(result.out, "jump_two", tmp_path / "run.parquet", result.site)
    epochs = pl.read_parquet(tmp_path / "run.parquet").drop_nulls("measure_m")
    row = epochs.row(epochs.height // 2, named=True)
    track = result.site.track.filter(pl.col("netelement_id") == row["netelement_id"])
    near = track.sort((pl.col("measure_m") - row["measure_m"]).abs()).row(0, named=True)
    order, kind, longitude, latitude = struct.unpack("<BIdd", row["geometry"])
    assert (order, kind) == (1, 1)
    north_m = (latitude - near["latitude_deg"]) * 111_200
    east_m = (longitude - near["longitude_deg"]) * 71_500
    assert (north_m**2 + east_m**2) ** 0.5 == pytest.approx(abs(row["measure_m"] - near["measure_m"]), abs=0.1)


def test_an_epoch_without_a_place_keeps_its_row(result: Result, tmp_path: Path) -> None:
    export_run(result.out, "jump_two", tmp_path / "run.parquet", result.site)
    epochs = pl.read_parquet(tmp_path / "run.parquet")
    assert epochs["geometry"].is_null().equals(epochs["measure_m"].is_null())


def test_geopackage_is_read_back(result: Result, tmp_path: Path) -> None:
    pyogrio = pytest.importorskip("pyogrio", reason="pyogrio is not installed")
    to = tmp_path / "run.gpkg"
    assert export_run(result.out, "jump_two", to, result.site) == ([to], [])
    assert [str(layer) for layer, _ in pyogrio.list_layers(to)] == ["epochs", "passages", "hazards"]
    info = pyogrio.read_info(to, layer="hazards")
    assert (info["features"], info["geometry_type"]) == (result.tables.hazards.height, "Point")
    _, table = pyogrio.raw.read_arrow(to, layer="hazards")
    assert table["hazard"].to_pylist() == result.tables.hazards["hazard"].cast(pl.String).to_list()
    assert table["balise_ids"].to_pylist() == [" ".join(row) for row in result.tables.hazards["balise_ids"]]
    export_run(result.out, "jump_two", tmp_path / "again.gpkg", result.site)
    assert (tmp_path / "again.gpkg").read_bytes() == to.read_bytes()


@pytest.mark.parametrize("suffix", ["gpkg", "parquet"])
def test_places_need_the_site(result: Result, tmp_path: Path, suffix: str) -> None:
    with pytest.raises(UsageError, match="need the site"):
        export_run(result.out, "jump_two", tmp_path / f"run.{suffix}")
