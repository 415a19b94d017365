"""Protobuf messages that this project writes, built at run time: foxglove.LocationFix and its own."""

from __future__ import annotations

from functools import cache
from typing import Any

import dataframely as dy

from pipeline.ingest.recipes import OWN_SCHEMAS
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, Stream

LOCATION_FIX = "foxglove.LocationFix"

# descriptor.proto: FieldDescriptorProto.Type
_DOUBLE, _INT64, _BOOL, _STRING, _MESSAGE, _ENUM = 1, 3, 8, 9, 11, 14
_OPTIONAL, _REPEATED = 1, 3
_TYPES: dict[type[dy.Column], int] = {
    dy.Float64: _DOUBLE,
    dy.Int64: _INT64,
    dy.Bool: _BOOL,
    dy.String: _STRING,
    dy.Enum: _STRING,
}


@cache
def descriptor_set(name: str) -> bytes:
    """The serialised FileDescriptorSet of a message, with what it depends on."""
    from google.protobuf import timestamp_pb2
    from google.protobuf.descriptor_pb2 import (
        FileDescriptorProto,
        FileDescriptorSet,
    )

    timestamp = FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
    file = FileDescriptorProto(
        name=name.replace(".", "/") + ".proto",
        package=name.split(".", maxsplit=1)[0],
        syntax="proto3",
        dependency=[timestamp.name],
    )
    message = file.message_type.add(name=name.rsplit(".", maxsplit=1)[-1])
    if name == LOCATION_FIX:
        _add_location_fix(message)
    else:
        _add_own(message, next(stream for stream in STREAMS if OWN_SCHEMAS[stream] == name))
    return bytes(FileDescriptorSet(file=[timestamp, file]).SerializeToString(deterministic=True))


@cache
def message_class(name: str) -> Any:
    """The class of a message, in a pool of its own."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(descriptor_set(name)).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))


def _add_location_fix(message: Any) -> None:
    """Field numbers of foxglove.LocationFix."""
    covariance = message.enum_type.add(name="PositionCovarianceType")
    for number, value in enumerate(("UNKNOWN", "APPROXIMATED", "DIAGONAL_KNOWN", "KNOWN")):
        covariance.value.add(name=value, number=number)
    for number, field in enumerate(("latitude", "longitude", "altitude"), start=1):
        message.field.add(name=field, number=number, type=_DOUBLE, label=_OPTIONAL)
    message.field.add(name="position_covariance", number=4, type=_DOUBLE, label=_REPEATED)
    message.field.add(
        name="position_covariance_type",
        number=5,
        type=_ENUM,
        label=_OPTIONAL,
        type_name=f".{LOCATION_FIX}.PositionCovarianceType",
    )
    _add_timestamp(message, "timestamp", 6)
    message.field.add(name="frame_id", number=7, type=_STRING, label=_OPTIONAL)


def _add_own(message: Any, stream: Stream) -> None:
    """One field per column, with presence: absent means not known."""
    for number, (name, column) in enumerate(STREAM_SCHEMAS[stream].columns().items(), start=1):
        if isinstance(column, dy.Datetime):
            _add_timestamp(message, name, number)
            continue
        index = len(message.oneof_decl)
        message.oneof_decl.add(name=f"_{name}")
        message.field.add(
            name=name,
            number=number,
            type=_TYPES[type(column)],
            label=_OPTIONAL,
            proto3_optional=True,
            oneof_index=index,
        )


def _add_timestamp(message: Any, name: str, number: int) -> None:
    message.field.add(name=name, number=number, type=_MESSAGE, label=_OPTIONAL, type_name=".google.protobuf.Timestamp")
