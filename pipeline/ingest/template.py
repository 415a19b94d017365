"""Messages of one layout decoded at once: fields gathered at fixed offsets, the rest of the layout proved.

A template is made by walking one message. It holds for another message of the same length if all bytes
that shaped the walk (length prefixes, tags) are the same there; that is checked on every message.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from pipeline.ingest.mcap_block import Block, Bytes, Ints, gathered

_MOST_TEMPLATES = 256  # layouts of one channel; beyond, messages are decoded one by one
_MOST_PER_LENGTH = 16

Values = npt.NDArray[Any] | pl.Series
Bools = npt.NDArray[np.bool_]


class Unfit(Exception):
    """A message or field that has no fixed layout, or not the type asked for."""


@dataclass(frozen=True)
class Fixed:
    """A number of fixed width."""

    offset: int
    dtype: str

    def values(self, data: Bytes, starts: Ints) -> Values:
        return gathered(data, starts + self.offset, self.dtype)


@dataclass(frozen=True)
class Flag:
    """A boolean in one byte."""

    offset: int

    def values(self, data: Bytes, starts: Ints) -> Values:
        return data[starts + self.offset] != 0


@dataclass(frozen=True)
class Varint:
    """A protobuf varint of known width; `zigzag` for sint32 and sint64."""

    offset: int
    width: int
    bits: int
    signed: bool
    zigzag: bool = False

    def values(self, data: Bytes, starts: Ints) -> Values:
        total = np.zeros(len(starts), dtype=np.uint64)
        for place in range(self.width):
            septet = (data[starts + self.offset + place] & 0x7F).astype(np.uint64)
            total |= septet << np.uint64(7 * place)
        if self.zigzag:
            return (total >> np.uint64(1)).astype(np.int64) ^ -(total & np.uint64(1)).astype(np.int64)
        if self.bits == 32:
            return total.astype(np.uint32).astype(np.int32 if self.signed else np.uint32)
        return total.astype(np.int64) if self.signed else total


@dataclass(frozen=True)
class Text:
    """A text of known length."""

    offset: int
    length: int

    def values(self, data: Bytes, starts: Ints) -> Values:
        count = len(starts)
        if self.length == 0:
            return pl.Series([""], dtype=pl.String).new_from_index(0, count)
        content = np.ascontiguousarray(gathered(data, starts + self.offset, f"V{self.length}"))
        offsets = np.arange(count + 1, dtype=np.int64) * self.length
        texts = pa.LargeStringArray.from_buffers(count, pa.py_buffer(offsets), pa.py_buffer(content))
        try:
            texts.validate(full=True)  # refuses what is not UTF-8
        except pa.ArrowInvalid:
            raise Unfit("a text is not UTF-8") from None
        return pl.Series(pl.from_arrow(texts))


@dataclass(frozen=True)
class Constant:
    """A field that messages of this layout leave out: its default, or null."""

    value: float | str | bool | None
    dtype: pl.DataType

    def values(self, data: Bytes, starts: Ints) -> Values:
        return pl.Series([self.value], dtype=self.dtype).new_from_index(0, len(starts))


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
    raise Unfit(f"not of type {dtype}")


@dataclass(frozen=True)
class Template:
    """Layout of messages of one length: 8-byte words that must agree under a mask, and the fields."""

    checks: Sequence[tuple[int, int, int]]
    fields: Mapping[str, Field]

    def matching(self, data: Bytes, starts: Ints) -> Bools:
        agree = np.ones(len(starts), dtype=np.bool_)
        for offset, mask, expected in self.checks:
            words = gathered(data, starts + offset, "<u8")
            if mask != _ALL:
                words &= np.uint64(mask)
            agree &= words == np.uint64(expected)
        return agree


_ALL = 2**64 - 1


def template_of(payload: bytes, static: bytearray, fields: Mapping[str, Field]) -> Template:
    """A template from one message; `static` masks the bits that shape the layout."""
    if len(payload) < 8:
        raise Unfit("too short")
    offsets = [*range(0, len(payload) - 8, 8), len(payload) - 8]
    checks = []
    for offset in offsets:
        mask = int.from_bytes(static[offset : offset + 8], "little")
        if mask:
            word = int.from_bytes(payload[offset : offset + 8], "little")
            checks.append((offset, mask, word & mask))
    return Template(checks, dict(fields))


Walk = Callable[[bytes], Template]
Part = tuple[Ints, Mapping[str, Values]]


class TemplateDecoder:
    """Decodes the messages of a channel by their layouts, which it learns as they come."""

    def __init__(self, walk: Walk) -> None:
        self._walk = walk
        self._templates: dict[int, list[Template]] = {}
        self._count = 0

    def decode(self, block: Block, rows: Ints) -> tuple[list[Part], Ints]:
        """Parts of the rows with their fields, and the rows that no layout fits."""
        parts: list[Part] = []
        left: list[Ints] = []
        for length, group in _by_length(block.length, rows):
            left.append(self._decode_group(block, length, group, parts))
        return parts, np.concatenate(left) if left else rows[:0]

    def _decode_group(self, block: Block, length: int, rows: Ints, parts: list[Part]) -> Ints:
        known = self._templates.setdefault(length, [])
        tried = 0
        while len(rows):
            if tried == len(known) and not self._learn(block, int(rows[0]), known):
                return rows
            template = known[tried]
            tried += 1
            agree = template.matching(block.data, block.start[rows])
            hits = rows if agree.all() else rows[agree]
            if len(hits):
                starts = block.start[hits]
                try:
                    values = {
                        path: field.values(block.data, starts) for path, field in template.fields.items()
                    }
                except Unfit:
                    return rows
                parts.append((hits, values))
            rows = rows[:0] if len(hits) == len(rows) else rows[~agree]
        return rows

    def _learn(self, block: Block, row: int, known: list[Template]) -> bool:
        if self._count >= _MOST_TEMPLATES or len(known) >= _MOST_PER_LENGTH:
            return False
        start = int(block.start[row])
        payload = block.data[start : start + int(block.length[row])].tobytes()
        try:
            known.append(self._walk(payload))
        except Unfit:
            return False
        self._count += 1
        return True


def _by_length(lengths: Ints, rows: Ints) -> list[tuple[int, Ints]]:
    """Rows grouped by the length of their payload."""
    chosen = lengths[rows]
    if not len(chosen):
        return []
    low, high = int(chosen.min()), int(chosen.max())
    if low == high:
        return [(low, rows)]
    return [(int(length), rows[chosen == length]) for length in np.unique(chosen)]
