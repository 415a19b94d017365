"""Messages of neighbouring chunks, found by their message indexes and proved record by record."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.ingest.mcap_block import MESSAGE_HEAD, MESSAGE_HEAD_SIZE, Block, Bytes, block_of, gathered, messages_of
from pipeline.ingest.mcap_records import HEAD, HEAD_SIZE, DamageError, Op
from schemas.arrays import Ints

OnRecord = Callable[[int, memoryview, int], None]
Index = tuple[int, memoryview]  # channel, pairs of log time and offset

_MESSAGE = int(Op.MESSAGE)


@dataclass(frozen=True)
class Placed:
    """A chunk's records at `base` of a block; `offset` is the chunk's place in the file."""

    base: int
    size: int
    offset: int
    indexes: Sequence[Index]

    @property
    def end(self) -> int:
        return self.base + self.size

    def filled(self) -> list[Index]:
        """Indexes with entries (recovered logs have empty ones)."""
        return [(channel, entries) for channel, entries in self.indexes if len(entries)]


@dataclass(frozen=True)
class Named:
    """Records that indexes name."""

    starts: Ints
    lengths: Ints
    ends: Ints
    heads: npt.NDArray[Any]


def messages_in(data: Bytes, chunks: Sequence[Placed], first_ordinal: int, on_record: OnRecord) -> Block:
    """All messages of the chunks; other records go to `on_record`.

    Taken from the message indexes where there are any, and proved: the records tile each chunk exactly.
    What no index names is walked record by record.
    """
    named = {channel: _named(data, channel, parts) for channel, parts in _by_channel(chunks).items()}
    others = _between(data, chunks, list(named.values()), on_record)

    def locate(place: int) -> int:
        return _chunk_at(chunks, place).offset

    if len(others):
        _check_unindexed(data, others, chunks)
        starts = np.concatenate([others, *(part.starts for part in named.values())])
        return block_of(data, np.sort(starts), locate, first_ordinal)
    return {
        channel: messages_of(data, part.starts, part.lengths, part.heads, locate, first_ordinal)
        for channel, part in ((channel, _in_order(part)) for channel, part in named.items())
    }


def _chunk_at(chunks: Sequence[Placed], place: int) -> Placed:
    return chunks[bisect_right([chunk.base for chunk in chunks], place) - 1]


def _by_channel(chunks: Sequence[Placed]) -> dict[int, list[tuple[Placed, memoryview]]]:
    found: dict[int, list[tuple[Placed, memoryview]]] = {}
    for chunk in chunks:
        for channel, entries in chunk.filled():
            if chunk.size < MESSAGE_HEAD_SIZE:
                raise DamageError(chunk.offset, "a message index points outside its chunk")
            parts = found.setdefault(channel, [])
            if parts and parts[-1][0] is chunk:
                raise DamageError(chunk.offset, "a chunk has two message indexes for one channel")
            parts.append((chunk, entries))
    return found


def _named(data: Bytes, channel: int, parts: Sequence[tuple[Placed, memoryview]]) -> Named:
    """The records that the indexes of a channel name, held against what stands there."""
    counts = np.array([len(entries) for _, entries in parts]) // 16
    bases, sizes = np.array([(chunk.base, chunk.size) for chunk, _ in parts]).T
    pairs = np.frombuffer(b"".join(entries for _, entries in parts), dtype="<i8").reshape(-1, 2)
    log_times, offsets = pairs[:, 0], pairs[:, 1]

    def check(wrong: npt.NDArray[np.bool_], kind: str) -> None:
        if wrong.any():
            place = int(counts.cumsum().searchsorted(wrong.argmax(), "right"))
            raise DamageError(parts[place][0].offset, kind)

    room = np.repeat(sizes - MESSAGE_HEAD_SIZE, counts)
    check(_beyond(offsets, room), "a message index points outside its chunk")
    starts = offsets + np.repeat(bases, counts)
    heads = gathered(data, starts, MESSAGE_HEAD)
    differs = (heads["opcode"] != _MESSAGE) | (heads["channel"] != channel) | (heads["log_time"] != log_times)
    check(differs, "a message index disagrees with its chunk")
    lengths = heads["length"].astype(np.int64)
    room -= offsets
    room += MESSAGE_HEAD_SIZE - HEAD_SIZE
    check(_beyond(lengths, room), "a record runs past the end of its chunk")
    ends = starts + lengths
    ends += HEAD_SIZE
    return Named(starts, lengths, ends, heads)


def _beyond(values: Ints, limits: Ints) -> npt.NDArray[np.bool_]:
    """Whether these unsigned numbers, held as signed ones, are above their limits."""
    beyond: npt.NDArray[np.bool_] = values.view(np.uint64) > limits.view(np.uint64)
    return beyond


def _between(data: Bytes, chunks: Sequence[Placed], named: Sequence[Named], on_record: OnRecord) -> Ints:
    """Messages that no index names; proves that all records together tile the chunks exactly.

    Records that follow each other without gap: sorted, each end but the last is the next start.
    """
    # Stable, for it merges what is sorted already, as each channel is.
    starts = np.concatenate([*(part.starts for part in named), [len(data)]])
    ends = np.concatenate([[0], *(part.ends for part in named)])
    starts.sort(kind="stable")
    ends.sort(kind="stable")
    apart = np.flatnonzero(starts != ends)
    overlaps = apart[starts[apart] < ends[apart]]
    if len(overlaps):
        place = int(starts[overlaps[0]])
        kind = "records of a chunk overlap, or its message index names one twice"
        raise DamageError(_chunk_at(chunks, place).offset, kind)
    found: list[int] = []
    for gap in apart.tolist():
        found += _walk_gap(data, chunks, int(ends[gap]), int(starts[gap]), on_record)
    return np.array(found, dtype=np.int64)


def _walk_gap(data: Bytes, chunks: Sequence[Placed], start: int, end: int, on_record: OnRecord) -> list[int]:
    """Walk a gap, chunk by chunk: no record reaches into the next."""
    found: list[int] = []
    while start < end:
        chunk = _chunk_at(chunks, start)
        stop = min(end, chunk.end)
        found += _walk(data, start, stop, chunk.offset, on_record)
        start = stop
    return found


def _walk(data: Bytes, start: int, end: int, offset: int, on_record: OnRecord) -> list[int]:
    """Record by record from `start` to exactly `end`; the offsets of messages."""
    unpack, messages, view = HEAD.unpack_from, [], memoryview(data.data)
    room = end - HEAD_SIZE
    while start < end:
        if start > room:
            raise DamageError(offset, "a record is cut off by the end of its chunk")
        opcode, length = unpack(view, start)
        following = start + HEAD_SIZE + length
        if following > end:
            raise DamageError(offset, "a record runs past the end of its chunk")
        if opcode == _MESSAGE:
            messages.append(start)
        else:
            on_record(opcode, view[start + HEAD_SIZE : following], offset)
        start = following
    return messages


def _check_unindexed(data: Bytes, starts: Ints, chunks: Sequence[Placed]) -> None:
    """A channel's index is whole or absent: part of one would make a reader that trusts it lose messages."""
    for chunk in chunks:
        mine = starts[(starts >= chunk.base) & (starts < chunk.end)]
        if not len(mine):
            continue
        if mine.max() > len(data) - MESSAGE_HEAD_SIZE:
            raise DamageError(chunk.offset, "a message is shorter than its header")
        indexed = [channel for channel, _ in chunk.filled()]
        if np.isin(gathered(data, mine, MESSAGE_HEAD)["channel"], indexed).any():
            raise DamageError(chunk.offset, "a message index lacks messages of its chunk")


def _in_order(part: Named) -> Named:
    """By place in the file (an index is sorted by log time)."""
    if (part.starts[1:] > part.starts[:-1]).all():
        return part
    order = np.argsort(part.starts)
    return Named(part.starts[order], part.lengths[order], part.ends[order], part.heads[order])
