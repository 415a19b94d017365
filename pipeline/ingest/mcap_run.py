"""A run as one MCAP file."""

from __future__ import annotations

import hashlib
import io

import polars as pl

from pipeline.ingest import files
from pipeline.ingest.assemble import ORDINAL, Decoded, stream_frames
from pipeline.ingest.breaches import Breach, refuse
from pipeline.ingest.generic import NotDecodable, decode_columns, decoder_for
from pipeline.ingest.inventory import fields_of
from pipeline.ingest.mcap_model import Channel, Schema
from pipeline.ingest.plan import Plan, Sample, plan_streams
from pipeline.ingest.stamps import LOG_TIME, PUBLISH_TIME
from schemas.config import IngestConfig
from schemas.errors import InputError
from schemas.run import IngestNotes, RunLog


def read_mcap(path: files.Address, config: IngestConfig) -> RunLog:
    """All streams of a log."""
    from mcap.records import Channel as ChannelRecord
    from mcap.records import Message as MessageRecord
    from mcap.records import Schema as SchemaRecord
    from mcap.stream_reader import StreamReader

    content = files.read_bytes(path)
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    messages: dict[int, list[tuple[int, int, int, bytes]]] = {}
    ordinal = 0
    try:
        for record in StreamReader(io.BytesIO(content), validate_crcs=True).records:
            if isinstance(record, SchemaRecord):
                schemas[record.id] = Schema(record.id, record.name, record.encoding, record.data)
            elif isinstance(record, ChannelRecord):
                channels[record.id] = Channel(
                    record.id, record.topic, record.message_encoding, schemas.get(record.schema_id), str(path)
                )
            elif isinstance(record, MessageRecord):
                ordinal += 1
                row = (ordinal, record.log_time, record.publish_time, record.data)
                messages.setdefault(record.channel_id, []).append(row)
    except Exception as error:
        raise InputError(f"is damaged: {type(error).__name__} {error}", place=str(path)) from None
    samples = [_sample(channels[id_], rows[0][3]) for id_, rows in messages.items()]
    plan = plan_streams(samples, config)
    decoded = [
        Decoded(source, _decoded(messages[source.channel.id], source.channel, dict(source.types)))
        for source in plan.sources
    ]
    breaches: list[Breach] = []
    frames = stream_frames(decoded, breaches)
    if "gnss" not in frames:
        breaches.append(_no_gnss(path, plan))
    refuse(breaches)
    skipped = tuple(f"{topic} ({schema})" for topic, schema in sorted(plan.left_over.items()))
    return RunLog(
        run_id=files.stem_of(path),
        notes=IngestNotes(skipped_topics=skipped),
        input_digest=hashlib.sha256(content).hexdigest(),
        **frames,
    )


def _sample(channel: Channel, payload: bytes) -> Sample:
    try:
        return Sample(channel, fields_of(decoder_for(channel)(payload)))
    except (NotDecodable, InputError):
        return Sample(channel, {})


def _decoded(
    rows: list[tuple[int, int, int, bytes]], channel: Channel, types: dict[str, pl.DataType]
) -> pl.DataFrame:
    ordinals, log_times, publish_times, payloads = zip(*rows, strict=True)
    frame = decode_columns(channel, payloads, types)
    return frame.with_columns(
        pl.Series(ORDINAL, ordinals, dtype=pl.Int64),
        pl.Series(LOG_TIME, log_times, dtype=pl.Int64),
        pl.Series(PUBLISH_TIME, publish_times, dtype=pl.Int64),
    )


def _no_gnss(path: files.Address, plan: Plan) -> Breach:
    return Breach(
        str(path),
        "holds no GNSS stream",
        found=", ".join(f"{topic} ({schema})" for topic, schema in sorted(plan.left_over.items())) or None,
        expected="a topic of a known schema, or one mapped by [ingest.gnss]",
        remedy="Map a topic in the configuration; `balise inspect` prints a starting one.",
    )
