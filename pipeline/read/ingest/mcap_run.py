"""A run as one MCAP file."""

from __future__ import annotations

import hashlib
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Protocol

import numpy as np
import polars as pl

from pipeline.read.ingest.assemble import DecodedRows, stream_frames
from pipeline.read.ingest.conform import refuse
from pipeline.read.ingest.correct import read_corrections, read_damage, read_raw_logs
from pipeline.read.ingest.fields import fields_of
from pipeline.read.ingest.mcap_block import Block, Messages
from pipeline.read.ingest.mcap_records import Channel, DamageError
from pipeline.read.ingest.mcap_walk import McapWalk
from pipeline.read.ingest.plan import Sample, Source, is_candidate, settle_sources, solution_of, sources_of
from pipeline.read.ingest.reader import ORDINAL, SourceReader
from pipeline.storage import files
from pipeline.storage.address import Address, name_of, stem_of
from pipeline.storage.budget import most_unpacked
from schemas.arrays import times_ns
from schemas.config import IngestConfig, StreamCorrection
from schemas.errors import InputError
from schemas.frozen import frozen
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import IngestNotes, RunLog

_MIB = 1024 * 1024
LARGEST_MESSAGE = 4 * _MIB  # of messages that are decoded; pictures and point clouds are not
_DECODED_TOGETHER = 16 * _MIB
MOST_TOPICS = 256  # that may feed a stream: no train has as many receivers


class McapStreams:
    """Feeds the messages of a log to readers, which are chosen as channels appear."""

    def __init__(self, config: IngestConfig) -> None:
        self._config = config
        self.readers: dict[int, list[SourceReader]] = {}

    def add(self, block: Block, channels: Mapping[int, Channel]) -> None:
        """Hand the messages of a block to the readers of their channels. Raises `InputError` for one too large."""
        for channel_id, messages in block.items():
            readers = self.readers.get(channel_id)
            if readers is None:
                readers = self.readers[channel_id] = self._readers(messages, channels[channel_id])
            if readers:
                _check_sizes(messages, channels[channel_id])
            for reader in readers:
                for part in _pieces(messages):
                    reader.add(part)

    def decode(self) -> None:
        """What waits to be decoded."""
        for reader in chain.from_iterable(self.readers.values()):
            reader.decode()

    def _readers(self, messages: Messages, channel: Channel) -> list[SourceReader]:
        """The readers of a channel, chosen by its first messages; none where it feeds no stream."""
        if not is_candidate(channel, self._config):
            return []
        if sum(map(bool, self.readers.values())) >= MOST_TOPICS:
            raise InputError(
                f"holds more than {MOST_TOPICS} topics of positions, speeds or reads",
                place=channel.file,
                expected="the topics of one train",
                remedy="Select topics with [ingest] in the configuration, or remove the others from the log.",
            )
        _check_sizes(messages, channel)
        return [
            SourceReader(source) for source in sources_of(Sample(channel, fields_of(channel, messages)), self._config)
        ]


def _check_sizes(messages: Messages, channel: Channel) -> None:
    """Refuse messages of more than `LARGEST_MESSAGE` bytes."""
    if messages.longest > LARGEST_MESSAGE:
        raise InputError(
            f"has a message of {messages.longest} bytes",
            place=channel.place,
            expected=f"at most {LARGEST_MESSAGE} bytes in a topic that feeds a stream",
        )


def _pieces(messages: Messages) -> Iterator[Messages]:
    """The messages of an unusually large block in parts: decoding needs several times their size."""
    if messages.longest * len(messages) < _DECODED_TOGETHER:
        yield messages
        return
    cuts = np.flatnonzero(np.diff(messages.length.cumsum() // _DECODED_TOGETHER)) + 1
    yield from (messages.chosen(rows) for rows in np.split(np.arange(len(messages)), cuts))


@frozen
class _WalkedLog:
    """One file that was walked, and what its messages fed."""

    path: Address
    walk: McapWalk
    streams: McapStreams
    digest: str


def read_mcap(path: Address, config: IngestConfig, with_digest: bool = True) -> RunLog:
    """All streams of a log, read strictly from front to back in pieces."""
    return read_mcaps([path], config, with_digest)


def read_mcaps(
    paths: Sequence[Address],
    config: IngestConfig,
    with_digest: bool = False,
    partly: bool = False,
    observers: Sequence[BlockSink] = (),
) -> RunLog:
    """All streams of a log that a recorder split into several files, in order; the digest is of the first.

    A topic need not be in each of them. `partly`: the log is one of several of a run; it need not hold positions, nor
    all topics that are mapped. `observers`: by file, what else looks at its messages on the same walk.
    """
    logs: list[_WalkedLog] = []
    for number, path in enumerate(paths):
        streams = McapStreams(config)
        ordinal = logs[-1].walk.next_ordinal if logs else 0
        sink = _Sinks([streams, *observers[number : number + 1]])
        try:
            walk, digest = walk_log(path, config, sink, with_digest, ordinal)
        finally:
            streams.decode()  # of two errors that of the message that comes first, not of the damage behind it
        logs.append(_WalkedLog(path, walk, streams, digest))
    frames, held, slow_messages, left_over, damage = _frames(logs, config, partly)
    messages: Counter[str] = Counter()
    for log in logs:
        messages.update(log.walk.message_counts())
    return RunLog(
        run_id=stem_of(paths[0]),
        notes=IngestNotes(
            partial_until_ns=_partial_until_ns(logs, frames["gnss"]),
            damage="; ".join(dict.fromkeys([*_damages(logs), *damage])) or None,
            slow_path_messages=slow_messages,
            chunks_without_crc=sum(log.walk.without_crc for log in logs),
            skipped_topics=left_over,
            corrections=held,
            messages=dict(messages),
            raw_logs=_raw_logs(logs),
        ),
        input_digest=logs[0].digest,
        gnss=frames["gnss"],
    ).with_streams(**frames)


def _raw_logs(logs: Sequence[_WalkedLog]) -> tuple[tuple[str, int, str], ...]:
    """What the topics say that the run was converted from."""
    said = dict.fromkeys(channel.notes for log in logs for channel in log.walk.channels.values())
    return tuple(file for notes in said for file in read_raw_logs(dict(notes)))


def _damages(logs: Sequence[_WalkedLog]) -> list[str]:
    """What the files lack; of several each is named."""
    several = len(logs) > 1
    return [f"{name_of(log.path)}: {text}" if several else text for log in logs for text in log.walk.damages]


def _partial_until_ns(logs: Sequence[_WalkedLog], gnss: pl.DataFrame) -> int | None:
    """The last position of a log that is cut off; of one that goes on in another file, the last message before."""
    cut = [log for log in logs if log.walk.cut_at is not None]
    if not cut:
        return None
    if gnss.is_empty():
        return max((span_ns[1] for log in cut if (span_ns := log.walk.counts.span_ns) is not None), default=None)
    last_ns: int = times_ns(gnss).max().item()
    ends_ns = [span_ns[1] for log in cut if log is not logs[-1] and (span_ns := log.walk.counts.span_ns) is not None]
    return min(last_ns, *ends_ns) if ends_ns else last_ns


class BlockSink(Protocol):
    """Looks at the messages of a log."""

    def add(self, block: Block, channels: Mapping[int, Channel]) -> None: ...


class _Sinks:
    """Several that look at the same messages."""

    def __init__(self, sinks: Sequence[BlockSink]) -> None:
        self._sinks = sinks

    def add(self, block: Block, channels: Mapping[int, Channel]) -> None:
        """Show the messages of a block to each of them."""
        for sink in self._sinks:
            sink.add(block, channels)


def walk_log(
    path: Address, config: IngestConfig, streams: BlockSink, with_digest: bool = False, first_ordinal: int = 0
) -> tuple[McapWalk, str]:
    """Walk the whole log into `streams`; damage becomes one error that names file, byte and kind.

    `with_digest`: also the SHA-256 of the file, else an empty text.
    """
    try:
        with files.open_binary(path) as raw, io.BufferedReader(raw, _MIB) as stream:  # type: ignore[type-var]
            size = stream.seek(0, io.SEEK_END)
            chunk_limit = int(config.chunk_limit_mib * _MIB)
            unpacked = most_unpacked(size, config)
            walk = McapWalk(stream, size, str(path), chunk_limit, unpacked, first_ordinal)
            for block in walk.blocks():
                streams.add(block, walk.channels)
                del block  # the next chunk is unpacked into the same memory, which is in the processor's cache
            stream.seek(0)
            return walk, hashlib.file_digest(stream, "sha256").hexdigest() if with_digest else ""
    except DamageError as damage:
        raise InputError(
            str(damage), place=str(path), remedy="Record or copy the log again, or try `mcap recover`."
        ) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error}", place=str(path)) from None


def _frames(
    logs: Sequence[_WalkedLog], config: IngestConfig, partly: bool
) -> tuple[dict[str, pl.DataFrame], tuple[StreamCorrection, ...], int, tuple[str, ...], list[str]]:
    """Frames of all streams, corrections that they hold, messages decoded one by one, the topics that fed none, and
    what was lost when the log was written.
    """
    place = str(logs[0].path) if len(logs) == 1 else ", ".join(str(log.path) for log in logs)
    readers = [reader for log in logs for of_channel in log.streams.readers.values() for reader in of_channel]
    channels = [log.walk.channels[channel_id] for log in logs for channel_id in log.streams.readers]
    settled = settle_sources([reader.source for reader in readers], [c.topic for c in channels], config, place, partly)
    chosen = [reader for reader in readers if any(reader.source is source for source in settled)]
    decoded = [DecodedRows(r.source, solution_of(r.source, settled), r.frame(), [*r.frames]) for r in chosen]
    used = {source.channel.topic for source in settled}
    unused = {channel.topic: channel.schema_name for channel in channels if channel.topic not in used}
    left_over = tuple(f"{topic} ({schema})" if schema else topic for topic, schema in sorted(unused.items()))
    breaches: list[InputError] = []
    remarks: list[str] = []
    frames = stream_frames(decoded if len(logs) == 1 else _merge_files(decoded), breaches, config, remarks)
    if "gnss" not in frames and not (partly and frames):
        breaches.append(_no_gnss(logs, left_over))
    refuse(breaches)
    if "gnss" not in frames:
        frames["gnss"] = STREAM_SCHEMAS["gnss"].create_empty()
    slow_messages = sum(reader.slow_messages for reader in chosen)
    held = _held([*settled], place)
    damage = [text for source in settled if (text := read_damage(dict(source.channel.notes)))]
    return frames, held, slow_messages, (*left_over, *remarks), damage


def _merge_files(decoded: Sequence[DecodedRows]) -> list[DecodedRows]:
    """The rows of one topic in several files as those of one source."""
    joined: dict[tuple[object, ...], DecodedRows] = {}
    for part in decoded:
        source = part.source
        key = (source.channel.topic, source.recipe.stream, id(source.mapping), *source.columns, *source.types)
        before = joined.get(key)
        if before is None:
            joined[key] = part
            continue
        frame = pl.concat([before.frame, part.frame]).sort(ORDINAL)
        joined[key] = replace(before, frame=frame, speed_frames=[*before.speed_frames, *part.speed_frames])
    return list(joined.values())


def _held(sources: Sequence[Source], place: str) -> tuple[StreamCorrection, ...]:
    """What the topics of each stream say of its corrections, all the same."""
    held: list[StreamCorrection] = []
    for stream in dict.fromkeys(source.recipe.stream for source in sources):
        said = {source.channel.notes: source.channel for source in sources if source.recipe.stream == stream}
        if len(said) > 1:
            topics = ", ".join(channel.topic for channel in said.values())
            raise InputError(f"topics of {stream} were corrected in different ways", place=place, found=topics)
        held += [found for notes in said for found in read_corrections(dict(notes), stream, place)]
    return tuple(held)


def _no_gnss(logs: Sequence[_WalkedLog], left_over: tuple[str, ...]) -> InputError:
    """The error for logs without a GNSS stream: cut off before any message, or with these topics left over."""
    place = ", ".join(str(log.path) for log in logs)
    walk = logs[0].walk
    if walk.cut_at is not None and not any(log.walk.counts.message_counts for log in logs):
        return InputError(
            f"is cut off at byte {walk.cut_at}, before any complete message",
            place=place,
            remedy="Record or copy the log again.",
        )
    return InputError(
        "holds no GNSS stream",
        place=place,
        found=", ".join(left_over[:40]) or "no messages",
        expected="a topic of a known schema, or one mapped by [ingest.gnss]",
        remedy="Map a topic in the configuration; `balise inspect` prints one to start from.",
    )
