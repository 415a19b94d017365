"""Fields at fixed places of messages of one layout, and how their values are taken from many at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from pipeline.ingest.mcap_block import Bytes
from schemas.arrays import Bools

Words = npt.NDArray[np.uint64]


@dataclass(frozen=True)
class Repeated:
    """One value for many messages."""

    value: float | str | bool | None
    count: int
    dtype: pl.DataType

    def series(self) -> pl.Series:
        return pl.Series([self.value], dtype=self.dtype).new_from_index(0, self.count)


Values = npt.NDArray[Any] | pl.Series | Repeated


class UnfitError(Exception):
    """A message or field that has no fixed layout, or not the type asked for."""


class Rows:
    """What a layout needs of messages of one length, side by side: stretches of bytes of each."""

    def __init__(self, count: int, stretches: Sequence[tuple[int, Bytes]]) -> None:
        self.count = count  # each stretch: its offset in the message, and one row of bytes per message
        self.stretches = stretches

    def at(self, offset: int, dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        """The values of `dtype` at this offset of every message."""
        for first, content in self.stretches:
            width = content.shape[1]
            if first <= offset < first + width:
                return np.ndarray((self.count,), dtype, content.data, offset=offset - first, strides=(width,))
        raise AssertionError("a layout asks for bytes that it did not name")

    def word(self, offset: int, width: int) -> Words:
        """The `width` bytes (at most 8) from this offset on as a little-endian number."""
        first, content = next(pair for pair in self.stretches if pair[0] <= offset < pair[0] + pair[1].shape[1])
        if content.shape[1] < 8:
            content = np.pad(content, ((0, 0), (8 - content.shape[1], 0)))
            first = offset + width - 8
        start = min(offset, first + content.shape[1] - 8)
        words: Words = Rows(self.count, [(first, content)]).at(start, "<u8") >> np.uint64(8 * (offset - start))
        return words & np.uint64(2 ** (8 * width) - 1)

    def chosen(self, rows: Bools) -> Rows:
        return Rows(int(rows.sum()), [(first, content[rows]) for first, content in self.stretches])


def joined_rows(parts: Sequence[Rows]) -> Rows:
    """Messages of one layout together."""
    if len(parts) == 1:
        return parts[0]
    stretches = [
        (first, np.concatenate([part.stretches[number][1] for part in parts]))
        for number, (first, _) in enumerate(parts[0].stretches)
    ]
    return Rows(sum(part.count for part in parts), stretches)


@dataclass(frozen=True)
class Fixed:
    """A number of fixed width."""

    offset: int
    dtype: str

    @property
    def end(self) -> int:
        return self.offset + int(self.dtype[2:])

    def values(self, rows: Rows) -> Values:
        return rows.at(self.offset, self.dtype)


@dataclass(frozen=True)
class Flag:
    """A boolean in one byte."""

    offset: int

    @property
    def end(self) -> int:
        return self.offset + 1

    def values(self, rows: Rows) -> Values:
        flags: Bools = rows.at(self.offset, "u1") != 0
        return flags


@dataclass(frozen=True)
class Varint:
    """A protobuf varint of known width; `zigzag` for sint32 and sint64."""

    offset: int
    width: int
    bits: int
    signed: bool
    zigzag: bool = False

    @property
    def end(self) -> int:
        return self.offset + self.width

    def values(self, rows: Rows) -> Values:
        total = _septets(rows.word(self.offset, min(self.width, 8)))
        for place in range(8, self.width):
            total |= (rows.at(self.offset + place, "u1") & 0x7F).astype(np.uint64) << np.uint64(7 * place)
        if self.zigzag:
            return (total >> np.uint64(1)).astype(np.int64) ^ -(total & np.uint64(1)).astype(np.int64)
        if self.bits == 32:
            return total.astype(np.uint32).astype(np.int32 if self.signed else np.uint32)
        return total.astype(np.int64) if self.signed else total


def _septets(words: Words) -> Words:
    """The lower seven bits of each of eight bytes, closed up."""
    words &= np.uint64(0x7F7F7F7F7F7F7F7F)
    for bits, low in ((1, 0x007F007F007F007F), (2, 0x00003FFF00003FFF), (4, 0x000000000FFFFFFF)):
        high = np.uint64(low << (8 * bits))
        words = (words & np.uint64(low)) | ((words & high) >> np.uint64(bits))
    return words


@dataclass(frozen=True)
class Text:
    """A text of known length."""

    offset: int
    length: int

    @property
    def end(self) -> int:
        return self.offset + self.length

    def values(self, rows: Rows) -> Values:
        if self.length == 0:
            return pl.Series([""], dtype=pl.String).new_from_index(0, rows.count)
        content = np.ascontiguousarray(rows.at(self.offset, f"V{self.length}"))
        offsets = np.arange(rows.count + 1, dtype=np.int64) * self.length
        texts = pa.LargeStringArray.from_buffers(rows.count, pa.py_buffer(offsets), pa.py_buffer(content))
        try:
            texts.validate(full=True)  # refuses what is not UTF-8
        except pa.ArrowInvalid:
            raise UnfitError("a text is not UTF-8") from None
        return pl.Series(pl.from_arrow(texts))


@dataclass(frozen=True)
class Constant:
    """A field that messages of this layout leave out: its default, or null."""

    value: float | str | bool | None
    dtype: pl.DataType

    @property
    def offset(self) -> int:
        return 0

    @property
    def end(self) -> int:
        return 0  # takes no bytes of the message

    def values(self, rows: Rows) -> Values:
        return Repeated(self.value, rows.count, self.dtype)


Field = Fixed | Flag | Varint | Text | Constant


def check_type(field: Field, dtype: pl.DataType) -> Field:
    """The field, if its values are of the kind asked for (whole numbers also serve as floats)."""
    number = isinstance(field, Varint) or (isinstance(field, Fixed) and field.dtype[1] in "iu")
    fits = {
        pl.Float64: isinstance(field, Fixed) or number,
        pl.Int64: number,
        pl.Boolean: isinstance(field, Flag),
        pl.String: isinstance(field, Text),
    }
    if isinstance(field, Constant) or fits[type(dtype)]:
        return field
    raise UnfitError(f"not of type {dtype}")
