"""Messages of one layout decoded at once: fields gathered at fixed offsets, the rest of the layout proved.

A layout is made by walking one message. It holds for another message of the same length if all bytes
that shaped the walk (length prefixes, tags) are the same there; that is checked on every message.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import polars as pl
import pyarrow as pa

from pipeline.ingest.mcap_block import Bytes, Messages, stretches_of
from schemas.arrays import Bools, Ints

_MOST_LAYOUTS = 256  # of one channel; beyond, messages are decoded one by one
_MOST_ASIDE = 8  # messages without layout that may come before one that has a layout
_LARGEST_LEARNT = 1 << 16  # bytes of a message that is walked to learn its layout


class UnfitError(Exception):
    """A message or field that has no fixed layout, or not the type asked for."""


@dataclass(frozen=True)
class Field:
    """Where a value lies in each message (up to `end`), and how it is taken from rows of their bytes."""

    kind: type[pl.DataType]
    end: int
    take: Callable[[Bytes], pl.Series]

    def as_type(self, dtype: pl.DataType) -> Field:
        """The field, if its values are of the kind asked for (whole numbers also serve as floats)."""
        if isinstance(dtype, self.kind) or (self.kind is pl.Int64 and isinstance(dtype, pl.Float64)):
            return self
        raise UnfitError(f"not of type {dtype}")


def fixed(offset: int, dtype: str) -> Field:
    """A number of fixed width, as numpy names it (`<f8`)."""
    end = offset + int(dtype[2:])

    def take(rows: Bytes) -> pl.Series:
        values = rows[:, offset:end].view(dtype)[:, 0]
        return pl.Series(values.astype(values.dtype.newbyteorder("=")))

    return Field(pl.Float64 if dtype[1] == "f" else pl.Int64, end, take)


def flag(offset: int) -> Field:
    """A boolean in one byte."""
    return Field(pl.Boolean, offset + 1, lambda rows: pl.Series(rows[:, offset] != 0))


def text(offset: int, length: int) -> Field:
    """A text of known length."""

    def take(rows: Bytes) -> pl.Series:
        content = pa.py_buffer(np.ascontiguousarray(rows[:, offset : offset + length]))
        ends = pa.py_buffer(np.arange(len(rows) + 1, dtype=np.int64) * length)
        texts = pa.LargeStringArray.from_buffers(len(rows), ends, content)
        try:
            texts.validate(full=True)  # refuses what is not UTF-8
        except pa.ArrowInvalid:
            raise UnfitError("a text is not UTF-8") from None
        return pl.Series(pl.from_arrow(texts))

    return Field(pl.String, offset + length, take)


def constant(value: float | str | bool | None, dtype: pl.DataType) -> Field:
    """A field that messages of this layout leave out: its default, or null."""
    return Field(
        type(dtype), 0, lambda rows: pl.Series([value], dtype=dtype, strict=False).new_from_index(0, len(rows))
    )


@dataclass(frozen=True)
class Layout:
    """Of messages of one length: the fields, and the bytes `at` which messages must agree under a mask."""

    fields: Mapping[str, Field]
    at: Ints
    mask: Bytes
    expected: Bytes

    @property
    def end(self) -> int:
        """Behind the last byte that is looked at."""
        ends = [field.end for field in self.fields.values()]
        return max(0, *ends, int(self.at.max(initial=-1)) + 1)

    def of(self, rows: Bytes) -> Bools:
        """Whether each message has this layout."""
        agree: Bools = (rows[:, self.at] & self.mask == self.expected).all(axis=1)
        return agree


def layout_of(payload: bytes, static: bytearray, fields: Mapping[str, Field]) -> Layout:
    """From one message; `static` masks the bits that shape the layout."""
    mask = np.frombuffer(static, dtype=np.uint8)
    at = np.flatnonzero(mask)
    return Layout(fields, at, mask[at], np.frombuffer(payload, dtype=np.uint8)[at] & mask[at])


def _by_length(messages: Messages) -> Iterator[tuple[int, Messages]]:
    first = int(messages.length[0])
    if (messages.length == first).all():
        yield first, messages
        return
    for length in np.unique(messages.length).tolist():
        yield length, messages.chosen(messages.length == length)


Columns = Mapping[str, pl.Series]


class LayoutDecoder:
    """Decodes the messages of a channel by their layouts, which it learns as they come."""

    def __init__(self, walk: Callable[[bytes], Layout], types: Mapping[str, pl.DataType]) -> None:
        self._walk = walk
        self._types = types
        self._layouts: dict[int, list[Layout]] = {}
        self._count = 0

    def decode(self, messages: Messages) -> tuple[list[tuple[Messages, Columns]], list[Messages]]:
        """Messages whose layout is known with their fields, and those that no layout fits."""
        parts: list[tuple[Messages, Columns]] = []
        left: list[Messages] = []
        for length, alike in _by_length(messages):
            for layout, group, rows in self._by_layout(length, alike, left):
                try:
                    values = {path: field.take(rows) for path, field in layout.fields.items()}
                    parts.append((group, {path: values[path].cast(dtype) for path, dtype in self._types.items()}))
                except (UnfitError, pl.exceptions.PolarsError):  # the ordinary decoder says why
                    left.append(group)
        return parts, left

    def _by_layout(
        self, length: int, messages: Messages, aside: list[Messages]
    ) -> Iterator[tuple[Layout, Messages, Bytes]]:
        """Messages of one length by their layouts, and their bytes; those without one into `aside`."""
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
            rows = stretches_of(messages.data, messages.start, layout.end)
            agree = layout.of(rows)
            if agree.all():
                yield layout, messages, rows
                return
            if agree.any():
                yield layout, messages.chosen(agree), rows[agree]
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
