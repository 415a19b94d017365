"""Messages of synthetic logs: this project's JSON, and the speeds of an odometer in ROS 2's messages."""

from __future__ import annotations

import json
from collections.abc import Iterator

import dataframely as dy
import numpy as np
import polars as pl

from pipeline.read.ingest.recipes import OWN_SCHEMAS
from pipeline.show.export.messages import Topic
from schemas.arrays import Floats, floats, times_ns
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import Stream

SECOND_NS = 1_000_000_000
_FRAME_ID = "odometer"

_VECTOR3 = "float64 x\nfloat64 y\nfloat64 z\n"
_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/Vector3": _VECTOR3,
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Point": _VECTOR3,
    "geometry_msgs/Quaternion": _VECTOR3 + "float64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
}
_TWIST_PARTS = list(_PARTS)[:4]
_TWIST_COVARIANCE_PARTS = list(_PARTS)[:5]


def _concatenate_definitions(members: str, parts: list[str]) -> str:
    """The concatenated form: the message, then all that it is made of."""
    return f"{'=' * 80}\n".join([members, *(f"MSG: {name}\n{_PARTS[name]}" for name in parts)])


DEFINITIONS: dict[str, str] = {
    "geometry_msgs/msg/TwistStamped": _concatenate_definitions(
        "std_msgs/Header header\ngeometry_msgs/Twist twist\n", _TWIST_PARTS
    ),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _concatenate_definitions(
        "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist\n", _TWIST_COVARIANCE_PARTS
    ),
    "nav_msgs/msg/Odometry": _concatenate_definitions(
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
        list(_PARTS),
    ),
}


def json_topic(stream: Stream, frame: pl.DataFrame) -> Topic:
    """This project's own JSON: one object per row."""
    times = _times_ns(frame)
    name = OWN_SCHEMAS[stream]
    messages = _json_payloads(frame)
    return Topic(f"/{stream}", "json", name, "jsonschema", _json_schema(stream), times, messages)


def _json_schema(stream: Stream) -> bytes:
    """The jsonschema of this project's own message: one property per column."""
    properties = {name: _json_property(column) for name, column in STREAM_SCHEMAS[stream].columns().items()}
    document = {"title": stream, "type": "object", "properties": properties}
    return json.dumps(document, sort_keys=True).encode()


def _json_property(column: dy.Column) -> dict[str, object]:
    """A column as a property of jsonschema."""
    named: dict[str, object] = {"description": column.description or ""}
    if isinstance(column, dy.Datetime):
        parts = {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}
        return named | {"type": "object", "title": "time", "properties": parts}
    if isinstance(column, dy.Enum):
        return named | {"type": "string", "enum": list(column.categories)}
    kinds = {dy.Float64: "number", dy.Int64: "integer", dy.Bool: "boolean", dy.String: "string"}
    return named | {"type": kinds[type(column)]}


def _json_payloads(frame: pl.DataFrame) -> Iterator[bytes]:
    """One object per row; a null is left out."""
    times = [name for name, dtype in frame.schema.items() if isinstance(dtype, pl.Datetime)]
    for row in frame.with_columns(pl.col(times).to_physical()).iter_rows(named=True):
        known = {name: value for name, value in row.items() if value is not None}
        for name in times:
            if name in known:
                seconds, rest = divmod(known[name], SECOND_NS)
                known[name] = {"sec": seconds, "nsec": rest}
        yield json.dumps(known, separators=(",", ":"), ensure_ascii=False).encode()


def twist_topic(frame: pl.DataFrame) -> Topic:
    """geometry_msgs/TwistStamped in little-endian CDR: speed as linear x."""
    values = np.zeros((frame.height, 6))
    values[:, 0] = floats(frame, "speed_mps")
    return _odometer_topic("geometry_msgs/msg/TwistStamped", frame, (_FRAME_ID,), values)


def odometry_topic(frame: pl.DataFrame) -> Topic:
    """nav_msgs/Odometry in little-endian CDR: speed as linear x, variance where the stream has it.

    The numbers are a pose with its covariance, 7 and 36, and a velocity with its own, 6 and 36.
    """
    values = np.zeros((frame.height, 85))
    values[:, 6] = 1.0  # the quaternion of no turn
    values[:, 43] = floats(frame, "speed_mps")
    values[:, 49] = np.nan_to_num(floats(frame, "sigma_speed_mps")) ** 2
    return _odometer_topic("nav_msgs/msg/Odometry", frame, (_FRAME_ID, "base_link"), values)


def _odometer_topic(name: str, frame: pl.DataFrame, texts: tuple[str, ...], values: Floats) -> Topic:
    """Messages that start with a header and texts and go on with numbers, laid out by CDR's alignment rules."""
    head = b"\x00\x01\x00\x00" + bytes(8)
    for text in texts:
        head += bytes(-len(head) % 4) + (len(text) + 1).to_bytes(4, "little") + text.encode() + b"\0"
    head += bytes(-(len(head) - 4) % 8)
    rows = np.zeros(frame.height, dtype=[("head", f"V{len(head)}"), ("values", "<f8", values.shape[1])])
    rows["head"] = np.void(head)
    rows["values"] = values
    stamps = np.column_stack(np.divmod(times_ns(frame), SECOND_NS)).astype("<u4")
    content = rows.view(np.uint8).reshape(frame.height, -1)
    content[:, 4:12] = stamps.view(np.uint8)
    messages = (row.tobytes() for row in content)
    return Topic("/odometer", "cdr", name, "ros2msg", DEFINITIONS[name].encode(), _times_ns(frame), messages)


def _times_ns(frame: pl.DataFrame) -> list[int]:
    """Times of the first column [ns]."""
    return frame.to_series(0).to_physical().to_list()
