"""Runs as MCAP logs, in this project's own schemas or the common ones of each encoding."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import IO, Literal

import polars as pl

from datasets.mcap_messages import json_topic, odometry_topic, twist_topic
from pipeline.read.ingest.correct import recorded_notes
from pipeline.read.ingest.recipes import OWN_SCHEMAS
from pipeline.show.export.mcap_file import Compression, write_topics
from pipeline.show.export.messages import Topic, rows_topic
from pipeline.show.export.position_messages import HELD, location_fix_topic, navsatfix_topic
from schemas.run import STREAMS, RunLog, Stream

Encoding = Literal["json", "protobuf", "cdr"]
OdometerMessage = Literal["geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry"]

_FRAME_ID = "gnss"


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
    losses: list[str] = []
    topics = [
        replace(topic, notes=recorded_notes(run, stream))
        for stream in STREAMS
        for topic in _stream_topics(run, stream, encoding, odometer_message, losses)
    ]
    write_topics(topics, path, "ros2" if encoding == "cdr" else "", compression, chunk_size, checksums)
    return tuple(losses)


def _stream_topics(
    run: RunLog, stream: Stream, encoding: Encoding, odometer_message: OdometerMessage, losses: list[str]
) -> list[Topic]:
    """Topics of one stream in this encoding; what it cannot hold is appended to `losses`."""
    frame = run.stream(stream)
    if frame is None:
        return []
    if stream == "gnss" and encoding != "json":
        return _gnss_topics(frame, encoding, losses)
    if encoding == "protobuf":
        return [rows_topic(f"/{stream}", OWN_SCHEMAS[stream], frame, "protobuf")]
    if encoding == "cdr" and stream == "odometer" and frame["speed_mps"].null_count() == 0:
        losses += _lost_columns("odometer", frame, {"t", "speed_mps"})
        make = twist_topic if odometer_message.endswith("TwistStamped") else odometry_topic
        return [make(frame)]
    return [json_topic(stream, frame)]


def _gnss_topics(frame: pl.DataFrame, encoding: Encoding, losses: list[str]) -> list[Topic]:
    """One topic per solution, for these messages do not name theirs."""
    losses += _lost_columns("gnss", frame, HELD)
    names = frame["solution"].unique(maintain_order=True).to_list()
    parts = [(name, frame.filter(pl.col("solution") == name)) for name in names]
    return [_gnss_topic("/gnss" if len(parts) == 1 else f"/{name}", part, encoding, losses) for name, part in parts]


def _gnss_topic(topic: str, frame: pl.DataFrame, encoding: Encoding, losses: list[str]) -> Topic:
    """A topic of positions; what its messages cannot hold is appended to `losses`."""
    if encoding == "cdr":
        if frame["fix"].is_in(["rtk_float", "rtk_fixed", "estimated"]).any():
            losses.append("gnss.fix")
        return navsatfix_topic(topic, frame, _FRAME_ID)
    located = frame.filter(pl.col("latitude_deg").is_not_null() & pl.col("longitude_deg").is_not_null())
    if located.height < frame.height:
        losses.append("gnss rows without position")
    if (located["fix"] != "autonomous").any():
        losses.append("gnss.fix")
    if located["height_m"].null_count():
        losses.append("gnss.height_m")
    return location_fix_topic(topic, located, _FRAME_ID)


def _lost_columns(stream: Stream, frame: pl.DataFrame, kept: set[str]) -> list[str]:
    """Columns with values that the messages do not keep."""
    return [
        f"{stream}.{name}" for name in frame.columns if name not in kept and frame[name].null_count() < frame.height
    ]
