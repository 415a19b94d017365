"""Messages of neighbouring chunks, found by their message indexes and proved record by record."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
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
    """A chunk's records at `base` of a block; `offset` is the chunk's place in the file, `indexes` have entries."""

    base: int
    size: int
    offset: int
    indexes: Sequence[Index]

    @property
    def end(self) -> int:
        return self.base + self.size


@dataclass(frozen=True)
class Named:
    """Records that indexes name, channel after channel; `bounds` are the rows from which and to which each goes."""

    starts: Ints
    lengths: Ints
    ends: Ints
    heads: npt.NDArray[Any]
    bounds: Sequence[tuple[int, int, int]]


@dataclass
class Allowance:
    """How many records more the chunks of a log may hold without a message index.

    Every record that a recorder writes takes bytes of the file even when it is compressed, for its time differs; so
    the work stays in proportion to the file, whatever a few bytes unpack to.
    """

    left: int


def messages_in(
    data: Bytes, chunks: Sequence[Placed], first_ordinal: int, on_record: OnRecord, allowance: Allowance
) -> Block:
    """All messages of the chunks; other records go to `on_record`.

    Taken from the message indexes where there are any, and proved: the records tile each chunk exactly.
    What no index names is walked record by record.
    """
    bases = [chunk.base for chunk in chunks]
    named = _named(data, chunks)
    others = _between(data, chunks, bases, named, on_record, allowance)

    def locate(place: int) -> int:
        return chunks[bisect_right(bases, place) - 1].offset

    if len(others):
        _check_unindexed(data, others, chunks, bases)
        return block_of(data, np.sort(np.concatenate([others, named.starts])), locate, first_ordinal)
    return {
        channel: messages_of(data, *_in_order(named, slice(first, end)), locate, first_ordinal)
        for channel, first, end in named.bounds
    }


def _parts(chunks: Sequence[Placed]) -> list[tuple[int, int, memoryview]]:
    """Channel, number of the chunk and entries of all indexes, in this order."""
    parts = [(channel, number, entries) for number, chunk in enumerate(chunks) for channel, entries in chunk.indexes]
    parts.sort(key=itemgetter(0, 1))
    for (channel, number, _), (other, next_number, _) in pairwise(parts):
        if (channel, number) == (other, next_number):
            raise DamageError(chunks[number].offset, "a chunk has two message indexes for one channel")
    return parts


def _named(data: Bytes, chunks: Sequence[Placed]) -> Named:
    """The records that the message indexes name, held against what stands there."""
    parts = _parts(chunks)
    numbers = np.array([number for _, number, _ in parts], dtype=np.int64)
    counts = np.array([len(entries) for _, _, entries in parts], dtype=np.int64) // 16
    ends_at = counts.cumsum()
    bases, sizes = np.array([(chunk.base, chunk.size) for chunk in chunks], dtype=np.int64).T[:, numbers]
    entries = np.frombuffer(b"".join(entries for _, _, entries in parts), dtype="<i8").reshape(-1, 2)
    log_times, offsets = entries[:, 0], entries[:, 1]

    def check(wrong: npt.NDArray[np.bool_], kind: str) -> None:
        if wrong.any():
            place = int(ends_at.searchsorted(wrong.argmax(), "right"))
            raise DamageError(chunks[numbers[place]].offset, kind)

    room = np.repeat(sizes - MESSAGE_HEAD_SIZE, counts)
    check((room < 0) | _beyond(offsets, room), "a message index points outside its chunk")
    starts = offsets + np.repeat(bases, counts)
    heads = gathered(data, starts, MESSAGE_HEAD) if parts else np.empty(0, dtype=MESSAGE_HEAD)
    channels = np.repeat(np.array([channel for channel, _, _ in parts], dtype=np.uint16), counts)
    differs = (heads["opcode"] != _MESSAGE) | (heads["channel"] != channels) | (heads["log_time"] != log_times)
    check(differs, "a message index disagrees with its chunk")
    lengths = heads["length"].astype(np.int64)
    room -= offsets
    room += MESSAGE_HEAD_SIZE - HEAD_SIZE
    check(_beyond(lengths, room), "a record runs past the end of its chunk")
    ends = starts + lengths
    ends += HEAD_SIZE
    return Named(starts, lengths, ends, heads, _bounds(parts, ends_at.tolist()))


def _bounds(parts: Sequence[tuple[int, int, memoryview]], ends_at: Sequence[int]) -> list[tuple[int, int, int]]:
    """Each channel with its first row and the row after its last."""
    last = dict(zip((channel for channel, _, _ in parts), ends_at, strict=True))
    return [(channel, first, end) for (channel, end), first in zip(last.items(), [0, *last.values()], strict=False)]


def _beyond(values: Ints, limits: Ints) -> npt.NDArray[np.bool_]:
    """Whether these unsigned numbers, held as signed ones, are above their limits."""
    beyond: npt.NDArray[np.bool_] = values.view(np.uint64) > limits.view(np.uint64)
    return beyond


def _between(
    data: Bytes,
    chunks: Sequence[Placed],
    bases: Sequence[int],
    named: Named,
    on_record: OnRecord,
    allowance: Allowance,
) -> Ints:
    """Messages that no index names; proves that all records together tile the chunks exactly.

    Records that follow each other without gap: sorted, each end but the last is the next start.
    """
    # Stable, for it merges what is sorted already, as each channel is.
    starts = np.sort(np.append(named.starts, len(data)), kind="stable")
    ends = np.sort(np.append(0, named.ends), kind="stable")
    apart = np.flatnonzero(starts != ends)
    overlaps = apart[starts[apart] < ends[apart]]
    if len(overlaps):
        place = chunks[bisect_right(bases, int(starts[overlaps[0]])) - 1]
        raise DamageError(place.offset, "records of a chunk overlap, or its message index names one twice")
    found = array("q")
    for gap in apart.tolist():
        start, end = int(ends[gap]), int(starts[gap])
        while start < end:  # chunk by chunk: no record reaches into the next
            chunk = chunks[bisect_right(bases, start) - 1]
            stop = min(end, chunk.end)
            _walk(data, start, stop, chunk.offset, found, on_record, allowance)
            start = stop
    return np.frombuffer(found, dtype=np.int64) if found else np.empty(0, dtype=np.int64)


def _walk(
    data: Bytes, start: int, end: int, offset: int, found: array[int], on_record: OnRecord, allowance: Allowance
) -> None:
    """Record by record from `start` to exactly `end`; the offsets of messages into `found`."""
    unpack, view = HEAD.unpack_from, memoryview(data.data)
    room, left = end - HEAD_SIZE, allowance.left
    while start < end:
        if start > room:
            raise DamageError(offset, "a record is cut off by the end of its chunk")
        opcode, length = unpack(view, start)
        following = start + HEAD_SIZE + length
        if following > end:
            raise DamageError(offset, "a record runs past the end of its chunk")
        left -= 1
        if left < 0:
            raise DamageError(offset, "a chunk unpacks to more records than the file has bytes")
        if opcode == _MESSAGE:
            found.append(start)
        else:
            on_record(opcode, view[start + HEAD_SIZE : following], offset)
        start = following
    allowance.left = left


def _check_unindexed(data: Bytes, starts: Ints, chunks: Sequence[Placed], bases: Sequence[int]) -> None:
    """A channel's index is whole or absent: part of one would make a reader that trusts it lose messages."""
    numbers = np.searchsorted(bases, starts, side="right") - 1
    if starts[-1] > len(data) - MESSAGE_HEAD_SIZE:
        raise DamageError(chunks[numbers[-1]].offset, "a message is shorter than its header")
    indexed = [number << 16 | channel for number, chunk in enumerate(chunks) for channel, _ in chunk.indexes]
    met = numbers << 16 | gathered(data, starts, MESSAGE_HEAD)["channel"]
    lacking = np.isin(met, indexed)
    if lacking.any():
        raise DamageError(chunks[numbers[lacking.argmax()]].offset, "a message index lacks messages of its chunk")


def _in_order(named: Named, rows: slice) -> tuple[Ints, Ints, npt.NDArray[Any]]:
    """Starts, lengths and heads of a channel by place in the file (an index is sorted by log time)."""
    starts, lengths, heads = named.starts[rows], named.lengths[rows], named.heads[rows]
    if (starts[1:] > starts[:-1]).all():
        return starts, lengths, heads
    order = np.argsort(starts)
    return starts[order], lengths[order], heads[order]
