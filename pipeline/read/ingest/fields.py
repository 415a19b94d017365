"""What the schema of a channel says, and which fields its messages have."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

from google.protobuf.message import DecodeError
from mcap.records import Schema as McapSchema

from pipeline.read.ingest.json_columns import parse_json
from pipeline.read.ingest.layout import UndecodableError, parse_path, undecodable
from pipeline.read.ingest.mcap_block import Messages
from pipeline.read.ingest.mcap_records import Channel, Schema
from pipeline.read.ingest.ros_message import Definition, DefinitionError, RosWalk, parse_definitions, short_name
from schemas.errors import InputError

_LARGEST_LIST = 64  # elements of a list that are offered one by one
_DEEPEST = 12
_SAMPLED = 64  # messages of JSON, which may leave out any field
_SAMPLED_BYTES = 1 << 20


# A schema takes as long to parse as ten thousand messages to decode, and the logs of a campaign share theirs.
@lru_cache(maxsize=64)
def _protobuf_class(schema: Schema) -> Any:
    """The class of a schema's messages, of the descriptors that it carries."""
    from mcap_protobuf.decoder import DecoderFactory

    record = McapSchema(schema.id, data=schema.data, encoding=schema.encoding, name=schema.name)
    decode = DecoderFactory().decoder_for("protobuf", record)
    return type(decode(b"")) if decode is not None else None


def _ros_definitions(schema: Schema) -> tuple[Mapping[str, Definition], str]:
    """Definitions of a ROS 2 schema, and the short name of its message."""
    definitions = parse_definitions(schema.name, schema.data.decode())
    name = short_name(schema.name)
    if name not in definitions:
        raise DefinitionError(f"no definition of {schema.name}")
    return definitions, name


# By encoding of messages: that of their schemas, and what makes a definition of these.
_DEFINITIONS: Mapping[str, tuple[str, Callable[[Schema], Any]]] = {
    "protobuf": ("protobuf", _protobuf_class),
    "cdr": ("ros2msg", _ros_definitions),
}


def definition_of(channel: Channel) -> Any:
    """What a channel's messages are made of: the class of protobuf messages, or ROS 2 definitions and a name of them.

    Parsers of schemas raise whatever they stumble over.
    """
    encoding, make = _DEFINITIONS.get(channel.encoding, ("", None))
    if make is None:
        raise InputError(
            "has an encoding that this program does not read",
            place=channel.place,
            found=channel.encoding or "none",
            expected="json, protobuf or cdr",
        )
    if channel.schema is None or channel.schema.encoding != encoding:
        raise InputError(
            "has a schema encoding that does not fit its message encoding",
            place=channel.place,
            found=f"message encoding {channel.encoding}, schema encoding {channel.schema_encoding or 'none'}",
            expected="schema encoding protobuf for protobuf messages, ros2msg for cdr messages",
        )
    try:
        return make(channel.schema)
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise InputError(
            f"has a schema that cannot be parsed: {reason[:200]}", place=channel.place, found=channel.schema_name
        ) from None


def fields_of(channel: Channel, messages: Messages) -> dict[str, str]:
    """Field paths of the first message, of JSON those of the first ones, with their kind: `int`, `float`, `text`,
    `flag`, `null`.
    """
    fields: dict[str, str] = {}
    few = int((messages.length[:_SAMPLED].cumsum() < _SAMPLED_BYTES).sum()) if channel.encoding == "json" else 1
    for row in range(max(few, 1)):
        try:
            found = dict(_fields_of_message(channel, messages.payload(row)))
        except UndecodableError as error:
            raise undecodable(channel, messages.log_time[row], error) from None
        fields |= {path: kind for path, kind in found.items() if fields.get(path, "null") == "null"}
    return fields


def _fields_of_message(channel: Channel, payload: bytes) -> Iterator[tuple[str, str]]:
    """Paths of the fields of one message, with their kinds."""
    if channel.encoding == "json":
        return _plain_values(parse_json(payload), "", 0)
    definition = definition_of(channel)
    if channel.encoding == "cdr":
        return RosWalk(payload, *definition).kinds()
    try:
        return _plain_values(definition.FromString(payload), "", 0)
    except DecodeError as error:
        raise UndecodableError(f"not the protobuf message of its schema: {error}") from None


def may_follow(channel: Channel, path: str) -> bool:
    """Whether the schema knows a field that the first message lacks, as it does the elements of arrays."""
    steps = parse_path(path)
    followers = [*steps[1:], ""]
    named = [
        (step, isinstance(after, int)) for step, after in zip(steps, followers, strict=True) if isinstance(step, str)
    ]
    if channel.encoding == "protobuf":
        return _knows_protobuf_path(definition_of(channel).DESCRIPTOR, named)
    if channel.encoding != "cdr":
        return False
    definitions, kind = definition_of(channel)
    return _knows_ros_path(definitions, kind, named)


def _knows_protobuf_path(descriptor: Any, named: Sequence[tuple[str, bool]]) -> bool:
    """Whether a descriptor knows a path; `named`: its names, and whether an index stands behind each."""
    for name, indexed in named:
        field = descriptor.fields_by_name.get(name) if descriptor is not None else None
        if field is None or field.is_repeated != indexed:
            return False
        descriptor = field.message_type
    return descriptor is None


def _knows_ros_path(definitions: Mapping[str, Definition], kind: str, named: Sequence[tuple[str, bool]]) -> bool:
    """Whether definitions know a path to a plain value, through arrays of fixed size alone."""
    for name, indexed in named:
        member = next((member for member in definitions.get(kind, ()) if member.name == name), None)
        # Elements of an array of fixed size are in every message.
        if member is None or member.count != (0 if indexed else None):
            return False
        kind = member.type
    return kind not in definitions


def _plain_values(value: Any, path: str, depth: int) -> Iterator[tuple[str, str]]:
    """Paths and kinds of the plain values below a value."""
    if depth > _DEEPEST:
        return
    children = _named_parts(value)
    if children is None:
        yield path, _kind_of_value(value)
        return
    for name, child in children:
        joined = f"{path}{name}" if name.startswith("[") or not path else f"{path}.{name}"
        yield from _plain_values(child, joined, depth + 1)


def _named_parts(value: Any) -> list[tuple[str, Any]] | None:
    """Named parts of a message or list; none for a plain value."""
    if isinstance(value, dict):
        return [(str(name), child) for name, child in value.items()]
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        # A message that is not set is shown with its defaults, down to one level of a type.
        recursive = {field.name for field in descriptor.fields if field.message_type is descriptor}
        names = [field.name for field in descriptor.fields]
        return [(name, None if name in recursive else getattr(value, name)) for name in names]
    if isinstance(value, str | bytes) or not hasattr(value, "__len__"):
        return None
    return [(f"[{index}]", child) for index, child in enumerate(list(value[:_LARGEST_LIST]))]


def _kind_of_value(value: Any) -> str:
    """Kind of a plain value: `flag`, `int`, `float`, `null` or `text`."""
    kinds = {bool: "flag", int: "int", float: "float", type(None): "null"}
    return next((name for kind, name in kinds.items() if isinstance(value, kind)), "text")
