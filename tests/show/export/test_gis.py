"""GeoJSON and GPX of a run."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from pipeline.show.export import export_run
from tests.show.export.conftest import Result

GPX = "{http://www.topografix.com/GPX/1/1}"


@pytest.fixture(scope="module")
def features(result: Result, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    to = tmp_path_factory.mktemp("gis") / "run.geojson"
    assert export_run(result.out, "jump_two", to, result.site) == ([to], [])
    document = json.loads(to.read_text(encoding="utf-8"))
    assert document["type"] == "FeatureCollection"
    found: list[dict[str, Any]] = document["features"]
    return found


def of_kind(features: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
    return [one for one in features if one["properties"]["kind"] == kind]


def test_track_holds_every_epoch_once(features: list[dict[str, Any]], result: Result) -> None:
    epochs = result.tables.epochs.filter(result.tables.epochs["measure_m"].is_not_null())
    assert sum(one["properties"]["epochs"] for one in of_kind(features, "track")) == epochs.height


def test_pieces_follow_the_states(features: list[dict[str, Any]], result: Result) -> None:
    pieces = [one["properties"]["lds_state"] for one in of_kind(features, "track")]
    assert pieces == result.tables.epochs["lds_state"].rle().struct.field("value").cast(str).to_list()


def test_hazards_are_points_on_the_track(features: list[dict[str, Any]], result: Result) -> None:
    hazards = of_kind(features, "hazard")
    assert [one["properties"]["hazard"] for one in hazards] == result.tables.hazards["hazard"].to_list()
    assert hazards[0]["properties"]["balise_ids"] == ["VB03", "VB04"]
    for one in hazards:
        longitude, latitude, height = one["geometry"]["coordinates"]
        assert 14.0 < longitude < 15.0
        assert 49.5 < latitude < 50.5
        assert height > 100.0


def test_gpx_is_read_by_an_xml_parser(result: Result, tmp_path: Path) -> None:
    to = tmp_path / "run.gpx"
    export_run(result.out, "jump_two", to, result.site)
    root = ElementTree.parse(to).getroot()
    assert root is not None
    points = root.findall(f"{GPX}trk/{GPX}trkseg/{GPX}trkpt")
    matched = result.tables.epochs.filter(result.tables.epochs["measure_m"].is_not_null())
    assert len(points) == matched.height
    times = [datetime.fromisoformat(str(one.findtext(f"{GPX}time"))) for one in points]
    assert times == sorted(times)
    assert times[0] == matched["t"][0]
    hazards = root.findall(f"{GPX}wpt")
    assert [one.findtext(f"{GPX}name") for one in hazards] == ["VB_JUMP_1A 0", "VB_JUMP_1A 1"]
