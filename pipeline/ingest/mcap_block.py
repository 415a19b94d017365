"""Blocks of records (a chunk, or a stretch of a log without chunks) and the messages in them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from pipeline.ingest.mcap_records import HEAD, HEAD_SIZE, ChunkRecord, Damage, Op

Ints = npt.NDArray[np.int64]
Bytes = npt.NDArray[np.uint8]

# A message record: opcode, length, channel, sequence, log time, publish time, then the payload.
MESSAGE_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "log_time", "publish_time"],
        "formats": ["u1", "<u8", "<u2", "<i8", "<i8"],
        "offsets": [0, 1, 9, 15, 23],
        "itemsize": 31,
    }
)
MESSAGE_HEAD_SIZE = MESSAGE_HEAD.itemsize
_FIXED_FIELDS = MESSAGE_HEAD_SIZE - HEAD_SIZE
_INDEX_ENTRY = np.dtype([("log_time", "<i8"), ("offset", "<u8")])

OnRecord = Callable[[int, memoryview, int], None]


@dataclass(frozen=True)
class Block:
    """Messages of a block in order of the file: one entry per message, payloads inside `data`."""

    data: Bytes
    channel: npt.NDArray[np.uint16]
    start: Ints
    length: Ints
    log_time: Ints
    publish_time: Ints
    first_ordinal: int


def gathered(data: Bytes, starts: Ints, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Values of `dtype` that stand at arbitrary byte offsets; the offsets must have been checked."""
    kind = np.dtype(dtype)
    every_offset = np.ndarray((len(data) - kind.itemsize + 1,), kind, data.data, strides=(1,))
    return every_offset[starts]


def decompressed(chunk: ChunkRecord, limit: int) -> Bytes:
    """The records of a chunk, at most `limit` bytes, of exactly the declared size and checksum."""
    if chunk.size > limit:
        raise Damage(
            chunk.offset,
            f"a chunk declares {chunk.size} bytes, over the limit of {limit} ([ingest] chunk_limit_mib)",
        )
    records = _decompress(chunk)
    if len(records) != chunk.size:
        raise Damage(chunk.offset, f"a chunk holds {len(records)} bytes but declares {chunk.size}")
    if chunk.crc and zlib.crc32(records) != chunk.crc:
        raise Damage(chunk.offset, "the checksum of a chunk does not match its content")
    return np.frombuffer(records, dtype=np.uint8)


def _decompress(chunk: ChunkRecord) -> Any:
    if chunk.compression == "":
        return chunk.records
    if chunk.compression not in ("zstd", "lz4"):
        raise Damage(chunk.offset, f"a chunk has the unknown compression {chunk.compression!r}")
    if chunk.size == 0:
        return b""
    try:
        if chunk.compression == "zstd":
            return pa.decompress(chunk.records, chunk.size, codec="zstd")
        return _lz4(chunk)
    except (pa.ArrowException, OSError, RuntimeError, ValueError) as error:
        raise Damage(chunk.offset, f"a chunk cannot be decompressed ({error})") from None


def _lz4(chunk: ChunkRecord) -> Any:
    """LZ4 as a stream: at once it would not say when a frame ends short of the declared size."""
    stream = pa.CompressedInputStream(pa.BufferReader(chunk.records), "lz4")
    records = stream.read_buffer(chunk.size)
    if stream.read(1):
        raise ValueError("more than the declared size")
    return records


def message_offsets(
    data: Bytes, indexes: Sequence[tuple[int, memoryview]], offset: int, on_record: OnRecord
) -> Ints:
    """Offsets of all message records of a chunk, in order; other records go to `on_record`.

    Taken from the chunk's message indexes where it has them, and proved: the records tile the chunk
    exactly. Without indexes, or with empty ones, the chunk is walked record by record.
    """
    filled = [(channel, entries) for channel, entries in indexes if len(entries)]
    if not filled:
        return np.array(_walk(data, 0, len(data), offset, on_record), dtype=np.int64)
    return _indexed(data, filled, offset, on_record)


def _walk(data: Bytes, start: int, end: int, offset: int, on_record: OnRecord) -> list[int]:
    """Record by record from `start` to exactly `end`."""
    unpack, messages, view = HEAD.unpack_from, [], memoryview(data.data)
    message, room = int(Op.MESSAGE), end - HEAD_SIZE
    while start < end:
        if start > room:
            raise Damage(offset, "a record is cut off by the end of its chunk")
        opcode, length = unpack(view, start)
        following = start + HEAD_SIZE + length
        if following > end:
            raise Damage(offset, "a record runs past the end of its chunk")
        if opcode == message:
            messages.append(start)
        else:
            on_record(opcode, view[start + HEAD_SIZE : following], offset)
        start = following
    return messages


def _indexed(
    data: Bytes, indexes: Sequence[tuple[int, memoryview]], offset: int, on_record: OnRecord
) -> Ints:
    entries = np.concatenate([np.frombuffer(entries, _INDEX_ENTRY) for _, entries in indexes])
    channels = np.repeat(
        np.array([channel for channel, _ in indexes], dtype=np.uint16),
        [len(entries) // 16 for _, entries in indexes],
    )
    if entries["offset"].max() > max(len(data) - MESSAGE_HEAD_SIZE, 0) or len(data) < MESSAGE_HEAD_SIZE:
        raise Damage(offset, "a message index points outside its chunk")
    order = np.argsort(entries["offset"], kind="stable")
    starts = entries["offset"][order].astype(np.int64)
    heads = gathered(data, starts, MESSAGE_HEAD)
    agrees = (heads["opcode"] == Op.MESSAGE) & (heads["channel"] == channels[order])
    if not (agrees & (heads["log_time"] == entries["log_time"][order])).all():
        raise Damage(offset, "a message index disagrees with its chunk")
    if heads["length"].max() > len(data):
        raise Damage(offset, "a record runs past the end of its chunk")
    ends = starts + HEAD_SIZE + heads["length"].astype(np.int64)
    return _tiled(data, starts, ends, {channel for channel, _ in indexes}, offset, on_record)


def _tiled(
    data: Bytes, starts: Ints, ends: Ints, indexed: set[int], offset: int, on_record: OnRecord
) -> Ints:
    """All offsets, once what lies between the indexed messages is walked and nothing overlaps."""
    gap_starts = np.concatenate([[0], ends])
    gap_ends = np.concatenate([starts, [len(data)]])
    if (gap_starts > gap_ends).any():
        raise Damage(offset, "records of a chunk overlap, or its message index names one twice")
    found = [
        start
        for gap in np.flatnonzero(gap_starts < gap_ends)
        for start in _walk(data, int(gap_starts[gap]), int(gap_ends[gap]), offset, on_record)
    ]
    if not found:
        return starts
    extra = np.array(found, dtype=np.int64)
    _check_unindexed(data, extra, indexed, offset)
    return np.sort(np.concatenate([starts, extra]))


def _check_unindexed(data: Bytes, starts: Ints, indexed: set[int], offset: int) -> None:
    """A channel's index is whole or absent: part of one would make a reader that trusts it lose messages."""
    if starts.max() > len(data) - MESSAGE_HEAD_SIZE:
        raise Damage(offset, "a message is shorter than its header")
    if np.isin(gathered(data, starts, MESSAGE_HEAD)["channel"], list(indexed)).any():
        raise Damage(offset, "a message index lacks messages of its chunk")


def block_of(data: Bytes, starts: Ints, offset: int, first_ordinal: int) -> Block:
    """The messages at these record offsets, their lengths checked against the header."""
    if len(starts) and (starts.max() > len(data) - MESSAGE_HEAD_SIZE):
        raise Damage(offset, "a message is shorter than its header")
    heads = gathered(data, starts, MESSAGE_HEAD) if len(starts) else np.zeros(0, MESSAGE_HEAD)
    lengths = heads["length"].astype(np.int64)
    if len(starts) and lengths.min() < _FIXED_FIELDS:
        raise Damage(offset, "a message is shorter than its header")
    if len(starts) and (heads["log_time"].min() < 0 or heads["publish_time"].min() < 0):
        raise Damage(offset, "a time of a message is beyond the year 2262")
    return Block(
        data=data,
        channel=np.ascontiguousarray(heads["channel"]),
        start=starts + MESSAGE_HEAD_SIZE,
        length=lengths - _FIXED_FIELDS,
        log_time=np.ascontiguousarray(heads["log_time"]),
        publish_time=np.ascontiguousarray(heads["publish_time"]),
        first_ordinal=first_ordinal,
    )
