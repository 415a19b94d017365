"""Blocks of records (chunks, or a stretch of a log without chunks) and the messages in them."""

from __future__ import annotations

from array import array
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from pipeline.read.ingest.mcap_records import HEAD, HEAD_SIZE, DamageError
from schemas.arrays import Bools, Ints
from schemas.frozen import frozen

Bytes = npt.NDArray[np.uint8]
OnRecord = Callable[[int, bytes, int], None]  # opcode, content, offset of its chunk in the file

# A message record: opcode, length, channel, sequence, log time, publish time, then the payload.
MESSAGE_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "log_time"],
        "formats": ["u1", "<i8", "<u2", "<i8"],
        "offsets": [0, 1, 9, 15],
        "itemsize": 31,
    }
)
_FIXED_FIELDS = MESSAGE_HEAD.itemsize - HEAD_SIZE


@frozen
class Records:
    """Records of neighbouring chunks; side by side only where somebody asks for them."""

    parts: Sequence[Bytes]

    @cached_property
    def whole(self) -> Bytes:
        """The bytes of all parts, one after the other; joined when first asked for."""
        return self.parts[0] if len(self.parts) == 1 else np.concatenate(self.parts)


class Heads(NamedTuple):
    """Of messages: their places in the order of the file, and times [ns]; those of publishing where they were asked
    for.
    """

    ordinal: Ints
    log_time: Ints
    publish_time: Ints | None

    def chosen(self, rows: Ints | slice) -> Heads:
        """Some of them."""
        publish_time = None if self.publish_time is None else self.publish_time[rows]
        return Heads(self.ordinal[rows], self.log_time[rows], publish_time)


def joined_heads(parts: Sequence[Heads]) -> Heads:
    """Those of one block after the other."""
    ordinals, log_times, publish_times = zip(*parts, strict=True)
    publish_time = None if publish_times[0] is None else np.concatenate(publish_times)
    return Heads(np.concatenate(ordinals), np.concatenate(log_times), publish_time)


@frozen
class Messages:
    """Messages of one channel in a block, in order of the file: where their payloads lie in the records of the block.

    Times are in nanoseconds; `before` is the size of all blocks before this one.
    """

    records: Records
    start: Ints
    length: Ints
    log_time: Ints
    before: int = 0

    def __len__(self) -> int:
        """Number of messages."""
        return len(self.start)

    @property
    def data(self) -> Bytes:
        """The records of the block side by side, in which the payloads lie."""
        return self.records.whole

    @cached_property
    def longest(self) -> int:
        """Of the payloads [bytes]."""
        return int(self.length.max())

    def heads(self, with_publish_time: bool = False) -> Heads:
        """The time of publishing is the last field before a payload."""
        publish_time = self.stretches(-8, 0).view("<i8")[:, 0] if with_publish_time else None
        return Heads(self.start + self.before, self.log_time, publish_time)

    def stretches(self, start: int, end: int) -> Bytes:
        """From one byte to another of each payload, one row each; the payloads must be that long."""
        if start < 0:
            return stretches_of(self.data, self.start + start, end - start)
        return stretches_of(self.data, self.start, end - start, start)

    def payload(self, row: int) -> bytes:
        """The payload of the message with this number in the block."""
        return self.data[self.start[row] :][: self.length[row]].tobytes()

    def chosen(self, rows: Ints | Bools | slice) -> Messages:
        """Some of them."""
        these = np.flatnonzero(rows) if isinstance(rows, np.ndarray) and rows.dtype == np.bool_ else rows
        return Messages(self.records, self.start[these], self.length[these], self.log_time[these], self.before)


Block = dict[int, Messages]  # by channel


def stretches_of(data: Bytes, starts: Ints, width: int, skip: int = 0) -> Bytes:
    """`width` bytes `skip` bytes after each of these offsets, one row each; the offsets must have been checked."""
    # As plain bytes: numpy gathers structured values five times slower, field by field.
    if not width:
        return np.empty((len(starts), 0), dtype=np.uint8)
    every_offset = np.ndarray((len(data) - skip - width + 1,), f"V{width}", data.data, skip, (1,))
    return every_offset[starts].view(np.uint8).reshape(-1, width)


class Part(NamedTuple):
    """Messages of one channel among records side by side, in order: where they begin, and how long payloads are."""

    starts: Ints
    lengths: Ints
    log_times: Ints


class Piece(NamedTuple):
    """Records side by side, as of one chunk, and the messages among them, by channel; `offset`: in the file."""

    data: Bytes
    parts: Mapping[int, Part]
    offset: int

    @property
    def size(self) -> int:
        """Of the records [bytes]."""
        return len(self.data)


@dataclass
class Allowance:
    """How many records more the chunks of a log may hold.

    Every record that a recorder writes takes bytes of the file even when it is compressed, for its time differs; so
    the work stays in proportion to the file, whatever a few bytes unpack to.
    """

    left: int


def _refuse(damage: DamageError) -> None:
    """Raise the damage: the way to treat an index that disagrees, unless another is given."""
    raise damage


def piece_of_chunk(
    content: Any,
    offset: int,
    on_record: OnRecord,
    allowance: Allowance,
    indexes: Sequence[tuple[int, memoryview]] = (),
    on_odd_index: Callable[[DamageError], None] = _refuse,
) -> Piece:
    """The messages of a chunk, which its records must fill exactly; other records go to `on_record`.

    `indexes`: its message indexes, channel and entries. Where all records from the first listed one on are the listed
    messages, these are not walked. `on_odd_index`: of an index that disagrees with the chunk.
    """
    view = memoryview(content)
    starts = array("q")
    indexes = [(channel, entries) for channel, entries in indexes if entries]  # recovered logs have empty ones
    end, listed = _listed(np.frombuffer(content, dtype=np.uint8), offset, indexes) or (len(view), None)
    at = _walk(view, 0, end, starts, offset, on_record, allowance)
    if listed and at == end and not starts:
        return listed
    at = _walk(view, at, len(view), starts, offset, on_record, allowance)
    if at != len(view):
        how = "is cut off by" if at < len(view) else "runs past"
        raise DamageError(offset, f"a record {how} the end of its chunk")
    piece = _walked(content, starts, offset)
    if not _agree(piece, indexes):
        on_odd_index(DamageError(offset, "a message index disagrees with its chunk"))
    return piece


def _agree(piece: Piece, indexes: Sequence[tuple[int, memoryview]]) -> bool:
    """An index names all messages of its channel, each once: a reader that trusts it would lose some else."""
    for channel, entries in indexes:
        part = piece.parts.get(channel)
        listed = np.frombuffer(entries, dtype="<i8").reshape(-1, 2)
        messages = np.empty((0, 2)) if part is None else np.column_stack([part.log_times, part.starts])
        if not np.array_equal(listed[np.argsort(listed[:, 1], kind="stable")], messages):
            return False
    return True


def _listed(data: Bytes, offset: int, indexes: Sequence[tuple[int, memoryview]]) -> tuple[int, Piece] | None:
    """Where the first message begins, and all by their indexes; none unless they follow each other from there to the
    end and are as the indexes list them.
    """
    tables = _by_channel(indexes)
    if not tables:
        return None
    log_times, starts = np.concatenate([*tables.values()]).T
    order = np.argsort(starts, kind="stable")
    in_order = starts[order]
    first, last = int(in_order[0]), int(in_order[-1])
    if first < 0 or last > len(data) - MESSAGE_HEAD.itemsize:
        return None
    heads = stretches_of(data, starts, MESSAGE_HEAD.itemsize).reshape(-1).view(MESSAGE_HEAD)
    lengths = heads["length"].astype(np.int64)
    ends = in_order + lengths[order] + HEAD_SIZE
    if (
        ends[-1] != len(data)
        or np.count_nonzero(ends[:-1] != in_order[1:])
        or lengths.min() < _FIXED_FIELDS
        or np.count_nonzero(heads["opcode"] != int(Opcode.MESSAGE))
        or np.count_nonzero(heads["log_time"] != log_times)
    ):
        return None
    lengths -= _FIXED_FIELDS
    parts: dict[int, Part] = {}
    at = 0
    for channel, table in tables.items():
        rows = slice(at, at + len(table))
        if np.count_nonzero(heads["channel"][rows] != channel):
            return None
        parts[channel] = Part(starts[rows], lengths[rows], log_times[rows])
        at += len(table)
    return first, Piece(data, parts, offset)


def _by_channel(indexes: Sequence[tuple[int, memoryview]]) -> dict[int, Ints]:
    """Log time and start of the messages of each channel, in the order of their starts."""
    tables: dict[int, Ints] = {}
    for channel, entries in indexes:
        table = np.frombuffer(entries, dtype="<i8").reshape(-1, 2)
        tables[channel] = np.concatenate([tables[channel], table]) if channel in tables else table
    for channel, table in tables.items():
        if np.count_nonzero(table[1:, 1] < table[:-1, 1]):
            tables[channel] = table[np.argsort(table[:, 1], kind="stable")]
    return tables


def _walk(
    view: memoryview, at: int, end: int, starts: array[int], offset: int, on_record: OnRecord, allowance: Allowance
) -> int:
    """Record by record to `end` or beyond, or to less than the head of a record; where messages begin into `starts`."""
    unpack = HEAD.unpack_from
    message = int(Opcode.MESSAGE)
    room = len(view) - HEAD_SIZE
    last = min(end - 1, room)
    for left in range(allowance.left, -1, -1):
        if at > last:
            allowance.left = left
            return at
        opcode, length = unpack(view, at)
        if opcode == message:
            starts.append(at)
        elif at + length <= room:
            on_record(opcode, bytes(view[at + HEAD_SIZE :][:length]), offset)
        at += HEAD_SIZE + length
    raise DamageError(offset, "a chunk unpacks to more records than the file has bytes")


def piece_of_messages(content: bytes, offset: int) -> Piece:
    """The whole messages outside of chunks that this part of the file begins with."""
    starts = array("q")
    room = len(content) - HEAD_SIZE
    at = 0
    while at <= room:
        opcode, length = HEAD.unpack_from(content, at)
        if opcode != Opcode.MESSAGE or at + length > room:
            break
        starts.append(at)
        at += HEAD_SIZE + length
    return _walked(memoryview(content)[:at], starts, offset)


def _walked(content: Any, starts: array[int], offset: int) -> Piece:
    """The messages that begin at these places in the content, by channel; `offset`: of the content in the file."""
    data = np.frombuffer(content, dtype=np.uint8)
    at = np.array(starts, dtype=np.int64)
    if len(at) and (stretches_of(data, at + 1, 8).view("<i8") < _FIXED_FIELDS).any():
        raise DamageError(offset, "a message is shorter than its header")
    if not len(at):
        return Piece(data, {}, offset)
    heads = stretches_of(data, at, MESSAGE_HEAD.itemsize).reshape(-1).view(MESSAGE_HEAD)
    order = np.argsort(heads["channel"], kind="stable")
    channels = heads["channel"][order]
    lengths, log_times = heads["length"] - _FIXED_FIELDS, heads["log_time"].astype(np.int64)
    parts = {
        int(heads["channel"][rows[0]]): Part(at[rows], lengths[rows], log_times[rows])
        for rows in np.split(order, np.flatnonzero(channels[1:] != channels[:-1]) + 1)
    }
    return Piece(data, parts, offset)


def block_of(pieces: list[Piece], before: int) -> Block:
    """The messages of neighbouring pieces, by channel; `before` is the size of the pieces before these."""
    records = Records([piece.data for piece in pieces])
    parts: dict[int, list[tuple[int, Part]]] = defaultdict(list)
    base = MESSAGE_HEAD.itemsize
    for piece in pieces:
        for channel, part in piece.parts.items():
            parts[channel].append((base, part))
        base += piece.size
    return {channel: _messages(parts[channel], records, before) for channel in sorted(parts)}


def _messages(parts: Sequence[tuple[int, Part]], records: Records, before: int) -> Messages:
    """`parts`: where payloads behind their heads lie in the records, beside their place in the piece."""
    if len(parts) == 1:
        ((base, part),) = parts
        return Messages(records, part.starts + base, part.lengths, part.log_times, before)
    starts = np.concatenate([part.starts + base for base, part in parts])
    lengths = np.concatenate([part.lengths for _, part in parts])
    log_times = np.concatenate([part.log_times for _, part in parts])
    return Messages(records, starts, lengths, log_times, before)
