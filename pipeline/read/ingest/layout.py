"""Messages of one layout decoded at once: fields gathered at fixed offsets, the rest of the layout proved.

A layout is made by walking one message. It holds for another message of the same length if all bytes
that shaped the walk (length prefixes, tags) are the same there; that is checked on every message.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from pipeline.read.ingest.mcap_block import Bytes, Messages
from schemas.arrays import Bools, Ints

_MOST_LAYOUTS = 256  # of one channel; beyond, messages are decoded one by one
_MOST_ASIDE = 8  # messages without layout that may come before one that has a layout
_LARGEST_LEARNT = 1 << 16  # bytes of a message that is walked to learn its layout
_NEAR = 32  # bytes; what lies nearer is taken together


class UnfitError(Exception):
    """A message or field that has no fixed layout, or not the type asked for."""


Values = npt.NDArray[Any] | pl.Series
Columns = Mapping[str, Values]


@dataclass(frozen=True)
class Field:
    """Where a value lies in each message, and how it is taken from these bytes of each message, in rows."""

    kind: type[pl.DataType]
    start: int
    end: int
    take: Callable[[Bytes], Values]

    def as_type(self, dtype: pl.DataType) -> Field:
        """The field, if its values are of the kind asked for (whole numbers also serve as floats)."""
        if isinstance(dtype, self.kind):
            return self
        if self.kind is pl.Int64 and isinstance(dtype, pl.Float64):
            return replace(self, kind=pl.Float64)
        raise UnfitError(f"not of type {dtype}")

    def values(self, rows: Bytes) -> Values:
        """As numbers of 64 bits; other values as they are taken."""
        values = self.take(rows)
        if self.kind is pl.Float64 and isinstance(values, np.ndarray):
            return values.astype(np.float64)
        if self.kind is pl.Int64 and isinstance(values, np.ndarray):
            if values.dtype == np.uint64 and (values >> np.uint64(63)).any():
                raise UnfitError("a number is larger than 64 bits with a sign hold")
            return values.astype(np.int64)
        return values


def fixed(offset: int, dtype: str) -> Field:
    """A number of fixed width, as numpy names it (`<f8`)."""
    kind = pl.Float64 if dtype[1] == "f" else pl.Int64
    return Field(kind, offset, offset + int(dtype[2:]), lambda rows: rows.view(dtype)[:, 0])


def flag(offset: int) -> Field:
    """A boolean in one byte."""
    return Field(pl.Boolean, offset, offset + 1, lambda rows: rows[:, 0] != 0)


def text(offset: int, length: int) -> Field:
    """A text of known length."""

    def take(rows: Bytes) -> Values:
        content = pa.py_buffer(np.ascontiguousarray(rows))
        ends = pa.py_buffer(np.arange(len(rows) + 1, dtype=np.int64) * length)
        texts = pa.LargeStringArray.from_buffers(len(rows), ends, content)
        try:
            texts.validate(full=True)  # refuses what is not UTF-8
        except pa.ArrowInvalid:
            raise UnfitError("a text is not UTF-8") from None
        return pl.Series(pl.from_arrow(texts))

    return Field(pl.String, offset, offset + length, take)


def constant(value: float | str | bool | None, dtype: pl.DataType) -> Field:
    """A field that messages of this layout leave out: its default, or null."""
    values = pl.Series([value], dtype=dtype, strict=False)
    return Field(type(dtype), 0, 0, lambda rows: values.new_from_index(0, len(rows)))


@dataclass(frozen=True)
class ByteStretch:
    """Bytes of a message that are taken together; those `at` some places among them must agree under a mask."""

    start: int
    end: int
    at: Ints
    mask: Bytes
    expected: Bytes


@dataclass(frozen=True)
class Layout:
    """Of messages of one length: the fields, and the stretches that hold them and all that shapes the layout."""

    fields: Mapping[str, Field]
    stretches: Sequence[ByteStretch]

    def rows(self, messages: Messages) -> list[Bytes]:
        """Each stretch of each message."""
        return [messages.stretches(stretch.start, stretch.end) for stretch in self.stretches]

    def of(self, stretches: Sequence[Bytes]) -> Bools:
        """Whether each message has this layout."""
        agree = np.ones(len(stretches[0]), dtype=np.bool_)
        for stretch, rows in zip(self.stretches, stretches, strict=True):
            agree &= (rows[:, stretch.at] & stretch.mask == stretch.expected).all(axis=1)
        return agree

    def values(self, stretches: Sequence[Bytes]) -> Columns:
        """The fields of messages that have this layout."""
        starts = [stretch.start for stretch in self.stretches]
        values = {}
        for path, field in self.fields.items():
            number = bisect_right(starts, field.start) - 1
            extent = slice(field.start - starts[number], field.end - starts[number])
            values[path] = field.values(stretches[number][:, extent])
        return values


def layout_of(payload: bytes, static: bytearray, fields: Mapping[str, Field]) -> Layout:
    """From one message; `static` masks the bits that shape the layout."""
    mask = np.frombuffer(static, dtype=np.uint8)
    content = np.frombuffer(payload, dtype=np.uint8)
    used = mask != 0
    for field in fields.values():
        used[field.start : field.end] = True
    places = np.flatnonzero(used)
    stretches = []
    for part in np.split(places, np.flatnonzero(np.diff(places) > _NEAR) + 1):
        start, end = (int(part[0]), int(part[-1]) + 1) if len(part) else (0, 0)
        at = np.flatnonzero(mask[start:end])
        stretches.append(ByteStretch(start, end, at, mask[start:end][at], (content & mask)[start:end][at]))
    return Layout(fields, stretches)


def _by_length(messages: Messages) -> Iterator[tuple[int, Messages]]:
    """The messages of each length, in order of the file."""
    longest = int(messages.length.max())
    # As narrow numbers: numpy sorts those of 16 bits in one pass.
    order = np.argsort(messages.length.astype(np.min_scalar_type(longest)), kind="stable")
    lengths = messages.length[order]
    if lengths[0] == longest:
        yield longest, messages
        return
    for rows in np.split(order, np.flatnonzero(np.diff(lengths)) + 1):
        yield int(messages.length[rows[0]]), messages.chosen(rows)


class LayoutDecoder:
    """Decodes the messages of a channel by their layouts, which it learns as they come."""

    def __init__(self, walk: Callable[[bytes], Layout]) -> None:
        self._walk = walk
        self._layouts: dict[int, list[Layout]] = {}
        self._count = 0

    def decode(self, messages: Messages) -> tuple[list[tuple[Messages, Columns]], list[Messages]]:
        """Messages whose layout is known with their fields, and those that no layout fits."""
        parts: list[tuple[Messages, Columns]] = []
        left: list[Messages] = []
        for length, alike in _by_length(messages):
            for layout, group, rows in self._by_layout(length, alike, left):
                try:
                    parts.append((group, layout.values(rows)))
                except UnfitError:  # the ordinary decoder says why
                    left.append(group)
        return parts, left

    def _by_layout(
        self, length: int, messages: Messages, aside: list[Messages]
    ) -> Iterator[tuple[Layout, Messages, list[Bytes]]]:
        """Messages of one length by their layouts, with the stretches of these; those without one into `aside`."""
        known = self._layouts.setdefault(length, [])
        tried = 0
        while len(messages):
            if tried == len(known) and not self._learn(messages.payload(0), known):
                if len(aside) >= _MOST_ASIDE:
                    aside.append(messages)
                    return
                aside.append(messages.chosen(slice(1)))
                messages = messages.chosen(slice(1, None))
                continue
            layout = known[tried]
            tried += 1
            rows = layout.rows(messages)
            agree = layout.of(rows)
            if agree.all():
                yield layout, messages, rows
                return
            if agree.any():
                yield layout, messages.chosen(agree), [stretch[agree] for stretch in rows]
            messages = messages.chosen(~agree)

    def _learn(self, payload: bytes, known: list[Layout]) -> bool:
        if self._count >= _MOST_LAYOUTS or len(payload) > _LARGEST_LEARNT:
            return False
        try:
            known.append(self._walk(payload))
        except UnfitError:
            return False
        self._count += 1
        return True
