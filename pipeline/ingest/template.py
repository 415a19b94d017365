"""Messages of one layout decoded at once: fields gathered at fixed offsets, the rest of the layout proved.

A template is made by walking one message. It holds for another message of the same length if all bytes
that shaped the walk (length prefixes, tags) are the same there; that is checked on every message.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pipeline.ingest.layout import Field, Rows, UnfitError, Values
from pipeline.ingest.mcap_block import Bytes, Messages, stretches_of
from schemas.arrays import Bools, Ints

_MOST_TEMPLATES = 256  # layouts of one channel; beyond, messages are decoded one by one
_MOST_PER_LENGTH = 16
_MOST_ASIDE = 8  # messages without layout that may come before one that has a layout


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
        left: list[Messages] = []
        for length, group in _by_length(messages):
            rest = self._decode_group(length, group, parts, left)
            left += [rest] if rest else []
        return parts, left

    def _decode_group(
        self, length: int, messages: Messages, parts: list[Part], aside: list[Messages]
    ) -> Messages | None:
        """Messages of one length into `parts` and `aside`; those that are left."""
        known = self._templates.setdefault(length, [])
        tried = 0
        while len(messages):
            if tried == len(known) and not self._learn(messages.payload(0), known):
                if len(aside) >= _MOST_ASIDE:
                    break
                aside.append(messages.chosen(np.arange(1)))
                messages = messages.chosen(np.arange(1, len(messages)))
                continue
            template = known[tried]
            tried += 1
            rows = template.rows(messages.data, messages.start)
            agree = template.matching(rows)
            if agree.all():
                parts.append(Part(messages, template=template, rows=rows))
                return None
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
