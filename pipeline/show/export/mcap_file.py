"""A run with its results as MCAP for Foxglove, Lichtblick and Rerun."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import IO, Literal

import polars as pl

from pipeline.show.export.events import hazard_entries, passage_entries
from pipeline.show.export.gis import balises_geojson, track_geojson
from pipeline.show.export.messages import Encoding, Topic, geojson_topic, log_topic, rows_topic
from pipeline.show.export.position_messages import location_fix_topic, navsatfix_topic
from pipeline.show.export.positions import as_gnss, positions_of
from pipeline.storage import whole_file
from pipeline.storage.described import PREFIX
from schemas.monitors import MONITORS
from schemas.run import RunLog, RunTables, Site

PositionMessage = Literal["foxglove", "ros"]
Compression = Literal["zstd", "lz4", "none"]

_FRAME = "wgs84"
_LDS = (
    "t", "netelement_id", "measure_m", "path_m", "odometer_m", "speed_mps", "cross_track_m", "vertical_m", "on_track",
    "path_probability", "confidence_m", "error_along_m", "error_low_m", "error_high_m", "judgement", "error_cross_m",
    "error_up_m", "alarm", "lds_mode", "lds_state", "tvb", "in_use", "lrvb_id", "distance_from_lrvb_m",
    "doubt_over_m", "doubt_under_m", "exposure_s",
)  # fmt: skip


def run_topics(
    tables: RunTables, site: Site | None, log: RunLog | None, positions: PositionMessage
) -> tuple[list[Topic], list[str]]:
    """All topics of a run, and what could not be written for want of the site or the log."""
    topics: list[Topic] = []
    missing = [] if site is not None else ["matched and true positions, track and balises (no site given)"]
    missing += [] if log is not None else ["raw positions (no log given)"]
    # Readers of ROS 2 bags refuse a bag that holds anything else.
    encoding: Encoding = "cdr" if positions == "ros" else "protobuf"
    solutions = tables.epochs["solution"].unique(maintain_order=True).to_list()
    if site is not None and tables.epochs.height:
        t0_ns = int(tables.epochs["t"].to_physical().min())  # type: ignore[arg-type]
        topics.append(geojson_topic("/site/track", t0_ns, track_geojson(site), encoding))
        topics.append(geojson_topic("/site/balises", t0_ns, balises_geojson(site), encoding))
    for solution in solutions:
        topics += _position_topics(solution, tables, site, log, positions)
        topics += _result_topics(solution, tables, encoding)
    # Viewers play messages in the order in which they stand: no log time goes back.
    return [replace(topic, times_ns=list(accumulate(topic.times_ns, max))) for topic in topics], missing


def write_topics(
    topics: list[Topic],
    path: Path | IO[bytes],
    profile: str,
    compression: Compression = "zstd",
    chunk_size: int | None = 1024 * 1024,
    checksums: bool = True,
) -> None:
    """Write topics merged by time, disorder inside a topic as it is; the same topics give the same bytes.

    `chunk_size` in bytes, none for a file without chunks. Raises `OutputError`.
    """
    from mcap.writer import CompressionType, Writer

    kinds = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
    with whole_file(path) if isinstance(path, Path) else nullcontext(path) as stream:
        writer = Writer(
            stream,
            compression=kinds[compression],
            chunk_size=chunk_size or 1024 * 1024,
            use_chunking=chunk_size is not None,
            enable_crcs=checksums,
        )
        writer.start(profile=profile, library="balise")
        channels = [
            writer.register_channel(
                topic.topic,
                topic.encoding,
                writer.register_schema(topic.schema_name, topic.schema_encoding, topic.schema),
                {f"{PREFIX}{key}": value for key, value in topic.notes.items()},
            )
            for topic in topics
        ]
        for _, number, row in heapq.merge(*(_instants(number, topic) for number, topic in enumerate(topics))):
            t_ns = topics[number].times_ns[row]
            data = next(topics[number].messages)
            writer.add_message(channels[number], log_time=t_ns, publish_time=t_ns, sequence=row, data=data)
        writer.finish()  # type: ignore[no-untyped-call]


def _instants(number: int, topic: Topic) -> Iterator[tuple[int, int, int]]:
    """The running maximum orders topics among each other and leaves each topic's own order alone."""
    for row, t_ns in enumerate(accumulate(topic.times_ns, max)):
        yield t_ns, number, row


def _position_topics(
    solution: str, tables: RunTables, site: Site | None, log: RunLog | None, positions: PositionMessage
) -> list[Topic]:
    topics = []
    if log is not None:
        raw = log.gnss.filter(pl.col("solution") == solution)
        topics.append(_position_topic(f"/{solution}/raw", raw, positions))
    if site is not None:
        places = positions_of(tables.epochs.filter(pl.col("solution") == solution), site)
        for name in ("gnss", "matched", "truth"):
            topics.append(_position_topic(f"/{solution}/{name}", as_gnss(getattr(places, name)), positions))
    return topics


def _result_topics(solution: str, tables: RunTables, encoding: Encoding) -> list[Topic]:
    epochs, hazards, passages = (
        frame.filter(pl.col("solution") == solution) for frame in (tables.epochs, tables.hazards, tables.passages)
    )
    return [
        rows_topic(f"/{solution}/lds", "balise.Lds", epochs.select(_LDS), encoding),
        rows_topic(f"/{solution}/monitors", "balise.Monitors", _monitors(epochs), encoding),
        log_topic(f"/{solution}/hazards", hazard_entries(hazards), encoding),
        log_topic(f"/{solution}/passages", passage_entries(passages), encoding),
    ]


def _monitors(epochs: pl.DataFrame) -> pl.DataFrame:
    """Values, thresholds and states, and the ratio that viewers draw: beyond ±1 the monitor fails."""
    columns: list[pl.Expr] = [pl.col("t")]
    for name in MONITORS:
        value = pl.col(f"{name}_value")
        threshold = pl.col(f"{name}_threshold")
        ratio = pl.when(threshold > 0.0).then(value / threshold).alias(f"{name}_ratio")
        columns += [value, threshold, ratio, pl.col(f"{name}_state").cast(pl.String)]
    return epochs.select(columns)


def _position_topic(topic: str, frame: pl.DataFrame, positions: PositionMessage) -> Topic:
    known = frame.filter(pl.col("latitude_deg").is_not_null() & pl.col("longitude_deg").is_not_null())
    make = navsatfix_topic if positions == "ros" else location_fix_topic
    return make(topic, known, _FRAME)
