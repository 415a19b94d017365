"""Blocks of records (chunks, or a stretch of a log without chunks) and the messages in them."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from pipeline.read.ingest.mcap_records import HEAD, HEAD_SIZE, DamageError
from schemas.arrays import Bools, Ints

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


@dataclass(frozen=True)
class Messages:
    """Messages of one channel in a block, in order of the file: where their payloads lie in the records of the block.

    Times are in nanoseconds; `before` is the size of all blocks before this one.
    """

    data: Bytes
    start: Ints
    length: Ints
    log_time: Ints
    before: int = 0

    def __len__(self) -> int:
        return len(self.start)

    @property
    def ordinal(self) -> Ints:
        """What orders messages of all channels of the log as they stand in the file."""
        return self.start + self.before

    @property
    def publish_time(self) -> Ints:
        """The last field of the heads that stand before the payloads."""
        return self.stretches(-8, 0).view("<i8")[:, 0]

    def stretches(self, start: int, end: int) -> Bytes:
        """From one byte to another of each payload, one row each; the payloads must be that long."""
        return stretches_of(self.data, self.start + start, end - start)

    def payload(self, row: int) -> bytes:
        return self.data[self.start[row] :][: self.length[row]].tobytes()

    def chosen(self, rows: Ints | Bools | slice) -> Messages:
        """Some of them."""
        if isinstance(rows, np.ndarray) and rows.dtype == np.bool_:
            rows = np.flatnonzero(rows)
        return replace(self, start=self.start[rows], length=self.length[rows], log_time=self.log_time[rows])


Block = dict[int, Messages]  # by channel


def stretches_of(data: Bytes, starts: Ints, width: int) -> Bytes:
    """`width` bytes from each of these offsets on, one row each; the offsets must have been checked."""
    # As plain bytes: numpy gathers structured values five times slower, field by field.
    if not width:
        return np.empty((len(starts), 0), dtype=np.uint8)
    every_offset = np.ndarray((len(data) - width + 1,), f"V{width}", data.data, strides=(1,))
    return every_offset[starts].view(np.uint8).reshape(-1, width)


@dataclass(frozen=True)
class Piece:
    """Records side by side, as of one chunk, and where messages begin among them, with the heads of these.

    `offset`: its place in the file.
    """

    data: Bytes
    starts: Ints
    heads: npt.NDArray[np.void]
    offset: int


def _piece(data: Bytes, starts: Ints, offset: int) -> Piece:
    heads = stretches_of(data, starts, MESSAGE_HEAD.itemsize).reshape(-1) if len(starts) else data[:0]
    return Piece(data, starts, heads.view(MESSAGE_HEAD), offset)


@dataclass
class Allowance:
    """How many records more the chunks of a log may hold.

    Every record that a recorder writes takes bytes of the file even when it is compressed, for its time differs; so
    the work stays in proportion to the file, whatever a few bytes unpack to.
    """

    left: int


def _refuse(damage: DamageError) -> None:
    raise damage


def piece_of_chunk(
    content: Any,
    offset: int,
    on_record: OnRecord,
    allowance: Allowance,
    indexes: Sequence[tuple[int, bytes]] = (),
    on_odd_index: Callable[[DamageError], None] = _refuse,
) -> Piece:
    """The messages of a chunk, which its records must fill exactly; other records go to `on_record`.

    `indexes`: its message indexes, channel and entries. Where all records from the first listed one on are the listed
    messages, these are not walked. `on_odd_index`: of an index that disagrees with the chunk.
    """
    view = memoryview(content)
    starts = array("q")
    indexes = [(channel, entries) for channel, entries in indexes if entries]  # recovered logs have empty ones
    listed = _listed(np.frombuffer(content, dtype=np.uint8), offset, indexes)
    end = int(listed.starts[0]) if listed else len(view)
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


def _agree(piece: Piece, indexes: Sequence[tuple[int, bytes]]) -> bool:
    """An index names all messages of its channel, each once: a reader that trusts it would lose some else."""
    order = np.argsort(piece.heads["channel"], kind="stable")
    channels = piece.heads["channel"][order]
    messages = np.column_stack([piece.heads["log_time"], piece.starts])[order]
    for channel, entries in indexes:
        first, end = np.searchsorted(channels, np.array([channel, channel + 1]))
        listed = np.frombuffer(entries, dtype="<i8").reshape(-1, 2)
        if not np.array_equal(listed[np.argsort(listed[:, 1], kind="stable")], messages[first:end]):
            return False
    return True


def _listed(data: Bytes, offset: int, indexes: Sequence[tuple[int, bytes]]) -> Piece | None:
    """The messages by their indexes; none unless they follow each other to the end and are as the indexes list them."""
    log_times, starts = np.frombuffer(b"".join(entries for _, entries in indexes), dtype="<i8").reshape(-1, 2).T
    channels = np.repeat([channel for channel, _ in indexes], [len(entries) // 16 for _, entries in indexes])
    order = np.argsort(starts, kind="stable")
    starts = starts[order]
    if not len(starts) or starts[0] < 0 or starts[-1] > len(data) - MESSAGE_HEAD.itemsize:
        return None
    piece = _piece(data, starts, offset)
    lengths = np.ascontiguousarray(piece.heads["length"])
    ends = starts + HEAD_SIZE + lengths
    tiled = ends[-1] == len(data) and (ends[:-1] == starts[1:]).all() and lengths.min() >= _FIXED_FIELDS
    as_listed = (
        (piece.heads["opcode"] == int(Opcode.MESSAGE)).all()
        and (piece.heads["channel"] == channels[order]).all()
        and (piece.heads["log_time"] == log_times[order]).all()
    )
    return piece if as_listed and tiled else None


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
    data = np.frombuffer(content, dtype=np.uint8)
    at = np.array(starts, dtype=np.int64)
    if len(at) and (stretches_of(data, at + 1, 8).view("<i8") < _FIXED_FIELDS).any():
        raise DamageError(offset, "a message is shorter than its header")
    return _piece(data, at, offset)


def block_of(pieces: list[Piece], before: int) -> Block:
    """The messages of neighbouring pieces, by channel; `before` is the size of the pieces before these."""
    whole = pieces[0] if len(pieces) == 1 else _together(pieces)
    order = np.argsort(whole.heads["channel"], kind="stable")
    channels = whole.heads["channel"][order]
    starts = whole.starts + MESSAGE_HEAD.itemsize
    lengths = whole.heads["length"] - _FIXED_FIELDS
    log_times = whole.heads["log_time"]
    return {
        int(whole.heads["channel"][rows[0]]): Messages(whole.data, starts[rows], lengths[rows], log_times[rows], before)
        for rows in np.split(order, np.flatnonzero(channels[1:] != channels[:-1]) + 1)
        if len(rows)
    }


def _together(pieces: list[Piece]) -> Piece:
    bases = np.cumsum([0, *(len(piece.data) for piece in pieces[:-1])])
    data = np.concatenate([piece.data for piece in pieces])
    starts = np.concatenate([piece.starts + base for piece, base in zip(pieces, bases, strict=True)])
    return Piece(data, starts, np.concatenate([piece.heads for piece in pieces]), pieces[0].offset)
