"""Sites as spreadsheets and exports of other programs write them, and documents that are no network at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from polars.testing import assert_frame_equal

from pipeline.read.site.read import read_site
from schemas.errors import SiteError
from schemas.run import Site
from tests.read.site import builders

BALISES = "balise_id,netelement_id,measure_m,kind\nv1,a,10.5,virtual\nv2,c,20,physical\n"


def with_balises(folder: Path, content: bytes) -> Site:
    builders.write(folder, track=builders.geojson())
    (folder / "balises.csv").write_bytes(content)
    return read_site(folder)


@pytest.mark.parametrize(
    "content",
    [
        ("\ufeff" + BALISES.replace(",", ";").replace("\n", "\r\n")).encode(),
        BALISES.replace(",", "\t").encode("utf-16"),
        ("# made by hand\n" + BALISES.replace(",", " , ") + "\n,,,\n\n").encode(),
        b'"kind","comment","measure_m","balise_id","netelement_id"\n'
        b'"virtual","km 1, left","10.5","v1","a"\n"physical","","20","v2","c"\n',
    ],
)
def test_balise_lists_of_spreadsheets(tmp_path: Path, content: bytes) -> None:
    expected = with_balises(tmp_path / "plain", BALISES.encode()).balises
    found = with_balises(tmp_path / "other", content).balises
    assert expected is not None
    assert found is not None
    assert_frame_equal(found, expected)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            BALISES.replace(",", ";").replace("10.5", "10,5").encode(),
            "measure_m: cannot be read; found '10,5' in row 0",
        ),
        (b"", "cannot be read as CSV"),
        (BALISES.replace("kind", "measure_m").encode(), "same name|column kind: is missing"),
    ],
)
def test_balise_lists_that_cannot_be_meant(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(SiteError, match=message):
        with_balises(tmp_path, content)


def changed(**properties: Any) -> dict[str, Any]:
    """The network with other properties in its first relation."""
    document = builders.geojson()
    relation = next(f for f in document["features"] if f["properties"].get("type") == "netrelation")
    relation["properties"] = relation["properties"] | properties
    return document


ERA = {
    "netelementA": None, "positionOnA": None, "netelementB": None, "positionOnB": None,
    "elementA": "a", "isOnOriginOfElementA": False, "elementB": "b", "isOnOriginOfElementB": True,
    "navigability": "http://data.europa.eu/949/concepts/navigabilities/Both",
}  # fmt: skip


@pytest.mark.parametrize(
    "properties", [ERA, {"positionOnA": "1", "positionOnB": "0"}, {"positionOnA": 1.0, "positionOnB": 0.0}]
)
def test_relations_in_the_words_of_other_exports(tmp_path: Path, properties: dict[str, Any]) -> None:
    expected = read_site(builders.write(tmp_path / "plain", track=builders.geojson()))
    found = read_site(builders.write(tmp_path / "other", track=changed(**properties)))
    assert_frame_equal(found.links, expected.links)


@pytest.mark.parametrize(
    ("properties", "message"),
    [
        ({"netelementB": None}, "feature 4: netelementA 'a', netelementB None"),
        ({"positionOnA": 2}, "positionOnA 2"),
        ({"positionOnA": True}, "positionOnA True"),
        ({"navigability": "http://example.org/Sideways"}, "navigability 'sideways'"),
    ],
)
def test_relations_that_lack_something(tmp_path: Path, properties: dict[str, Any], message: str) -> None:
    with pytest.raises(SiteError, match=message):
        read_site(builders.write(tmp_path, track=changed(**properties)))


def feature(**changes: Any) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": [builders.geojson()["features"][0] | changes]}


@pytest.mark.parametrize(
    "crs",
    ["EPSG:4326", {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::4326"}}, None,
     {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}],
)  # fmt: skip
def test_ways_to_name_wgs_84(tmp_path: Path, crs: Any) -> None:
    assert read_site(builders.write(tmp_path, track=feature() | {"crs": crs})).track["latitude_deg"][0] == 50.0


@pytest.mark.parametrize(
    "document",
    [
        {"type": "FeatureCollection", "features": None},
        {"type": "FeatureCollection", "features": 7},
        {"type": "FeatureCollection", "features": {"a": 1}},
        {"type": "FeatureCollection", "features": ["a"]},
        {"type": "FeatureCollection"},
        [],
        feature(geometry="LINESTRING(4 50, 5 50)"),
        feature(geometry={"type": "LineString", "coordinates": 7}),
        feature(properties=["id"]),
        feature() | {"crs": {"type": "name", "properties": None}},
        feature() | {"crs": {"type": "link", "properties": {"href": "x"}}},
        feature() | {"crs": 7.5},
        feature() | {"epsg": "Lambert"},
    ],
)
def test_documents_that_are_no_network_are_one_error(tmp_path: Path, document: Any) -> None:
    (tmp_path / "track.geojson").write_text(json.dumps(document))
    with pytest.raises(SiteError, match=r"track\.geojson"):
        read_site(tmp_path)
