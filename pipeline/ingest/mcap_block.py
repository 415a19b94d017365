"""Blocks of records (chunks, or a stretch of a log without chunks) and the messages in them."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from pipeline.ingest.mcap_records import HEAD, HEAD_SIZE, DamageError
from schemas.arrays import Bools, Ints

Bytes = npt.NDArray[np.uint8]
OnRecord = Callable[[int, bytes, int], None]  # opcode, content, offset of its chunk in the file

# A message record: opcode, length, channel, sequence, log time, publish time, then the payload.
MESSAGE_HEAD = np.dtype(
    {
        "names": ["opcode", "length", "channel", "log_time", "publish_time"],
        "formats": ["u1", "<u8", "<u2", "<i8", "<i8"],
        "offsets": [0, 1, 9, 15, 23],
        "itemsize": 31,
    }
)
_FIXED_FIELDS = MESSAGE_HEAD.itemsize - HEAD_SIZE


@dataclass(frozen=True)
class Messages:
    """Messages of one channel in a block, in order of the file: where their payloads lie in `data`.

    `ordinal` orders messages of all channels of the log as they stand in the file; times are in nanoseconds.
    """

    data: Bytes
    start: Ints
    length: Ints
    ordinal: Ints
    log_time: Ints
    publish_time: Ints

    def __len__(self) -> int:
        return len(self.start)

    def payload(self, row: int) -> bytes:
        first = int(self.start[row])
        return self.data[first : first + int(self.length[row])].tobytes()

    def chosen(self, rows: Ints | Bools | slice) -> Messages:
        """Some of them."""
        if isinstance(rows, np.ndarray) and rows.dtype == np.bool_:
            rows = np.flatnonzero(rows)
        columns = (self.start, self.length, self.ordinal, self.log_time, self.publish_time)
        return Messages(self.data, *(column[rows] for column in columns))


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
    """Records side by side, as of one chunk, and where messages begin among them; `offset`: its place in the file.

    `proved` are message indexes, by channel, that its messages were found by.
    """

    data: Bytes
    starts: Ints
    offset: int
    proved: Mapping[int, bytes] = field(default_factory=dict)

    @cached_property
    def heads(self) -> npt.NDArray[Any]:
        """The heads of the messages."""
        if not len(self.starts):
            return np.empty(0, dtype=MESSAGE_HEAD)
        return stretches_of(self.data, self.starts, MESSAGE_HEAD.itemsize).reshape(-1).view(MESSAGE_HEAD)

    @cached_property
    def entries(self) -> tuple[npt.NDArray[np.uint16], Ints]:
        """What message indexes must say: channel, and pairs of log time and offset, by channel."""
        order = np.argsort(self.heads["channel"], kind="stable")
        return self.heads["channel"][order], np.column_stack([self.heads["log_time"], self.starts])[order]

    def check_index(self, channel: int, entries: bytes) -> None:
        """An index names all messages of its channel, each once: a reader that trusts it would lose some else."""
        if self.proved.get(channel) == entries:
            return
        channels, found = self.entries
        first, end = np.searchsorted(channels, np.array([channel, channel + 1]))
        told = np.frombuffer(entries, dtype="<i8").reshape(-1, 2)
        if not np.array_equal(told[np.argsort(told[:, 1], kind="stable")], found[first:end]):
            raise DamageError(self.offset, "a message index disagrees with its chunk")


@dataclass
class Allowance:
    """How many records more the chunks of a log may hold.

    Every record that a recorder writes takes bytes of the file even when it is compressed, for its time differs; so
    the work stays in proportion to the file, whatever a few bytes unpack to.
    """

    left: int


def piece_of_chunk(
    content: Any, offset: int, on_record: OnRecord, allowance: Allowance, indexes: Mapping[int, bytes]
) -> Piece:
    """The messages of a chunk, which its records must fill exactly; other records go to `on_record`.

    Where all records from the first on that `indexes` name are the messages as they tell, they are not walked.
    """
    view, starts = memoryview(content), array("q")
    named = _named(np.frombuffer(content, dtype=np.uint8), offset, indexes)
    end = int(named.starts[0]) if named else len(view)
    at = _walk(view, 0, end, starts, offset, on_record, allowance)
    if named and at == end and not starts:
        return named
    at = _walk(view, at, len(view), starts, offset, on_record, allowance)
    if at != len(view):
        how = "is cut off by" if at < len(view) else "runs past"
        raise DamageError(offset, f"a record {how} the end of its chunk")
    return _piece(content, starts, offset)


def _named(data: Bytes, offset: int, indexes: Mapping[int, bytes]) -> Piece | None:
    """The messages by their indexes; none unless they follow each other to the end and are as told."""
    counts = [len(entries) // 16 for entries in indexes.values()]
    told = np.frombuffer(b"".join(indexes.values()), dtype="<i8").reshape(-1, 2)
    order = np.argsort(told[:, 1], kind="stable")
    starts = told[order, 1]
    if not len(starts) or starts[0] < 0 or starts[-1] > len(data) - MESSAGE_HEAD.itemsize:
        return None
    piece = Piece(data, starts, offset, indexes)
    heads = piece.heads
    lengths = heads["length"].astype(np.int64)
    channels = np.repeat(np.array(list(indexes)), counts)[order]
    ends = starts + HEAD_SIZE + lengths
    as_told = (
        (heads["opcode"] == int(Opcode.MESSAGE)).all()
        and (heads["channel"] == channels).all()
        and (heads["log_time"] == told[order, 0]).all()
    )
    tiled = ends[-1] == len(data) and (ends[:-1] == starts[1:]).all() and lengths.min() >= _FIXED_FIELDS
    return piece if as_told and tiled else None


def _walk(
    view: memoryview, at: int, end: int, starts: array[int], offset: int, on_record: OnRecord, allowance: Allowance
) -> int:
    """Record by record to `end` or beyond, or to less than the head of a record; where messages begin into `starts`."""
    unpack, message, keep = HEAD.unpack_from, int(Opcode.MESSAGE), starts.append
    room = len(view) - HEAD_SIZE
    last = min(end - 1, room)
    for left in range(allowance.left, -1, -1):
        if at > last:
            allowance.left = left
            return at
        opcode, length = unpack(view, at)
        if opcode == message:
            keep(at)
        elif at + length <= room:
            on_record(opcode, bytes(view[at + HEAD_SIZE :][:length]), offset)
        at += HEAD_SIZE + length
    raise DamageError(offset, "a chunk unpacks to more records than the file has bytes")


def piece_of_messages(content: bytes, offset: int) -> Piece:
    """The whole messages outside of chunks that this part of the file begins with."""
    unpack, message = HEAD.unpack_from, int(Opcode.MESSAGE)
    starts = array("q")
    at, room = 0, len(content) - HEAD_SIZE
    while at <= room:
        opcode, length = unpack(content, at)
        if opcode != message or at + length > room:
            break
        starts.append(at)
        at += HEAD_SIZE + length
    return _piece(memoryview(content)[:at], starts, offset)


def _piece(content: Any, starts: array[int], offset: int) -> Piece:
    data = np.frombuffer(content, dtype=np.uint8)
    found = np.frombuffer(starts, dtype=np.int64) if starts else np.empty(0, dtype=np.int64)
    lengths = stretches_of(data, found + 1, 8).view("<u8") if starts else found
    if (lengths < _FIXED_FIELDS).any():
        raise DamageError(offset, "a message is shorter than its header")
    return Piece(data, found, offset)


def block_of(pieces: list[Piece], first_ordinal: int) -> Block:
    """The messages of neighbouring pieces, by channel."""
    sizes = [len(piece.data) for piece in pieces]
    data = pieces[0].data if len(pieces) == 1 else np.concatenate([piece.data for piece in pieces])
    bases = np.cumsum([0, *sizes[:-1]])
    starts = np.concatenate([piece.starts + base for piece, base in zip(pieces, bases, strict=True)])
    if not len(starts):
        return {}
    plain = f"V{MESSAGE_HEAD.itemsize}"  # numpy moves structured values five times slower, field by field
    heads = np.concatenate([piece.heads.view(plain) for piece in pieces])
    order = np.argsort(heads.view(MESSAGE_HEAD)["channel"], kind="stable")
    starts, heads = starts[order], heads[order].view(MESSAGE_HEAD)
    firsts = np.flatnonzero(np.diff(heads["channel"].astype(np.int64), prepend=-1)).tolist()
    return {
        int(heads["channel"][first]): Messages(
            data,
            starts[first:end] + MESSAGE_HEAD.itemsize,
            heads["length"][first:end].astype(np.int64) - _FIXED_FIELDS,
            starts[first:end] + first_ordinal,
            heads["log_time"][first:end].astype(np.int64),
            heads["publish_time"][first:end].astype(np.int64),
        )
        for first, end in zip(firsts, [*firsts[1:], len(starts)], strict=True)
    }
