"""Blocks of records (a chunk, or a stretch of a log without chunks) and the messages in them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from pipeline.ingest.mcap_records import HEAD, HEAD_SIZE, ChunkRecord, DamageError, Op

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
_MESSAGE = int(Op.MESSAGE)
_FIXED_FIELDS = MESSAGE_HEAD_SIZE - HEAD_SIZE
OnRecord = Callable[[int, memoryview, int], None]


@dataclass(frozen=True)
class Messages:
    """Messages of one channel in a block, in order of the file: where their payloads lie in `data`.

    `ordinal` orders messages of all channels of the log as they stand in the file.
    """

    data: Bytes
    start: Ints
    length: Ints
    ordinal: Ints
    heads: npt.NDArray[Any]  # of more messages than these, where `picked` tells which
    picked: Ints | None = None

    def __len__(self) -> int:
        return len(self.start)

    def times(self, name: str) -> Ints:
        """`log_time` or `publish_time` [ns]."""
        times: Ints = self.heads[name].astype(np.int64)
        if self.picked is not None:
            times = times[self.picked]
        if len(times) and times.min() < 0:
            raise DamageError(0, "a time of a message is beyond the year 2262")
        return times

    def payload(self, row: int) -> bytes:
        first = int(self.start[row])
        return self.data[first : first + int(self.length[row])].tobytes()

    def chosen(self, rows: npt.NDArray[Any]) -> Messages:
        """Some of them, by mask or number."""
        if rows.dtype == np.bool_:
            rows = np.flatnonzero(rows)
        picked = rows if self.picked is None else self.picked[rows]
        return Messages(self.data, self.start[rows], self.length[rows], self.ordinal[rows], self.heads, picked)


Block = dict[int, Messages]  # by channel


def gathered(data: Bytes, starts: Ints, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Values of `dtype` that stand at arbitrary byte offsets; the offsets must have been checked."""
    kind = np.dtype(dtype)
    return stretches_of(data, starts, kind.itemsize).reshape(-1).view(kind)


def stretches_of(data: Bytes, starts: Ints, width: int) -> Bytes:
    """`width` bytes from each of these offsets on, one row each."""
    # As plain bytes: numpy gathers structured values five times slower, field by field.
    every_offset = np.ndarray((len(data) - width + 1,), f"V{width}", data.data, strides=(1,))
    return every_offset[starts].view(np.uint8).reshape(-1, width)


def decompressed(chunk: ChunkRecord, limit: int) -> Bytes:
    """The records of a chunk, at most `limit` bytes, of exactly the declared size and checksum."""
    if chunk.size > limit:
        raise DamageError(
            chunk.offset,
            f"a chunk declares {chunk.size} bytes, over the limit of {limit} ([ingest] chunk_limit_mib)",
        )
    records = _decompress(chunk)
    if len(records) != chunk.size:
        raise DamageError(chunk.offset, f"a chunk holds {len(records)} bytes but declares {chunk.size}")
    if chunk.crc and zlib.crc32(records) != chunk.crc:
        raise DamageError(chunk.offset, "the checksum of a chunk does not match its content")
    return np.frombuffer(records, dtype=np.uint8)


def _decompress(chunk: ChunkRecord) -> Any:
    if chunk.compression == "":
        return chunk.records
    if chunk.compression not in ("zstd", "lz4"):
        raise DamageError(chunk.offset, f"a chunk has the unknown compression {chunk.compression!r}")
    if chunk.size == 0:
        return b""
    try:
        if chunk.compression == "zstd":
            return pa.decompress(chunk.records, chunk.size, codec="zstd")
        return _lz4(chunk)
    except (pa.ArrowException, OSError, RuntimeError, ValueError) as error:
        raise DamageError(chunk.offset, f"a chunk cannot be decompressed ({error})") from None


def _lz4(chunk: ChunkRecord) -> Any:
    """LZ4 as a stream: at once it would not say when a frame ends short of the declared size."""
    stream = pa.CompressedInputStream(pa.BufferReader(chunk.records), "lz4")
    records = stream.read_buffer(chunk.size)
    if stream.read(1):
        raise ValueError("more than the declared size")
    return records


def chunk_messages(
    data: Bytes,
    indexes: Sequence[tuple[int, memoryview]],
    offset: int,
    first_ordinal: int,
    on_record: OnRecord,
) -> Block:
    """All messages of a chunk; other records go to `on_record`.

    Taken from the chunk's message indexes where it has them, and proved: the records tile the chunk
    exactly. Without indexes, or with empty ones, the chunk is walked record by record.
    """
    filled = [(channel, entries) for channel, entries in indexes if len(entries)]
    if not filled:
        starts = np.array(_walk(data, 0, len(data), offset, on_record), dtype=np.int64)
        return block_of(data, starts, offset, first_ordinal)
    if len(data) < MESSAGE_HEAD_SIZE:
        raise DamageError(offset, "a message index points outside its chunk")
    named = [_indexed(data, channel, entries, offset) for channel, entries in filled]
    others = _between(data, [part[:2] for part in named], offset, on_record)
    if len(others):
        _check_unindexed(data, others, {channel for channel, _ in filled}, offset)
        starts = np.concatenate([others, *(start for start, _, _ in named)])
        return block_of(data, np.sort(starts), offset, first_ordinal)
    if len({channel for channel, _ in filled}) < len(filled):
        raise DamageError(offset, "a chunk has two message indexes for one channel")
    return {
        channel: _messages(data, *_in_order(start, heads), offset, first_ordinal)
        for (channel, _), (start, _, heads) in zip(filled, named, strict=True)
    }


def _walk(data: Bytes, start: int, end: int, offset: int, on_record: OnRecord) -> list[int]:
    """Record by record from `start` to exactly `end`; the offsets of messages."""
    unpack, messages, view = HEAD.unpack_from, [], memoryview(data.data)
    message, room = int(Op.MESSAGE), end - HEAD_SIZE
    while start < end:
        if start > room:
            raise DamageError(offset, "a record is cut off by the end of its chunk")
        opcode, length = unpack(view, start)
        following = start + HEAD_SIZE + length
        if following > end:
            raise DamageError(offset, "a record runs past the end of its chunk")
        if opcode == message:
            messages.append(start)
        else:
            on_record(opcode, view[start + HEAD_SIZE : following], offset)
        start = following
    return messages


def _indexed(data: Bytes, channel: int, entries: memoryview, offset: int) -> tuple[Ints, Ints, npt.NDArray[Any]]:
    """Starts, ends and heads of the messages that an index names, held against what stands there."""
    pairs = np.frombuffer(entries, dtype="<u8").reshape(-1, 2)
    if pairs[:, 1].max() > len(data) - MESSAGE_HEAD_SIZE:
        raise DamageError(offset, "a message index points outside its chunk")
    starts = pairs[:, 1].astype(np.int64)
    heads = gathered(data, starts, MESSAGE_HEAD)
    agrees = (heads["opcode"] == _MESSAGE) & (heads["channel"] == channel)
    agrees &= heads["log_time"] == pairs[:, 0].view(np.int64)
    if not agrees.all():
        raise DamageError(offset, "a message index disagrees with its chunk")
    lengths = heads["length"]
    if lengths.max() > len(data):
        raise DamageError(offset, "a record runs past the end of its chunk")
    return starts, starts + lengths.astype(np.int64) + HEAD_SIZE, heads


def _between(data: Bytes, named: Sequence[tuple[Ints, Ints]], offset: int, on_record: OnRecord) -> Ints:
    """Messages that no index names; proves that all records together tile the chunk exactly.

    Records that follow each other without gap: sorted, each end but the last is the next start.
    """
    # Stable, for it merges what is sorted already, as each channel is.
    starts = np.sort(np.concatenate([start for start, _ in named]), kind="stable")
    ends = np.sort(np.concatenate([end for _, end in named]), kind="stable")
    gaps = [(0, int(starts[0])), (int(ends[-1]), len(data))]
    if not np.array_equal(starts[1:], ends[:-1]):
        if (starts[1:] < ends[:-1]).any():
            raise DamageError(offset, "records of a chunk overlap, or its message index names one twice")
        inner = np.flatnonzero(starts[1:] > ends[:-1])
        gaps += [(int(ends[gap]), int(starts[gap + 1])) for gap in inner]
    if gaps[1][0] > len(data):
        raise DamageError(offset, "a record runs past the end of its chunk")
    found = [start for first, last in sorted(gaps) for start in _walk(data, first, last, offset, on_record)]
    return np.array(found, dtype=np.int64)


def _check_unindexed(data: Bytes, starts: Ints, indexed: set[int], offset: int) -> None:
    """A channel's index is whole or absent: part of one would make a reader that trusts it lose messages."""
    if starts.max() > len(data) - MESSAGE_HEAD_SIZE:
        raise DamageError(offset, "a message is shorter than its header")
    if np.isin(gathered(data, starts, MESSAGE_HEAD)["channel"], list(indexed)).any():
        raise DamageError(offset, "a message index lacks messages of its chunk")


def _in_order(starts: Ints, heads: npt.NDArray[Any]) -> tuple[Ints, npt.NDArray[Any]]:
    """By place in the file (an index is sorted by log time)."""
    if (starts[1:] > starts[:-1]).all():
        return starts, heads
    order = np.argsort(starts)
    return starts[order], heads[order]


def block_of(data: Bytes, starts: Ints, offset: int, first_ordinal: int) -> Block:
    """The messages at these record offsets, by channel."""
    if not len(starts):
        return {}
    if starts.max() > len(data) - MESSAGE_HEAD_SIZE:
        raise DamageError(offset, "a message is shorter than its header")
    heads = gathered(data, starts, MESSAGE_HEAD)
    channels = heads["channel"]
    found = np.flatnonzero(np.bincount(channels)).tolist()
    if len(found) == 1:
        return {found[0]: _messages(data, starts, heads, offset, first_ordinal)}
    return {
        channel: _messages(data, starts[mine], heads[mine], offset, first_ordinal)
        for channel in found
        for mine in (channels == channel,)
    }


def _messages(data: Bytes, starts: Ints, heads: npt.NDArray[Any], offset: int, first_ordinal: int) -> Messages:
    lengths = heads["length"].astype(np.int64) - _FIXED_FIELDS
    if lengths.min() < 0:
        raise DamageError(offset, "a message is shorter than its header")
    return Messages(data, starts + MESSAGE_HEAD_SIZE, lengths, starts + first_ordinal, heads)
