"""A run of several MCAP logs: each holds what its recorder heard, and a topic of one name may mean different things."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import Writer

from pipeline.make.receivers import convert
from pipeline.read.ingest import describe, mcap_run
from schemas.config import Configuration, IngestConfig, settings_from
from schemas.errors import InputError

START_NS = 1_740_981_600 * 10**9
ROWS = 50


def log_of(path: Path, topic: str, schema: str, rows: list[dict[str, Any]]) -> Path:
    """One topic in JSON at 10 Hz."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
        for number, row in enumerate(rows):
            t_ns = START_NS + number * 10**8
            writer.add_message(channel, t_ns, json.dumps(row).encode(), t_ns)
        writer.finish()
    return path


@pytest.fixture
def positions(tmp_path: Path) -> Path:
    stamps = [{"sec": 1_740_981_600 + number // 10, "nsec": number % 10 * 10**8} for number in range(ROWS)]
    rows = [{"timestamp": stamp, "latitude": 50.0, "longitude": 14.0, "altitude": 200.0} for stamp in stamps]
    return log_of(tmp_path / "gnss.mcap", "/gnss", "foxglove.LocationFix", rows)


def wheel(path: Path, factor: float) -> Path:
    return log_of(path, "/odo", "x.Odo", [{"v": factor * (10.0 + 0.1 * number)} for number in range(ROWS)])


def mapped(*mappings: dict[str, Any]) -> IngestConfig:
    usual = {"fields": {"speed_mps": "v"}, "time": "log", "origin": "wheel"}
    return settings_from({"ingest": {"odometer": [usual | own for own in mappings]}}, Configuration, "test").ingest


def test_positions_in_one_log_and_the_wheel_in_another(tmp_path: Path, positions: Path) -> None:
    found = convert([positions, wheel(tmp_path / "wheel.mcap", 1.0)], "r", mapped({"topic": "/odo"}))
    assert found.run.gnss.height == ROWS
    assert found.run.odometer is not None
    assert found.run.odometer["speed_mps"].to_list() == pytest.approx([10.0 + 0.1 * n for n in range(ROWS)])
    assert {(part.log, part.used_as.partition(":")[0]) for part in found.parts} == {
        ("gnss.mcap", "gnss"),
        ("wheel.mcap", "odometer"),
    }


def test_one_topic_of_two_logs_in_two_units(tmp_path: Path, positions: Path) -> None:
    logs = [positions, wheel(tmp_path / "one.mcap", 1.0), wheel(tmp_path / "two.mcap", 3.6)]
    one = {"topic": "one.mcap:/odo", "constants": {"sensor": "one"}}
    two = {"topic": "two.mcap:/odo", "constants": {"sensor": "two"}, "factors": {"speed_mps": 1 / 3.6}}
    found = convert(logs, "r", mapped(one, two)).run.odometer
    assert found is not None
    by_sensor = {name: rows["speed_mps"].to_list() for (name,), rows in found.group_by("sensor")}
    assert by_sensor["one"] == pytest.approx([10.0 + 0.1 * n for n in range(ROWS)])
    assert by_sensor["two"] == pytest.approx(by_sensor["one"])
    with pytest.raises(InputError, match=r"LOG\.mcap:TOPIC"):
        convert(logs, "r", mapped({"topic": "/odo"}))


@pytest.mark.parametrize("topic", ["/other", "gnss.mcap:/odo"])
def test_a_topic_that_none_of_the_logs_holds(tmp_path: Path, positions: Path, topic: str) -> None:
    logs = [positions, wheel(tmp_path / "wheel.mcap", 1.0)]
    with pytest.raises(InputError, match="is configured for odometer but has no messages"):
        convert(logs, "r", mapped({"topic": "/odo"}, {"topic": topic, "constants": {"sensor": "other"}}))


def test_a_wheel_without_any_position_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no epoch with a time and a position"):
        convert([wheel(tmp_path / "wheel.mcap", 1.0)], "r", mapped({"topic": "/odo"}))


def test_a_log_is_walked_once(positions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    walked: list[str] = []
    walk_log = mcap_run.walk_log

    def counted(path: Any, *rest: Any) -> Any:
        walked.append(str(path))
        return walk_log(path, *rest)

    monkeypatch.setattr(mcap_run, "walk_log", counted)
    monkeypatch.setattr(describe, "walk_log", counted)
    assert convert([positions], "r").run.gnss.height == ROWS
    assert walked == [str(positions)]
