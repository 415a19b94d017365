"""Lines of GeoPackage and Shapefile: written by GDAL in Belgian coordinates, read as a survey."""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pyproj
import pytest

from pipeline.make.survey.map_files import lines_of_wkb
from pipeline.make.survey.sources import read_surveys
from schemas.config import Configuration, Vehicle
from schemas.errors import SiteError

# Two points of a line near Brussels: longitude, latitude.
DEGREES = np.array([[4.48, 50.90], [4.49, 50.91]])


def line_wkb(points: np.ndarray) -> bytes:
    return struct.pack("<BII", 1, 2, len(points)) + np.asarray(points, dtype="<f8").tobytes()


def write(path: Path, shapes: list[bytes], **options: str) -> Path:
    names = np.array([f"way{number}" for number in range(len(shapes))], dtype=object)
    kinds = np.array(["rail", "abandoned", "rail"][: len(shapes)], dtype=object)
    fields = {"field_data": [names, kinds], "fields": ["name", "railway"], **options}
    import pyogrio.raw  # with pandas: takes long to load, in each of the test processes

    pyogrio.raw.write(path, np.array(shapes, dtype=object), **fields, geometry_type="LineString", crs="EPSG:31370")
    return path


def belgian() -> np.ndarray:
    plane = pyproj.Transformer.from_crs(4326, 31370, always_xy=True)
    return np.column_stack(plane.transform(DEGREES[:, 0], DEGREES[:, 1]))


@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".fgb"])
def test_lines_of_a_map_in_national_coordinates(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"line{suffix}", [line_wkb(belgian()), line_wkb(belgian() + 500.0)])
    survey = read_surveys([path], None, Vehicle(), Configuration())
    (piece,) = survey.pieces
    assert piece.name == "way0"
    assert piece.latitude_deg == pytest.approx(DEGREES[:, 1], abs=1e-7)
    assert piece.longitude_deg == pytest.approx(DEGREES[:, 0], abs=1e-7)
    assert [finding.message for finding in survey.findings] == [
        "1 lines with railway=abandoned are left out: no train runs there"
    ]


def test_a_map_without_coordinate_system_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "line.shp", [line_wkb(belgian())])
    path.with_suffix(".prj").unlink()
    with pytest.raises(SiteError, match="no coordinate system"):
        read_surveys([path], None, Vehicle(), Configuration())


@pytest.mark.parametrize("content", [b"", b"<OGRVRTDataSource/>", b"SQLite format 3\0 and no more", b"fgb"])
@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".fgb"])
def test_what_only_has_the_suffix_is_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"line{suffix}"
    path.write_bytes(content)
    with pytest.raises(SiteError):
        read_surveys([path], None, Vehicle(), Configuration())


@pytest.mark.parametrize("suffix", [".gpkg", ".fgb"])
def test_a_damaged_map_is_one_error_or_a_survey(tmp_path: Path, suffix: str) -> None:
    whole = write(tmp_path / f"whole{suffix}", [line_wkb(belgian())]).read_bytes()
    draw = np.random.default_rng(5)
    damaged = tmp_path / f"damaged{suffix}"
    for _ in range(40):
        content = bytearray(whole[: draw.integers(20, len(whole))])
        content[draw.integers(16, len(content))] = draw.integers(256)
        damaged.write_bytes(content)
        try:
            read_surveys([damaged], None, Vehicle(), Configuration())
        except SiteError:
            continue


def test_heights_and_many_lines_of_well_known_binary() -> None:
    high = struct.pack("<BII", 1, 1002, 2) + np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]).tobytes()
    (line,) = lines_of_wkb(high)
    assert line.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    flat = line_wkb(DEGREES)
    both = lines_of_wkb(struct.pack("<BII", 1, 5, 2) + flat + flat)
    assert [part.tolist() for part in both] == [DEGREES.tolist(), DEGREES.tolist()]
    assert lines_of_wkb(struct.pack("<BI", 1, 1) + np.array([4.0, 50.0]).tobytes())[0].tolist() == [[4.0, 50.0]]
    assert lines_of_wkb(struct.pack("<BII", 1, 3, 0)) == []


def test_layers_that_a_map_only_declares_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "line.gpkg", [line_wkb(belgian())])
    with closing(sqlite3.connect(path)) as database:
        database.execute("ALTER TABLE line RENAME TO kept")
        database.execute("CREATE VIEW line AS SELECT kept.* FROM kept, kept AS again")
        database.commit()
    with pytest.raises(SiteError, match="its layer line is a view; expected a table"):
        read_surveys([path], None, Vehicle(), Configuration())
    flat = write(tmp_path / "line.fgb", [line_wkb(belgian())], SPATIAL_INDEX="NO")
    content = bytearray(flat.read_bytes())
    content[72:80] = (0x7000_0000).to_bytes(8, "little")  # the header's count of features, 1 before
    flat.write_bytes(content)
    with pytest.raises(SiteError, match="it declares more features than it has bytes"):
        read_surveys([flat], None, Vehicle(), Configuration())


@pytest.mark.parametrize("suffix", [".gpkg", ".shp"])
def test_an_attribute_names_the_lines(tmp_path: Path, suffix: str) -> None:
    path = write(tmp_path / f"line{suffix}", [line_wkb(belgian())])
    (piece,) = read_surveys([path], None, Vehicle(), Configuration(), "railway").pieces
    assert piece.name == "rail"
    with pytest.raises(SiteError, match=r"no such attribute.*name, railway"):
        read_surveys([path], None, Vehicle(), Configuration(), "track_id")
