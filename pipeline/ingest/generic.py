"""The ordinary decoders, message by message: for what the columnar decoders do not cover."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import polars as pl

from pipeline.ingest.mcap_block import Messages
from pipeline.ingest.mcap_model import Channel, Schema, as_mcap_schema
from schemas.errors import InputError

Value = Any
Decode = Callable[[bytes], Value]


class UndecodableError(Exception):
    """A message that its own schema does not fit; `str` says why."""


def decoder_for(channel: Channel) -> Decode:
    """The decoder of a channel's messages: to dicts (json) or objects with attributes."""
    if channel.encoding == "json":
        return parse_json
    makers = {"protobuf": _protobuf_decoder, "cdr": _cdr_decoder}
    if channel.encoding not in makers:
        raise InputError(
            "has an encoding that is not read",
            place=channel.place,
            found=channel.encoding or "none",
            expected="json, protobuf or cdr",
        )
    return makers[channel.encoding](channel)


def parse_json(payload: bytes) -> Value:
    """One JSON document; literals that are not JSON (NaN, Infinity) and doubled names are refused."""
    try:
        return json.loads(payload, parse_constant=_refuse_literal, object_pairs_hook=_object)
    except (ValueError, RecursionError) as error:
        raise UndecodableError(f"not JSON: {error}") from None


def _object(pairs: list[tuple[str, Value]]) -> dict[str, Value]:
    """An object; of two values under one name, nobody can say which is meant."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name stands twice in one object")
    return found


def _refuse_literal(literal: str) -> Value:
    raise ValueError(f"the literal {literal}")


def _protobuf_decoder(channel: Channel) -> Decode:
    from google.protobuf.message import DecodeError

    decode = _made(_stock_protobuf, channel)

    def checked(payload: bytes) -> Value:
        try:
            return decode(payload)
        except DecodeError as error:
            raise UndecodableError(f"not the protobuf message of its schema: {error}") from None

    return checked


def _cdr_decoder(channel: Channel) -> Decode:
    decode = _made(_stock_ros2, channel)

    def checked(payload: bytes) -> Value:
        if len(payload) < 4 or payload[0] != 0 or payload[1] not in (0, 1):
            raise UndecodableError(f"encapsulation 0x{payload[:2].hex()} is not plain CDR")
        try:
            return decode(payload)
        except Exception as error:
            # The reader raises struct.error, UnicodeDecodeError, MemoryError and more on short messages.
            raise UndecodableError(f"not the CDR message of its schema: {type(error).__name__}") from None

    return checked


# A schema takes as long to parse as ten thousand messages to decode, and the logs of a campaign share theirs.
@lru_cache(maxsize=64)
def _stock_protobuf(schema: Schema | None) -> Decode | None:
    from mcap_protobuf.decoder import DecoderFactory

    return DecoderFactory().decoder_for("protobuf", as_mcap_schema(schema))


@lru_cache(maxsize=64)
def _stock_ros2(schema: Schema | None) -> Decode | None:
    from mcap_ros2.decoder import DecoderFactory

    return DecoderFactory().decoder_for("cdr", as_mcap_schema(schema))


def _made(make: Callable[[Schema | None], Decode | None], channel: Channel) -> Decode:
    """A decoder of the `mcap` family, whose schema parsers raise whatever they stumble over."""
    try:
        decode = make(channel.schema)
    except Exception as error:
        raise InputError(
            f"has a schema that cannot be parsed: {error}", place=channel.place, found=channel.schema_name
        ) from None
    if decode is None:
        raise InputError(
            "has no schema that fits its encoding",
            place=channel.place,
            found=f"encoding {channel.encoding}, schema encoding {channel.schema_encoding or 'none'}",
            expected="protobuf with protobuf, cdr with ros2msg",
        )
    return decode


def protobuf_descriptor(channel: Channel) -> Any:
    """The descriptor of a channel's messages."""
    return _protobuf_decoder(channel)(b"").DESCRIPTOR


def decode_columns(
    channel: Channel, messages: Messages, types: Mapping[str, pl.DataType], rows: str = ""
) -> tuple[pl.DataFrame, list[int]]:
    """One column per field path, decoded message by message; with `rows` one row per element of that array.

    Also returns, for each row, the number of its message.
    """
    decode = decoder_for(channel)
    takers = [(path, _taker(path), _COERCIONS[type(dtype)]) for path, dtype in types.items()]
    array = _taker(rows)
    values: dict[str, list[Value]] = {path: [] for path in types}
    numbers: list[int] = []
    for number in range(len(messages)):
        try:
            message = decode(messages.payload(number))
            for element in array(message) or [] if rows else [message]:
                numbers.append(number)
                for path, take, coerce in takers:
                    value = take(element)
                    values[path].append(coerce(take(message) if value is None and rows else value))
        except UndecodableError as error:
            raise undecodable(channel, messages, number, error) from None
    series = [pl.Series(path, column, dtype=types[path]) for path, column in values.items()]
    return pl.DataFrame(series), numbers


def undecodable(channel: Channel, messages: Messages, row: int, error: UndecodableError) -> InputError:
    """The error for one message, named by the time at which it was recorded."""
    return InputError(
        f"the message of log time {messages.times('log_time')[row]} ns cannot be decoded: {error}",
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
    if descriptor is not None:
        known = descriptor.fields_by_name.get(step)
        if known is None or (known.has_presence and not value.HasField(step)):
            return None
    return getattr(value, step, None)


def _as_float(value: Value) -> float | None:
    if value is None or (isinstance(value, float)):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    raise UndecodableError(f"{value!r} is not a number")


def _as_int(value: Value) -> int | None:
    if value is None or (isinstance(value, int) and not isinstance(value, bool)):
        if value is not None and not -(2**63) <= value < 2**63:
            raise UndecodableError(f"{value!r} is no 64-bit integer")
        return value
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    raise UndecodableError(f"{value!r} is not an integer")


def _as_text(value: Value) -> str | None:
    if value is None or isinstance(value, str):
        return value
    raise UndecodableError(f"{value!r} is not a text")


def _as_flag(value: Value) -> bool | None:
    if value is None or isinstance(value, bool):
        return value
    raise UndecodableError(f"{value!r} is not true or false")


_COERCIONS: dict[type[pl.DataType], Callable[[Value], Value]] = {
    pl.Float64: _as_float,
    pl.Int64: _as_int,
    pl.String: _as_text,
    pl.Boolean: _as_flag,
}
