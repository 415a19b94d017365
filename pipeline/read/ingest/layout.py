"""Messages of one layout decoded at once: fields gathered at fixed offsets, the rest of the layout proved.

A layout is made by walking one message. It holds for another message of the same length if all bytes
that shaped the walk (length prefixes, tags) are the same there; that is checked on every message.
There is no other way to decode: a message like no other is walked for itself.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from pipeline.read.ingest.mcap_block import Bytes, Heads, Messages, joined_heads
from pipeline.read.ingest.mcap_records import Channel
from schemas.arrays import Bools
from schemas.errors import InputError
from schemas.frozen import frozen

_MOST_LAYOUTS = 256  # of one channel that are kept
_LARGEST_KEPT = 1 << 16  # bytes of a message whose layout is kept
_CHECKED = 64 * 1024  # bytes that are held against a layout at once
_NEAR = 32  # bytes; what lies nearer is taken together
_EXACT_INTEGER = 2.0**53


class UndecodableError(Exception):
    """A message that its own schema does not fit, or a field that has not the type asked for; `str` says why."""


def undecodable(channel: Channel, log_time_ns: int, error: UndecodableError) -> InputError:
    """The error for one message, named by the time at which it was recorded."""
    return InputError(
        f"the message recorded at log time {log_time_ns} ns cannot be decoded: {error}",
        place=channel.place,
        remedy="Record the log again, or map other fields.",
    )


def parse_path(path: str) -> list[str | int]:
    """`a.b[3].c` as `["a", "b", 3, "c"]`."""
    steps: list[str | int] = []
    for part in path.split("."):
        name, *indices = part.split("[")
        steps.append(name)
        steps += [int(index.rstrip("]")) for index in indices]
    return steps


Values = npt.NDArray[Any] | pl.Series
Columns = Mapping[str, Values]
Decoded = tuple[Heads, Columns]


@frozen
class Field:
    """Where a value lies in each message, and how it is taken from these bytes of each message, in rows by block."""

    kind: type[pl.DataType]
    start: int
    end: int
    take: Callable[[Sequence[Bytes]], Values]

    def as_type(self, dtype: pl.DataType) -> Field:
        """The field, if its values are of the kind asked for, or numbers that may be."""
        if isinstance(dtype, self.kind):
            return self
        if self.kind in (pl.Int64, pl.Float64) and isinstance(dtype, pl.Int64 | pl.Float64):
            return replace(self, kind=type(dtype))
        if self.kind is pl.Int64 and isinstance(dtype, pl.String):
            # Ids are names, whatever a message holds them as.
            return replace(
                self, kind=pl.String, take=lambda blocks: pl.Series(np.asarray(self.take(blocks))).cast(pl.String)
            )
        raise UndecodableError(f"a field holds {self.kind.__name__}, not {dtype}")

    def values(self, blocks: Sequence[Bytes]) -> Values:
        """As numbers of 64 bits, which must hold what was recorded; other values as they are taken."""
        values = self.take(blocks)
        if self.kind not in (pl.Int64, pl.Float64) or not isinstance(values, np.ndarray):
            return values
        if self.kind is pl.Float64:
            return values.astype(np.float64, copy=False)
        if values.dtype == np.uint64 and (values >> np.uint64(63)).any():
            raise UndecodableError("a number is larger than a 64-bit integer with a sign")
        if values.dtype.kind == "f" and not ((np.abs(values) < _EXACT_INTEGER) & (np.rint(values) == values)).all():
            raise UndecodableError("a number is not a 64-bit integer")
        return values.astype(np.int64, copy=False)


def fixed(offset: int, dtype: str) -> Field:
    """A number of fixed width, as numpy names it (`<f8`)."""
    kind = pl.Float64 if dtype[1] == "f" else pl.Int64

    def take(blocks: Sequence[Bytes]) -> Values:
        return np.concatenate([rows.view(dtype)[:, 0] for rows in blocks])

    return Field(kind, offset, offset + int(dtype[2:]), take)


def flag(offset: int) -> Field:
    """A boolean in one byte."""
    return Field(pl.Boolean, offset, offset + 1, lambda blocks: np.concatenate(blocks)[:, 0] != 0)


def text(offset: int, length: int) -> Field:
    """A text of known length."""

    def take(blocks: Sequence[Bytes]) -> Values:
        content = np.concatenate(blocks)
        flat = content.reshape(-1)
        if np.array_equal(flat[length:], flat[: len(flat) - length]):  # mostly each is as the one before
            return _texts(content[:1]).new_from_index(0, len(content))
        return _texts(content)

    return Field(pl.String, offset, offset + length, take)


def _texts(content: Bytes) -> pl.Series:
    """Texts of one length, one in each row."""
    count, length = content.shape
    ends = pa.py_buffer(np.arange(count + 1, dtype=np.int64) * length)
    texts = pa.LargeStringArray.from_buffers(count, ends, pa.py_buffer(content))
    try:
        texts.validate(full=True)  # refuses what is not UTF-8
    except pa.ArrowInvalid:
        raise UndecodableError("a text is not UTF-8") from None
    return pl.Series(pl.from_arrow(texts))


def constant(value: float | str | bool | None, dtype: pl.DataType) -> Field:
    """A field that messages of this layout leave out: its default, or null."""
    values = pl.Series([value], dtype=dtype, strict=False)
    if dtype.is_numeric() and value is not None:
        number = values.to_numpy()
        return Field(type(dtype), 0, 0, lambda blocks: number.repeat(sum(map(len, blocks))))
    return Field(type(dtype), 0, 0, lambda blocks: values.new_from_index(0, sum(map(len, blocks))))


class ByteStretch:
    """Bytes of a message that are taken together, and what they must be under a mask."""

    def __init__(self, start: int, end: int, mask: Bytes, expected: Bytes) -> None:
        self.start = start
        self.end = end
        self._mask = mask
        self._expected = expected
        self._shapes = bool(mask.any())
        # The same of several messages, so that many bytes are looked at together.
        self._masks = mask
        self._all_expected = expected

    def unlike(self, rows: Bytes) -> Bools | None:
        """Which rows are not as expected; None where all are."""
        if not self._shapes:
            return None
        together = min(len(rows), _CHECKED // len(self._mask) + 1) * len(self._mask)
        if len(self._masks) < together:
            self._masks = np.resize(self._mask, together)
            self._all_expected = np.resize(self._expected, together)
        flat = rows.reshape(-1)
        for at in range(0, len(flat), together):
            part = flat[at : at + together]
            wrong = (part ^ self._all_expected[: len(part)]) & self._masks[: len(part)]
            # Mostly nothing is: then no row of a few bytes has to be looked at for itself.
            if np.bitwise_or.reduce(wrong):
                return np.asarray(((rows ^ self._expected) & self._mask).any(axis=1))
        return None


@frozen
class Layout:
    """Of messages of one length: where they hold the fields, in the order of the rows that they make (mostly one),
    and the stretches that hold these and all that shapes the layout.
    """

    fields: Mapping[str, Sequence[Field]]
    stretches: Sequence[ByteStretch]

    def rows(self, messages: Messages) -> list[Bytes]:
        """Each stretch of each message."""
        return [messages.stretches(stretch.start, stretch.end) for stretch in self.stretches]

    def of(self, stretches: Sequence[Bytes]) -> Bools | None:
        """Which messages have this layout; None where all have."""
        found = [stretch.unlike(rows) for stretch, rows in zip(self.stretches, stretches, strict=True)]
        unlike = [rows for rows in found if rows is not None]
        return ~np.logical_or.reduce(unlike) if unlike else None

    def values(self, blocks: Sequence[Sequence[Bytes]]) -> Columns:
        """The fields of messages that have this layout, for each row that they make; `blocks`: their stretches."""
        starts = [stretch.start for stretch in self.stretches]

        def values(field: Field) -> Values:
            number = bisect_right(starts, field.start) - 1
            places = slice(field.start - starts[number], field.end - starts[number])
            return field.values([stretches[number][:, places] for stretches in blocks])

        return {path: _in_turn([*map(values, fields)]) for path, fields in self.fields.items()}

    def heads_of(self, heads: Heads) -> Heads:
        """Of the message of each row."""
        count = max(map(len, self.fields.values()), default=1)
        return heads if count == 1 else heads.chosen(np.repeat(np.arange(len(heads.ordinal)), count))


def _in_turn(columns: Sequence[Values]) -> Values:
    """The first value of each, then the second of each, and so on."""
    if len(columns) == 1:
        return columns[0]
    return np.column_stack([*map(np.asarray, columns)]).ravel() if columns else np.empty(0)


def layout_of(payload: bytes, static: bytearray, fields: Mapping[str, Sequence[Field]]) -> Layout:
    """From one message; `static` masks the bits that shape the layout."""
    mask = np.frombuffer(static, dtype=np.uint8)
    content = np.frombuffer(payload, dtype=np.uint8)
    used = mask != 0
    for field in chain.from_iterable(fields.values()):
        used[field.start : field.end] = True
    places = np.flatnonzero(used)
    stretches = []
    for part in np.split(places, np.flatnonzero(np.diff(places) > _NEAR) + 1):
        start, end = (int(part[0]), int(part[-1]) + 1) if len(part) else (0, 0)
        stretches.append(ByteStretch(start, end, mask[start:end], content[start:end]))
    return Layout(fields, stretches)


def _by_length(messages: Messages) -> Iterator[tuple[int, Messages]]:
    """The messages of each length, in order of the file."""
    longest = messages.longest
    if longest == messages.length.min():
        yield longest, messages
        return
    # As narrow numbers: numpy sorts those of 16 bits in one pass.
    order = np.argsort(messages.length.astype(np.min_scalar_type(longest)), kind="stable")
    lengths = messages.length[order]
    for rows in np.split(order, np.flatnonzero(np.diff(lengths)) + 1):
        yield int(messages.length[rows[0]]), messages.chosen(rows)


class _Waiting(NamedTuple):
    """A layout, and what waits to be decoded of the messages that have it, block by block."""

    layout: Layout
    heads: list[Heads]
    stretches: list[list[Bytes]]

    def taken(self) -> tuple[Layout, Heads, list[list[Bytes]]]:
        """All of it, and it waits no more."""
        heads, stretches = joined_heads(self.heads), [*self.stretches]
        self.heads.clear()
        self.stretches.clear()
        return self.layout, heads, stretches


class LayoutDecoder:
    """Decodes the messages of a channel by their layouts, which it learns as they come.

    What the fields and the layout need is taken of each block while that is in the processor's cache, and decoded when
    somebody asks. `slow_messages`: those whose layout was not kept; `waiting`: bytes that wait to be decoded.
    Raises `InputError` for a message that cannot be decoded.
    """

    def __init__(self, channel: Channel, walk: Callable[[bytes], Layout], with_publish_time: bool = False) -> None:
        self.slow_messages = 0
        self.waiting = 0
        self._channel = channel
        self._walk = walk
        self._with_publish_time = with_publish_time
        self._layouts: dict[int, list[_Waiting]] = {}
        self._kept = 0
        self._alone: list[Decoded] = []

    def add(self, messages: Messages) -> None:
        """Take what is needed of all messages."""
        for length, alike in _by_length(messages):
            self._by_layout(alike, self._layouts.setdefault(length, []))

    def decoded(self) -> Iterator[Decoded]:
        """The fields of all messages that wait, of those of one layout together."""
        alone = self._alone
        self._alone = []
        self.waiting = 0
        yield from alone
        for known in chain.from_iterable(self._layouts.values()):
            if known.heads:
                yield self._decoded(*known.taken())

    def _by_layout(self, left: Messages, known: list[_Waiting]) -> None:
        tried = 0
        while len(left):
            if tried == len(known) and not self._learn(left, known):
                self._decode_first(left)
                left = left.chosen(slice(1, None))
                continue
            layout = known[tried].layout
            rows = layout.rows(left)
            agree = layout.of(rows)
            if agree is None:
                self._keep(known[tried], left, rows)
                return
            if agree.any():
                self._keep(known[tried], left.chosen(agree), [stretch[agree] for stretch in rows])
            left = left.chosen(~agree)
            tried += 1

    def _keep(self, known: _Waiting, messages: Messages, rows: list[Bytes]) -> None:
        heads = messages.heads(self._with_publish_time)
        known.heads.append(heads)
        known.stretches.append(rows)
        self.waiting += sum(part.nbytes for part in (*heads, *rows) if part is not None)

    def _learn(self, messages: Messages, known: list[_Waiting]) -> bool:
        """Whether the layout of the first message is known from now on."""
        if self._kept >= _MOST_LAYOUTS or messages.length[0] > _LARGEST_KEPT:
            return False
        known.append(_Waiting(self._layout_of_first(messages), [], []))
        self._kept += 1
        return True

    def _decode_first(self, messages: Messages) -> None:
        self.slow_messages += 1
        first = messages.chosen(slice(1))
        layout = self._layout_of_first(first)
        self._alone.append(self._decoded(layout, first.heads(self._with_publish_time), [layout.rows(first)]))

    def _layout_of_first(self, messages: Messages) -> Layout:
        try:
            return self._walk(messages.payload(0))
        except UndecodableError as error:
            raise undecodable(self._channel, messages.log_time[0], error) from None

    def _decoded(self, layout: Layout, heads: Heads, blocks: Sequence[Sequence[Bytes]]) -> Decoded:
        try:
            return layout.heads_of(heads), layout.values(blocks)
        except UndecodableError as error:
            if len(heads.ordinal) == 1:
                raise undecodable(self._channel, heads.log_time[0], error) from None
        stretches = [np.concatenate(of_blocks) for of_blocks in zip(*blocks, strict=True)]
        for row in range(len(heads.ordinal)):  # one of them cannot be decoded
            this = slice(row, row + 1)
            self._decoded(layout, heads.chosen(this), [[stretch[this] for stretch in stretches]])
        raise AssertionError("messages that can be decoded one by one cannot be decoded together")
