"""Runs as MCAP files, in this project's own schemas or the common ones of each encoding."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import IO, Literal

import polars as pl

from pipeline.ingest import payloads
from pipeline.ingest.proto_schemas import LOCATION_FIX, descriptor_set
from pipeline.ingest.recipes import OWN_SCHEMAS
from pipeline.ingest.ros2_text import DEFINITIONS
from schemas.errors import OutputError
from schemas.run import STREAMS, RunLog, Stream

Encoding = Literal["json", "protobuf", "cdr"]
Compression = Literal["zstd", "lz4", "none"]
OdometerMessage = Literal["geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"]

_FRAME_ID = "gnss"
_NAVSATFIX = "sensor_msgs/msg/NavSatFix"


@dataclass(frozen=True)
class Topic:
    """One channel to write: its schema and one payload per row of the frame."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    times_ns: list[int]
    messages: Iterator[bytes]


def write_mcap(
    run: RunLog,
    path: Path | IO[bytes],
    encoding: Encoding = "json",
    compression: Compression = "zstd",
    chunk_size: int | None = 1024 * 1024,
    odometer_message: OdometerMessage = "geometry_msgs/msg/TwistStamped",
    checksums: bool = True,
) -> tuple[str, ...]:
    """Write a run; returns what the chosen messages cannot hold, such as `gnss.hpl_m`.

    `json` writes this project's own schemas and keeps everything. `protobuf` writes GNSS as
    foxglove.LocationFix and the rest in own messages; `cdr` writes NavSatFix and `odometer_message`,
    the rest as JSON. `chunk_size` none writes an unchunked file. The same run gives the same bytes.
    """
    from mcap.writer import CompressionType, Writer

    losses: list[str] = []
    topics = [topic for stream in STREAMS for topic in _topics(run, stream, encoding, odometer_message, losses)]
    kind = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
    try:
        with path.open("wb") if isinstance(path, Path) else nullcontext(path) as stream:
            writer = Writer(
                stream,
                compression=kind[compression],
                chunk_size=chunk_size or 1024 * 1024,
                use_chunking=chunk_size is not None,
                enable_crcs=checksums,
            )
            writer.start(profile="ros2" if encoding == "cdr" else "", library="balise")
            _write(writer, topics)
            writer.finish()  # type: ignore[no-untyped-call]
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", place=str(path)) from None
    return tuple(losses)


def _write(writer: object, topics: list[Topic]) -> None:
    """All messages, merged by time; disorder inside a stream stays as it is."""
    ids = []
    for topic in topics:
        schema_id = writer.register_schema(topic.schema_name, topic.schema_encoding, topic.schema)  # type: ignore[attr-defined]
        ids.append(writer.register_channel(topic.topic, topic.encoding, schema_id))  # type: ignore[attr-defined]
    # The running maximum orders streams among each other and leaves each stream's own order alone.
    ordered = heapq.merge(
        *(
            [(t_ns, number, row) for row, t_ns in enumerate(accumulate(topic.times_ns, max))]
            for number, topic in enumerate(topics)
        )
    )
    for _, number, row in ordered:
        t_ns = topics[number].times_ns[row]
        writer.add_message(  # type: ignore[attr-defined]
            channel_id=ids[number],
            log_time=t_ns,
            publish_time=t_ns,
            sequence=row,
            data=next(topics[number].messages),
        )


def _topics(
    run: RunLog, stream: Stream, encoding: Encoding, odometer_message: OdometerMessage, losses: list[str]
) -> list[Topic]:
    frame = run.stream(stream)
    if frame is None:
        return []
    if stream == "gnss" and encoding != "json":
        return _gnss_topics(frame, encoding, losses)
    if encoding == "protobuf":
        name = OWN_SCHEMAS[stream]
        messages = payloads.own_protobuf_payloads(frame, name)
        return [_topic(f"/{stream}", "protobuf", name, descriptor_set(name), frame, messages)]
    if encoding == "cdr" and stream == "odometer" and frame["speed_mps"].null_count() == 0:
        return [_odometer_topic(frame, odometer_message, losses)]
    messages = payloads.json_payloads(frame)
    schema = payloads.json_schema(stream)
    return [_topic(f"/{stream}", "json", OWN_SCHEMAS[stream], schema, frame, messages)]


def _gnss_topics(frame: pl.DataFrame, encoding: Encoding, losses: list[str]) -> list[Topic]:
    """One topic per solution, for these messages do not name theirs."""
    losses += _lost("gnss", frame, payloads.GNSS_IN_STANDARD)
    names = frame["solution"].unique(maintain_order=True).to_list()
    parts = [(name, frame.filter(pl.col("solution") == name)) for name in names]
    return [_gnss_topic("/gnss" if len(parts) == 1 else f"/{name}", part, encoding, losses) for name, part in parts]


def _gnss_topic(topic: str, frame: pl.DataFrame, encoding: Encoding, losses: list[str]) -> Topic:
    if encoding == "cdr":
        if frame["fix"].is_in(["rtk_float", "rtk_fixed", "estimated"]).any():
            losses.append("gnss.fix")
        messages = payloads.navsatfix_payloads(frame, _FRAME_ID)
        return _topic(topic, "cdr", _NAVSATFIX, DEFINITIONS[_NAVSATFIX].encode(), frame, messages)
    located = frame.filter(pl.col("latitude_deg").is_not_null() & pl.col("longitude_deg").is_not_null())
    if located.height < frame.height:
        losses.append("gnss rows without position")
    if (located["fix"] != "autonomous").any():
        losses.append("gnss.fix")
    if located["height_m"].null_count():
        losses.append("gnss.height_m")
    messages = payloads.location_fix_payloads(located, _FRAME_ID)
    return _topic(topic, "protobuf", LOCATION_FIX, descriptor_set(LOCATION_FIX), located, messages)


def _odometer_topic(frame: pl.DataFrame, message: OdometerMessage, losses: list[str]) -> Topic:
    losses += _lost("odometer", frame, {"t", "speed_mps"})
    make = payloads.twist_payloads if message.endswith("TwistStamped") else payloads.odometry_payloads
    return _topic("/odometer", "cdr", message, DEFINITIONS[message].encode(), frame, make(frame, "odometer"))


def _lost(stream: Stream, frame: pl.DataFrame, kept: set[str]) -> list[str]:
    return [
        f"{stream}.{name}" for name in frame.columns if name not in kept and frame[name].null_count() < frame.height
    ]


_SCHEMA_ENCODINGS = {"json": "jsonschema", "protobuf": "protobuf", "cdr": "ros2msg"}


def _topic(
    topic: str, encoding: str, name: str, schema: bytes, frame: pl.DataFrame, messages: Iterator[bytes]
) -> Topic:
    times = frame.to_series(0).to_physical().to_list()
    return Topic(topic, encoding, name, _SCHEMA_ENCODINGS[encoding], schema, times, messages)
