"""Flat messages, protobuf or ROS 2, built at run time: rows of a frame, and those of Foxglove's that are needed."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Iterator, Mapping
from enum import IntEnum
from functools import cache
from typing import Any, Literal

import polars as pl

from schemas.arrays import NS_PER_S
from schemas.frozen import frozen

Encoding = Literal["protobuf", "cdr"]

LOG: Fields = (
    ("timestamp", "time"), ("level", "level"), ("message", "string"), ("name", "string"), ("file", "string"),
    ("line", "fixed32"),
)  # fmt: skip
"""foxglove.Log: fields in the order of their numbers."""

GEOJSON: Fields = (("geojson", "string"),)
"""foxglove.GeoJSON."""


class Level(IntEnum):
    """foxglove.Log levels that events have."""

    INFO = 2
    WARNING = 3
    ERROR = 4


# Kinds that are enumerations: name and words in the order of their numbers.
_ENUMS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "level": ("Level", ("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL")),
    "covariance type": ("PositionCovarianceType", ("UNKNOWN", "APPROXIMATED", "DIAGONAL_KNOWN", "KNOWN")),
}


@frozen
class Topic:
    """One channel to write: its schema, one payload per time [ns since 1970], and notes for its metadata."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    times_ns: list[int]
    messages: Iterator[bytes]
    notes: Mapping[str, str] = dataclasses.field(default_factory=dict)


def rows_topic(topic: str, name: str, frame: pl.DataFrame, encoding: Encoding) -> Topic:
    """One message per row, time in the first column; a null is not set."""
    fields = fields_of(frame)
    times = frame.to_series(0).to_physical().to_list()
    plain = frame.with_columns(pl.col(field).to_physical() for field, kind in fields if kind == "time")
    return message_topic(topic, name, fields, times, plain.iter_rows(named=True), encoding)


def fields_of(frame: pl.DataFrame) -> Fields:
    """Columns and the kinds of field that hold them."""
    return tuple((column, _field_kind(dtype)) for column, dtype in frame.schema.items())


def log_topic(topic: str, entries: list[tuple[int, int, str, str]], encoding: Encoding) -> Topic:
    """foxglove.Log from time [ns], level, name and message, put in order of time."""
    ordered = sorted(entries)
    rows = (
        {"timestamp": t_ns, "level": level, "message": text, "name": name, "file": "", "line": 0}
        for t_ns, level, name, text in ordered
    )
    return message_topic(topic, "foxglove.Log", LOG, [entry[0] for entry in ordered], rows, encoding)


def geojson_topic(topic: str, t_ns: int, text: str, encoding: Encoding) -> Topic:
    """foxglove.GeoJSON, once."""
    return message_topic(topic, "foxglove.GeoJSON", GEOJSON, [t_ns], iter([{"geojson": text}]), encoding)


def message_topic(
    topic: str, name: str, fields: Fields, times: list[int], rows: Iterator[Mapping[str, Any]], encoding: Encoding
) -> Topic:
    """One message per row."""
    if encoding == "cdr":
        package, _, message = name.rpartition(".")
        schema = definition(fields).encode()
        return Topic(
            topic, "cdr", f"{package}_msgs/msg/{message}", "ros2msg", schema, times, cdr_messages(fields, rows)
        )
    messages = (_protobuf_message(name, fields, row) for row in rows)
    return Topic(topic, "protobuf", name, "protobuf", descriptor(name, fields), times, messages)


@cache
def descriptor(name: str, fields: Fields) -> bytes:
    """The serialised FileDescriptorSet of a message, with the time stamp it may hold."""
    from google.protobuf import timestamp_pb2
    from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

    stamp = FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(stamp)
    file = FileDescriptorProto(
        name=name.replace(".", "/") + ".proto",
        package=name.rpartition(".")[0],
        syntax="proto3",
        dependency=[stamp.name],
    )
    message = file.message_type.add(name=name.rpartition(".")[2])
    for number, (field, kind) in enumerate(fields, start=1):
        _add_field(message, name, number, field, kind)
    return bytes(FileDescriptorSet(file=[stamp, file]).SerializeToString(deterministic=True))


@cache
def message_class(name: str, fields: Fields) -> Any:
    """The class of a message, in a pool of its own."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor(name, fields)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))


def _add_field(message: Any, name: str, number: int, field: str, kind: str) -> None:
    """Add a field to a description of messages."""
    from google.protobuf.descriptor_pb2 import FieldDescriptorProto

    def add(kind: str, **more: Any) -> None:
        """Add a field of this kind."""
        label = more.pop("label", "OPTIONAL")
        of_type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
        of_label = FieldDescriptorProto.Label.Value(f"LABEL_{label}")
        message.field.add(name=field, number=number, type=of_type, label=of_label, **more)

    if kind == "time":
        add("message", type_name=".google.protobuf.Timestamp")
    elif kind in _ENUMS:
        enum, words = _ENUMS[kind]
        values = message.enum_type.add(name=enum)
        for value, word in enumerate(words):
            values.value.add(name=word, number=value)
        add("enum", type_name=f".{name}.{enum}")
    elif kind == "doubles":
        add("double", label="REPEATED")
    elif name.startswith("foxglove."):
        add(kind)
    else:
        # With presence: absent means not known, which a plain proto3 field would show as zero.
        message.oneof_decl.add(name=f"_{field}")
        add(kind, proto3_optional=True, oneof_index=len(message.oneof_decl) - 1)


def _field_kind(dtype: pl.DataType) -> str:
    """Kind of a field, of the type of its column."""
    if isinstance(dtype, pl.Datetime):
        return "time"
    if dtype == pl.Boolean:
        return "bool"
    if dtype.is_integer():
        return "int64"
    return "double" if dtype.is_float() else "string"


def _protobuf_message(name: str, fields: Fields, values: Mapping[str, Any]) -> bytes:
    """A message in protobuf's encoding."""
    times = {field: _protobuf_stamp(values[field]) for field, kind in fields if kind == "time"}
    return bytes(message_class(name, fields)(**{**values, **times}).SerializeToString(deterministic=True))


def _protobuf_stamp(t_ns: int | None) -> dict[str, int] | None:
    """Seconds and nanoseconds of a time."""
    return None if t_ns is None else dict(zip(("seconds", "nanos"), divmod(t_ns, NS_PER_S), strict=True))


Fields = tuple[tuple[str, str], ...]
"""Names and kinds: `time`, `double`, `int64`, `fixed32`, `level`, `bool`, `string`; `int8`, `uint8`, `uint16` (ROS 2
only), `doubles` and `covariance type` (protobuf only).
"""

_HEADER = b"\x00\x01\x00\x00"
# Kind: type in the definition, format, alignment; times and strings are laid out by themselves.
_PLAIN = {
    "double": ("float64", "<d", 8),
    "int64": ("int64", "<q", 8),
    "fixed32": ("uint32", "<I", 4),
    "level": ("uint8", "<B", 1),
    "bool": ("bool", "<?", 1),
    "int8": ("int8", "<b", 1),
    "uint8": ("uint8", "<B", 1),
    "uint16": ("uint16", "<H", 2),
}
_UNKNOWN: Mapping[str, Any] = {"double": float("nan"), "string": "", "bool": False}
_TIME = "\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"


def definition(fields: Fields) -> str:
    """The definition text as it stands in a bag."""
    kinds = {"time": "builtin_interfaces/Time", "string": "string"} | {kind: row[0] for kind, row in _PLAIN.items()}
    lines = [f"{kinds[kind]} {name}" for name, kind in fields]
    return "\n".join(lines) + (_TIME if any(kind == "time" for _, kind in fields) else "\n")


def cdr_messages(fields: Fields, rows: Iterator[Mapping[str, Any]]) -> Iterator[bytes]:
    """One message per row. What is not known is NaN, an empty text or false: this encoding has no null."""
    for row in rows:
        content = bytearray()
        for name, kind in fields:
            value = row[name] if row[name] is not None else _UNKNOWN[kind]
            _append_cdr(content, kind, value)
        yield _HEADER + bytes(content)


def _append_cdr(content: bytearray, kind: str, value: Any) -> None:
    """Append a value in the encoding of CDR."""
    if kind == "time":
        seconds, rest = divmod(value, NS_PER_S)
        content += bytes(-len(content) % 4) + struct.pack("<iI", seconds, rest)
    elif kind == "string":
        text = value.encode() + b"\0"
        content += bytes(-len(content) % 4) + struct.pack("<I", len(text)) + text
    else:
        _, form, alignment = _PLAIN[kind]
        content += bytes(-len(content) % alignment) + struct.pack(form, value)
