"""Exported MCAP read back with readers that are not ours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from pipeline.show.export import export_run
from schemas.errors import UsageError
from schemas.monitors import MONITORS
from tests.show.export.conftest import Result


def decoded(path: Path) -> dict[str, list[tuple[int, Any]]]:
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as stream:
        for _, channel, message, content in make_reader(
            stream, validate_crcs=True, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


@pytest.fixture(scope="module")
def exported(result: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    to = tmp_path_factory.mktemp("mcap") / "run.mcap"
    files, missing = export_run(result.out, "jump_two", to, result.site, result.log)
    assert files == [to, to.with_name("run.layout.json")]
    assert missing == []
    return to


@pytest.fixture(scope="module")
def content(exported: Path) -> dict[str, list[tuple[int, Any]]]:
    return decoded(exported)


def test_every_topic_is_there(content: dict[str, list[tuple[int, Any]]], result: Result) -> None:
    own = ("raw", "gnss", "matched", "truth", "lds", "monitors", "hazards", "passages")
    assert set(content) == {"/site/track", "/site/balises", *(f"/primary/{name}" for name in own)}
    assert len(content["/primary/raw"]) == result.log.gnss.height
    assert len(content["/primary/lds"]) == result.tables.epochs.height


def test_raw_positions_are_those_of_the_log(content: dict[str, list[tuple[int, Any]]], result: Result) -> None:
    for (t_ns, message), row in zip(content["/primary/raw"], result.log.gnss.iter_rows(named=True), strict=True):
        assert message.latitude == row["latitude_deg"]
        assert message.longitude == row["longitude_deg"]
        assert message.timestamp.ToNanoseconds() == t_ns


def test_monitors_keep_values_and_what_is_not_known(content: dict[str, list[tuple[int, Any]]], result: Result) -> None:
    times = result.tables.epochs["t"].to_physical().to_list()
    for (t_ns, message), expected, row in zip(
        content["/primary/monitors"], times, result.tables.epochs.iter_rows(named=True), strict=True
    ):
        assert t_ns == expected
        for monitor in MONITORS:
            assert getattr(message, f"{monitor}_state") == row[f"{monitor}_state"]
            known = message.HasField(f"{monitor}_value")
            assert known == (row[f"{monitor}_value"] is not None)
            if known:
                assert getattr(message, f"{monitor}_value") == row[f"{monitor}_value"]


def test_lds_states(content: dict[str, list[tuple[int, Any]]], result: Result) -> None:
    states = [message.lds_state if message.HasField("lds_state") else None for _, message in content["/primary/lds"]]
    assert states == result.tables.epochs["lds_state"].cast(pl.String).to_list()


def test_hazards_are_log_entries_of_level_error(content: dict[str, list[tuple[int, Any]]], result: Result) -> None:
    entries = content["/primary/hazards"]
    hazards = result.tables.hazards
    named = [(t_ns, one) for t_ns, one in entries if one.message.startswith("VB_")]
    assert [t_ns for t_ns, _ in named] == hazards["t_hazard"].to_physical().to_list()
    assert all(one.level == 4 for _, one in named)
    assert "VB03, VB04" in named[0][1].message
    detected = [t_ns for t_ns, one in entries if one.message.startswith("detected by")]
    assert detected == sorted(hazards["t_detected"].drop_nulls().to_physical().to_list())


def test_site_is_geojson(content: dict[str, list[tuple[int, Any]]], result: Result) -> None:
    track = json.loads(content["/site/track"][0][1].geojson)
    assert sum(len(one["geometry"]["coordinates"]) for one in track["features"]) == result.site.track.height
    balises = json.loads(content["/site/balises"][0][1].geojson)
    assert result.site.balises is not None
    names = [one["properties"]["balise_id"] for one in balises["features"]]
    assert names == result.site.balises["balise_id"].to_list()


def test_messages_are_in_order_and_bytes_repeat(result: Result, exported: Path, tmp_path: Path) -> None:
    with exported.open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    export_run(result.out, "jump_two", tmp_path / "again.mcap", result.site, result.log)
    assert (tmp_path / "again.mcap").read_bytes() == exported.read_bytes()


@pytest.fixture(scope="module")
def bag(result: Result, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    from rosbags.highlevel import AnyReader

    to = tmp_path_factory.mktemp("ros") / "ros.mcap"
    export_run(result.out, "jump_two", to, result.site, result.log, positions="ros")
    found: dict[str, list[Any]] = {}
    with AnyReader([to]) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(data, connection.msgtype))
    return found


def test_positions_are_read_by_rosbags(bag: dict[str, list[Any]], result: Result) -> None:
    fixes = bag["/primary/raw"]
    assert {fix.__msgtype__ for fix in fixes} == {"sensor_msgs/msg/NavSatFix"}
    assert [fix.latitude for fix in fixes] == result.log.gnss["latitude_deg"].to_list()
    assert [fix.altitude for fix in fixes] == result.log.gnss["height_m"].to_list()


def test_results_are_read_by_rosbags(
    bag: dict[str, list[Any]], content: dict[str, list[tuple[int, Any]]], result: Result
) -> None:
    assert set(bag) == set(content)
    values = [message.along_raw_value for message in bag["/primary/monitors"]]
    expected = result.tables.epochs["along_raw_value"].fill_null(float("nan")).to_numpy()
    np.testing.assert_array_equal(values, expected)
    states = result.tables.epochs["pseudorange_state"].to_list()
    assert [message.pseudorange_state for message in bag["/primary/monitors"]] == states
    assert [message.tvb for message in bag["/primary/lds"]] == result.tables.epochs["tvb"].to_list()
    texts = [message.message for message in bag["/primary/hazards"]]
    assert texts == [message.message for _, message in content["/primary/hazards"]]
    assert bag["/site/track"][0].geojson == content["/site/track"][0][1].geojson


def test_layout_names_topics_that_exist(exported: Path, content: dict[str, list[tuple[int, Any]]]) -> None:
    layout = json.loads(exported.with_name("run.layout.json").read_text())
    named: list[str] = [path["value"] for panel in layout["configById"].values() for path in panel.get("paths", [])]
    paths = [value for value in named if value.startswith("/")]
    assert len(paths) > 20
    for value in paths:
        topic, _, field = value.partition(".")
        assert field in content[topic][0][1].DESCRIPTOR.fields_by_name, value
    assert _leaves(layout["layout"]) == set(layout["configById"])


def _leaves(node: Any) -> set[str]:
    return {node} if isinstance(node, str) else _leaves(node["first"]) | _leaves(node["second"])


def test_without_site_and_log_the_file_says_what_it_lacks(result: Result, tmp_path: Path) -> None:
    to = tmp_path / "bare.mcap"
    _, missing = export_run(result.out, "jump_two", to)
    assert len(missing) == 2
    assert set(decoded(to)) == {f"/primary/{name}" for name in ("lds", "monitors", "hazards", "passages")}


def test_refusals(result: Result, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="has no run 'other'"):
        export_run(result.out, "other", tmp_path / "a.mcap")
    with pytest.raises(UsageError, match="suffix"):
        export_run(result.out, "jump_two", tmp_path / "a.kml")
    with pytest.raises(UsageError, match="need the site"):
        export_run(result.out, "jump_two", tmp_path / "a.gpx")
