"""Blocks of records (chunks, or a stretch of a log without chunks) and the messages in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.ingest.mcap_records import HEAD_SIZE, DamageError, Op
from schemas.arrays import Ints

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
Locate = Callable[[int], int]  # place in a block to place in the file


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


def block_of(data: Bytes, starts: Ints, locate: Locate, first_ordinal: int) -> Block:
    """The messages at these record offsets, by channel."""
    if not len(starts):
        return {}
    if starts.max() > len(data) - MESSAGE_HEAD_SIZE:
        raise DamageError(locate(int(starts.max())), "a message is shorter than its header")
    heads = gathered(data, starts, MESSAGE_HEAD)
    order = np.argsort(heads["channel"], kind="stable")
    starts, heads = starts[order], heads[order]
    lengths = heads["length"].astype(np.int64)
    firsts = np.flatnonzero(np.diff(heads["channel"].astype(np.int64), prepend=-1)).tolist()
    return {
        int(heads["channel"][first]): messages_of(
            data, starts[first:end], lengths[first:end], heads[first:end], locate, first_ordinal
        )
        for first, end in zip(firsts, [*firsts[1:], len(starts)], strict=True)
    }


def messages_of(
    data: Bytes, starts: Ints, lengths: Ints, heads: npt.NDArray[Any], locate: Locate, first_ordinal: int
) -> Messages:
    """Messages of one channel, whose heads were gathered; `lengths` are those of the records."""
    lengths = lengths - _FIXED_FIELDS
    if lengths.min() < 0:
        raise DamageError(locate(int(starts[lengths.argmin()])), "a message is shorter than its header")
    return Messages(data, starts + MESSAGE_HEAD_SIZE, lengths, starts + first_ordinal, heads)
