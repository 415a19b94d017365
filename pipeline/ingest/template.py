"""Messages of one layout decoded at once: fields gathered at fixed offsets, the rest of the layout proved.

A template is made by walking one message. It holds for another message of the same length if all bytes
that shaped the walk (length prefixes, tags) are the same there; that is checked on every message.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from pipeline.ingest.mcap_block import Bytes, Ints, Messages, stretches_of

_MOST_TEMPLATES = 256  # layouts of one channel; beyond, messages are decoded one by one
_MOST_PER_LENGTH = 16

Values = npt.NDArray[Any] | pl.Series
Bools = npt.NDArray[np.bool_]


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
        total = np.zeros(rows.count, dtype=np.uint64)
        for place in range(self.width):
            septet = (rows.at(self.offset + place, "u1") & 0x7F).astype(np.uint64)
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
        return pl.Series([self.value], dtype=self.dtype).new_from_index(0, rows.count)


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


@dataclass(frozen=True)
class Template:
    """Layout of messages of one length: 8-byte words that must agree under a mask, and the fields."""

    checks: Sequence[tuple[int, int, int]]
    fields: Mapping[str, Field]
    stretches: Sequence[tuple[int, int]]

    def rows(self, data: Bytes, starts: Ints) -> Rows:
        return Rows(
            len(starts), [(first, stretches_of(data, starts + first, end - first)) for first, end in self.stretches]
        )

    def matching(self, rows: Rows) -> Bools:
        agree = np.ones(rows.count, dtype=np.bool_)
        for offset, mask, expected in self.checks:
            words = rows.at(offset, "<u8")
            if mask != _ALL:
                words = words & np.uint64(mask)
            agree &= words == np.uint64(expected)
        return agree

    def values(self, rows: Rows) -> dict[str, Values]:
        return {path: item.values(rows) for path, item in self.fields.items()}


_ALL = 2**64 - 1
_NEAR = 64  # bytes between two fields that are cheaper to copy along than to go for twice


def template_of(payload: bytes, static: bytearray, fields: Mapping[str, Field]) -> Template:
    """A template from one message; `static` masks the bits that shape the layout."""
    if len(payload) < 8:
        raise UnfitError("too short")
    offsets = [*range(0, len(payload) - 8, 8), len(payload) - 8]
    checks = []
    for offset in offsets:
        mask = int.from_bytes(static[offset : offset + 8], "little")
        if mask:
            word = int.from_bytes(payload[offset : offset + 8], "little")
            checks.append((offset, mask, word & mask))
    extents = [(offset, offset + 8) for offset, _, _ in checks]
    extents += [(item.offset, item.end) for item in fields.values() if item.end > item.offset]
    return Template(checks, dict(fields), _stretches(extents))


def _stretches(extents: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Extents that overlap or are near each other, as one."""
    merged: list[tuple[int, int]] = []
    for first, end in sorted(extents):
        if merged and first <= merged[-1][1] + _NEAR:
            merged[-1] = (merged[-1][0], max(merged[-1][1], end))
        else:
            merged.append((first, end))
    return merged


Walk = Callable[[bytes], Template]


@dataclass(frozen=True)
class Part:
    """Decoded messages, or messages whose layout is proved and whose fields are still to be taken."""

    messages: Messages
    values: Mapping[str, Values] = field(default_factory=dict)
    template: Template | None = None
    rows: Rows = field(default_factory=lambda: Rows(0, []))


class TemplateDecoder:
    """Decodes the messages of a channel by their layouts, which it learns as they come."""

    def __init__(self, walk: Walk) -> None:
        self._walk = walk
        self._templates: dict[int, list[Template]] = {}
        self._count = 0

    def decode(self, messages: Messages) -> tuple[list[Part], list[Messages]]:
        """Messages whose layout is known, and those that no layout fits."""
        parts: list[Part] = []
        left = [rest for length, group in _by_length(messages) if len(rest := self._decode_group(length, group, parts))]
        return parts, left

    def _decode_group(self, length: int, messages: Messages, parts: list[Part]) -> Messages:
        known = self._templates.setdefault(length, [])
        tried = 0
        while len(messages):
            if tried == len(known) and not self._learn(messages.payload(0), known):
                break
            template = known[tried]
            tried += 1
            rows = template.rows(messages.data, messages.start)
            agree = template.matching(rows)
            if agree.all():
                parts.append(Part(messages, template=template, rows=rows))
                return messages.chosen(~agree)
            if agree.any():
                parts.append(Part(messages.chosen(agree), template=template, rows=rows.chosen(agree)))
                messages = messages.chosen(~agree)
        return messages

    def _learn(self, payload: bytes, known: list[Template]) -> bool:
        if self._count >= _MOST_TEMPLATES or len(known) >= _MOST_PER_LENGTH:
            return False
        try:
            known.append(self._walk(payload))
        except UnfitError:
            return False
        self._count += 1
        return True


def _by_length(messages: Messages) -> list[tuple[int, Messages]]:
    """Messages grouped by the length of their payload."""
    lengths = messages.length
    low, high = int(lengths.min()), int(lengths.max())
    if low == high:
        return [(low, messages)]
    met = np.flatnonzero(np.bincount(lengths - low)) + low if high - low < _COUNTABLE else np.unique(lengths)
    return [(int(length), messages.chosen(lengths == length)) for length in met]


_COUNTABLE = 1 << 16
