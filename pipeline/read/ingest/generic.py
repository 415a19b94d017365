"""Decoding message by message: for what the columnar decoders do not cover, and the first of each channel."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial
from typing import Any

import polars as pl
from mcap.records import Schema as McapSchema

from pipeline.read.ingest.mcap_block import Messages
from pipeline.read.ingest.mcap_records import Channel, Schema
from pipeline.read.ingest.ros_message import Definition, DefinitionError, RosWalk, parse_definitions, short_name
from schemas.errors import InputError

_LARGEST_LIST = 64  # elements of a list that are offered one by one
_DEEPEST = 12

Value = Any
Decode = Callable[[bytes], Value]


class UndecodableError(Exception):
    """A message that its own schema does not fit; `str` says why."""


def decoder_for(channel: Channel) -> Decode:
    """The decoder of a channel's messages: to dicts (json, cdr) or messages with attributes (protobuf)."""
    if channel.encoding == "json":
        return parse_json
    if channel.encoding not in _DEFINITIONS:
        raise InputError(
            "has an encoding that this program does not read",
            place=channel.place,
            found=channel.encoding or "none",
            expected="json, protobuf or cdr",
        )
    definition = definition_of(channel)
    decode = definition.FromString if channel.encoding == "protobuf" else partial(_cdr_message, definition)

    def checked(payload: bytes) -> Value:
        try:
            return decode(payload)
        except Exception as error:  # those of decoders share no base class
            raise UndecodableError(f"not the {channel.encoding} message of its schema: {error}") from None

    return checked


def _cdr_message(definition: tuple[Mapping[str, Definition], str], payload: bytes) -> Value:
    definitions, name = definition
    return RosWalk(payload, definitions).message(name)


def parse_json(payload: bytes) -> Value:
    """One JSON document; literals that are not JSON (NaN, Infinity) and doubled names are refused."""
    try:
        return json.loads(payload, parse_constant=_refuse_literal, object_pairs_hook=_object)
    except (ValueError, RecursionError) as error:
        raise UndecodableError(f"not JSON: {error}") from None


def _object(pairs: list[tuple[str, Value]]) -> dict[str, Value]:
    """An object; of two values under one name, nobody can say which is meant."""
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError("a name occurs twice in one object")
    return members


def _refuse_literal(literal: str) -> Value:
    raise ValueError(f"the literal {literal}")


# A schema takes as long to parse as ten thousand messages to decode, and the logs of a campaign share theirs.
@lru_cache(maxsize=64)
def _protobuf_class(schema: Schema) -> Any:
    """The class of a schema's messages, of the descriptors that it carries."""
    from mcap_protobuf.decoder import DecoderFactory

    record = McapSchema(schema.id, data=schema.data, encoding=schema.encoding, name=schema.name)
    decode = DecoderFactory().decoder_for("protobuf", record)
    return type(decode(b"")) if decode is not None else None


def _ros_definitions(schema: Schema) -> tuple[Mapping[str, Definition], str]:
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
    encoding, make = _DEFINITIONS[channel.encoding]
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


def decode_columns(
    channel: Channel, messages: Messages, types: Mapping[str, pl.DataType], rows: str = ""
) -> tuple[dict[str, pl.Series], list[int]]:
    """One column per field path, decoded message by message; with `rows` one row per element of that array.

    Also returns, for each row, the number of its message.
    """
    decode = decoder_for(channel)
    takers = [(path, _taker(path), dtype) for path, dtype in types.items()]
    array = _taker(rows)
    values: dict[str, list[Value]] = {path: [] for path in types}
    numbers: list[int] = []
    for number in range(len(messages)):
        try:
            message = decode(messages.payload(number))
            for element in array(message) or [] if rows else [message]:
                numbers.append(number)
                for path, take, dtype in takers:
                    value = take(element)
                    values[path].append(_fitting(take(message) if value is None and rows else value, dtype))
        except UndecodableError as error:
            raise undecodable(channel, messages, number, error) from None
    return {path: pl.Series(path, column, dtype=types[path]) for path, column in values.items()}, numbers


def undecodable(channel: Channel, messages: Messages, row: int, error: UndecodableError) -> InputError:
    """The error for one message, named by the time at which it was recorded."""
    return InputError(
        f"the message recorded at log time {messages.log_time[row]} ns cannot be decoded: {error}",
        place=channel.place,
        remedy="Record the log again, or map other fields.",
    )


def parse_path(path: str) -> list[str | int]:
    """`a.b[3].c` as `["a", "b", 3, "c"]`."""
    steps: list[str | int] = []
    for part in path.split("."):
        name, *indices = part.split("[")
        steps.append(name)
        steps += [int(index.rstrip("]")) for index in indices]
    return steps


def _taker(path: str) -> Callable[[Value], Value]:
    steps = parse_path(path)

    def take(message: Value) -> Value:
        value = message
        for step in steps:
            value = child(value, step)
            if value is None:
                return None
        return value

    return take


def child(value: Value, step: str | int) -> Value:
    """A field or element, none where it is absent (also: a protobuf field with presence that is not set)."""
    if isinstance(step, int):
        return value[step] if hasattr(value, "__len__") and step < len(value) else None
    if isinstance(value, dict):
        return value.get(step)
    descriptor = getattr(value, "DESCRIPTOR", None)
    known = descriptor.fields_by_name.get(step) if descriptor is not None else None
    if known is None or (known.has_presence and not value.HasField(step)):
        return None
    return getattr(value, step)


def _shown(value: Value) -> str:
    """The value in an error, however long it is (Python does not even write integers of 4,300 digits)."""
    long = isinstance(value, int) and value.bit_length() > 1024
    return f"an integer of {value.bit_length()} bits" if long else repr(value)[:80]


# What values of a type may be, and how the type is called.
_KINDS: dict[type[pl.DataType], tuple[type, str]] = {
    pl.Float64: (float, "a number"),
    pl.Int64: (int, "a 64-bit integer"),
    pl.String: (str, "text"),
    pl.Boolean: (bool, "true or false"),
}


def _fitting(value: Value, dtype: pl.DataType) -> Value:
    """The value in the type asked for: whole numbers also serve as floats, and floats that are whole as integers."""
    kind, name = _KINDS[type(dtype)]
    fits = value is None or type(value) is kind
    if fits and (kind is not int or value is None or -(2**63) <= value < 2**63):
        return value
    if kind is float and type(value) is int and abs(value) < 2**1023:
        return float(value)
    if kind is int and type(value) is float and value.is_integer() and abs(value) < 2**53:
        return int(value)
    raise UndecodableError(f"{_shown(value)} is not {name}")


def fields_of(message: Any) -> dict[str, str]:
    """Field paths of a decoded message with their kind: `int`, `float`, `text`, `flag`, `null`."""
    return dict(_leaves(message, "", 0))


def _leaves(value: Any, path: str, depth: int) -> Iterator[tuple[str, str]]:
    if depth > _DEEPEST:
        return
    children = _children(value)
    if children is None:
        yield path, _kind(value)
        return
    for name, child in children:
        joined = f"{path}{name}" if name.startswith("[") or not path else f"{path}.{name}"
        yield from _leaves(child, joined, depth + 1)


def _children(value: Any) -> list[tuple[str, Any]] | None:
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


def _kind(value: Any) -> str:
    kinds = {bool: "flag", int: "int", float: "float", type(None): "null"}
    return next((name for kind, name in kinds.items() if isinstance(value, kind)), "text")
