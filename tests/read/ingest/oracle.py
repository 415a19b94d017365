"""The independent reading of well-formed logs, through the `mcap` package and its decoders."""

from __future__ import annotations

import io
import json
from collections.abc import Callable

import polars as pl
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
from mcap_ros2.decoder import DecoderFactory as Ros2Factory

SECOND_NS = 1_000_000_000
FIX = {-1: "none", 0: "autonomous", 1: "sbas", 2: "differential"}


def decoded(content: bytes) -> dict[str, list[object]]:
    """Messages by topic, in order of the file."""
    reader = make_reader(io.BytesIO(content), decoder_factories=[ProtobufFactory(), Ros2Factory()])
    found: dict[str, list[object]] = {}
    records = StreamReader(io.BytesIO(content), validate_crcs=True).records
    schemas, channels = {}, {}
    for entry in records:
        kind = type(entry).__name__
        if kind == "Schema":
            schemas[entry.id] = entry
        elif kind == "Channel":
            channels[entry.id] = entry
        elif kind == "Message":
            place = channels[entry.channel_id]
            if place.message_encoding == "json":
                message = json.loads(entry.data)
            else:
                factory = ProtobufFactory() if place.message_encoding == "protobuf" else Ros2Factory()
                message = _cached(factory, place, schemas)(entry.data)
            found.setdefault(place.topic, []).append(message)
    assert reader is not None
    return found


_DECODERS: dict[object, Callable[[bytes], object]] = {}


def _cached(factory, place, schemas):
    schema = schemas[place.schema_id]
    key = (schema.name, bytes(schema.data))
    if key not in _DECODERS:
        _DECODERS[key] = factory.decoder_for(place.message_encoding, schema)
    return _DECODERS[key]


def navsatfix_rows(messages: list) -> pl.DataFrame:
    rows = [
        {
            "t": message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec,
            "latitude_deg": message.latitude,
            "longitude_deg": message.longitude,
            "height_m": None if message.altitude != message.altitude else message.altitude,
            "fix": FIX[message.status.status],
            **_covariance(message.position_covariance, message.position_covariance_type),
        }
        for message in messages
    ]
    return _frame(rows)


def location_fix_rows(messages: list) -> pl.DataFrame:
    rows = [
        {
            "t": message.timestamp.seconds * SECOND_NS + message.timestamp.nanos,
            "latitude_deg": message.latitude,
            "longitude_deg": message.longitude,
            "height_m": message.altitude,
            "fix": "autonomous",
            **_covariance(message.position_covariance, message.position_covariance_type),
        }
        for message in messages
    ]
    return _frame(rows)


def _covariance(values, kind: int) -> dict[str, float | None]:
    places = {"ee": 0, "en": 1, "eu": 2, "nn": 4, "nu": 5, "uu": 8}
    return {f"cov_{axes}_m2": values[place] if kind > 0 else None for axes, place in places.items()}


def _frame(rows: list[dict[str, object]]) -> pl.DataFrame:
    schema = {name: pl.Int64 if name == "t" else pl.String if name == "fix" else pl.Float64 for name in rows[0]}
    return pl.DataFrame(rows, schema=schema)


def compared(frame: pl.DataFrame, columns: list[str]) -> pl.DataFrame:
    """Our frame in the oracle's types."""
    time = pl.col("t").to_physical()
    others = [pl.col(name).cast(pl.String) if name == "fix" else pl.col(name) for name in columns if name != "t"]
    return frame.select(time, *others)


def with_payloads(content: bytes, topic: str, change: Callable[[bytes], bytes]) -> bytes:
    """The same log, payloads of one topic changed."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE, use_chunking=False)
    writer.start()
    topics = {}
    for entry in StreamReader(io.BytesIO(content)).records:
        kind = type(entry).__name__
        if kind == "Schema" and entry.id not in topics.get("schemas", set()):
            writer.register_schema(entry.name, entry.encoding, entry.data)
            topics.setdefault("schemas", set()).add(entry.id)
        elif kind == "Channel" and entry.id not in topics:
            topics[entry.id] = entry.topic
            writer.register_channel(entry.topic, entry.message_encoding, entry.schema_id)
        elif kind == "Message":
            data = change(entry.data) if topics[entry.channel_id] == topic else entry.data
            writer.add_message(entry.channel_id, entry.log_time, data, entry.publish_time)
    writer.finish()
    return stream.getvalue()
