"""A component of a velocity in a frame of the world is no speed of the train."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.read.ingest import read_run
from pipeline.read.ingest.plan import is_world_frame
from schemas.config import Configuration, settings_from
from schemas.errors import InputError
from tests.read.ingest import samples
from tests.read.ingest.samples import START_NS, channel, message, position, schema, whole

SECOND = 10**9
TWIST = {"linear": {"x": 3.0, "y": -4.0, "z": 12.0}}


def log_of(folder: Path, **frames: str) -> Path:
    """Positions, and a twist on /ekf whose messages name these frames."""
    body: dict[str, object] = {"twist": {"twist": TWIST}}
    body |= {"header": {"frame_id": frames["header"]}} if "header" in frames else {}
    body |= {"child_frame_id": frames["child"]} if "child" in frames else {}
    return samples.save(
        folder,
        whole(
            schema(1),
            channel(1, 1, "/gnss"),
            schema(2, "nav_msgs/msg/Odometry"),
            channel(2, 2, "/ekf"),
            *(message(position(n), START_NS + n * SECOND) for n in range(2)),
            *(message(json.dumps(body).encode(), START_NS + n * SECOND, 2) for n in range(2)),
        ),
    )


def speeds(path: Path, **mapping: object) -> list[float]:
    odometer = {"topic": "/ekf", "time": "log", "origin": "wheel", **mapping}
    config = settings_from({"ingest": {"odometer": odometer}}, Configuration, "mapping").ingest
    run = read_run(path, config)
    assert run.odometer is not None
    return run.odometer["speed_mps"].to_list()


@pytest.mark.parametrize("frame", ["map", "odom", "/world", "robot/odom", "ENU", "earth", "map_ned", "utm", "gps"])
def test_frames_of_the_world(frame: str) -> None:
    assert is_world_frame(frame)


@pytest.mark.parametrize(
    "frame", ["base_link", "base_footprint", "", "imu_link", "train", "wheel", "mapper", "bogie_1"]
)
def test_frames_of_a_vehicle(frame: str) -> None:
    assert not is_world_frame(frame)


@pytest.mark.parametrize("fields", [{}, {"speed_mps": "twist.twist.linear.x"}])
@pytest.mark.parametrize(
    "frames",
    [{"child": "odom"}, {"header": "odom", "child": "map"}, {"header": "map"}, {"header": "base", "child": "enu"}],
)
def test_a_component_in_the_world_is_refused_with_what_to_write(
    tmp_path: Path, frames: dict[str, str], fields: dict[str, str]
) -> None:
    path = log_of(tmp_path, **frames)
    with pytest.raises(InputError) as caught:
        speeds(path, fields=fields)
    text = str(caught.value)
    assert "does not turn with the train" in text
    assert 'speed_mps = "norm(twist.twist.linear)"' in text
    assert 'frame = "base_link"' in text
    assert speeds(path, fields={"speed_mps": "norm(twist.twist.linear)"}) == [13.0, 13.0]
    assert speeds(path, fields=fields, frame="base_link") == [3.0, 3.0]
    with pytest.raises(InputError, match="does not turn with the train; found frame 'map'"):
        speeds(path, fields=fields, frame="map")


def test_a_component_along_the_vehicle_is_a_speed(tmp_path: Path) -> None:
    """Of an odometry the twist is in the child's frame, whatever the pose is in."""
    assert speeds(log_of(tmp_path, header="odom", child="base_link")) == [3.0, 3.0]
    assert speeds(log_of(tmp_path, header="base_link")) == [3.0, 3.0]
    assert speeds(log_of(tmp_path)) == [3.0, 3.0]


def test_of_ros_messages(tmp_path: Path) -> None:
    """The sample's own twist names no frame; with one of the world in its place it is refused."""
    path = samples.save(tmp_path, samples.log_bytes())
    mapping = {"topic": "/odometer", "origin": "wheel", "fields": {"speed_mps": "twist.linear.x"}}
    config = settings_from({"ingest": {"odometer": mapping}}, Configuration, "mapping").ingest
    run = read_run(path, config)
    assert run.odometer is not None
    assert run.odometer.height == 80
    norm = settings_from(
        {"ingest": {"odometer": mapping | {"fields": {"speed_mps": "norm(twist.linear)"}}}}, Configuration, "mapping"
    ).ingest
    again = read_run(path, norm)
    assert again.odometer is not None
    assert again.odometer["speed_mps"].to_list() == [abs(speed) for speed in run.odometer["speed_mps"]]
