"""The messages of a channel decoded by their layouts, which are learnt as they come."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain

import numpy as np
import polars as pl

from pipeline.read.ingest.layout import Columns, Decoded, Layout, UndecodableError, Values, undecodable
from pipeline.read.ingest.mcap_block import Bytes, Heads, Messages, joined_heads
from pipeline.read.ingest.mcap_records import Channel
from schemas.arrays import Ints

_MOST_LAYOUTS = 256  # of one channel that are kept
_LARGEST_KEPT = 1 << 16  # bytes of a message whose layout is kept


def _by_length(messages: Messages) -> Iterator[tuple[int, Messages, Ints]]:
    """The messages of each length, in order of the file, and their numbers among these."""
    longest = messages.longest
    if longest == messages.length.min():
        yield longest, messages, np.arange(len(messages))
        return
    # As narrow numbers: numpy sorts those of 16 bits in one pass.
    order = np.argsort(messages.length.astype(np.min_scalar_type(longest)), kind="stable")
    lengths = messages.length[order]
    for rows in np.split(order, np.flatnonzero(np.diff(lengths)) + 1):
        yield int(messages.length[rows[0]]), messages.chosen(rows), rows


@dataclass
class _Part:
    """A layout and, of the messages that wait, those that have it: their numbers, and their stretches by block;
    `usual`: whether all their texts are.
    """

    layout: Layout
    numbers: list[Ints] = field(default_factory=list)
    stretches: list[list[Bytes]] = field(default_factory=list)
    usual: bool = True

    def taken(self) -> _Part:
        """All of them, and they wait no more."""
        taken = replace(self)
        self.numbers = []
        self.stretches = []
        self.usual = True
        return taken


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
        self._layouts: dict[int, list[_Part]] = {}
        self._kept = 0
        self._alone: list[_Part] = []
        self._heads: list[Heads] = []
        self._count = 0  # messages that wait

    def add(self, messages: Messages) -> None:
        """Take what is needed of all messages."""
        heads = messages.heads(self._with_publish_time)
        self._heads.append(heads)
        self.waiting += sum(part.nbytes for part in heads if part is not None)
        for length, alike, numbers in _by_length(messages):
            self._by_layout(alike, numbers + self._count, self._layouts.setdefault(length, []))
        self._count += len(messages)

    def decoded(self) -> Iterator[Decoded]:
        """The fields of all messages that wait, in order of the file."""
        if not self._count:
            return
        heads = joined_heads(self._heads)
        known = chain.from_iterable(self._layouts.values())
        parts = [*self._alone, *(part.taken() for part in known if part.numbers)]
        self._heads.clear()
        self._alone.clear()
        self._count = self.waiting = 0
        yield _merged(heads, [(part, self._columns(part, heads)) for part in parts])

    def _by_layout(self, left: Messages, numbers: Ints, known: list[_Part]) -> None:
        """Let messages of one length wait by their layouts; where none fits, one is learnt of the first message left.

        `numbers`: of the messages among all that wait; `known`: the layouts of this length, extended here.
        """
        tried = 0
        while len(left):
            if tried == len(known) and not self._learn(left, known):
                self._keep_first(left, numbers)
                left, numbers = left.chosen(slice(1, None)), numbers[1:]
                continue
            part = known[tried]
            rows = part.layout.rows(left)
            usual = part.layout.are_usual(rows)
            agree = None if usual else part.layout.of(rows)
            if agree is None:
                self._keep(part, numbers, rows, usual)
                return
            if agree.any():
                self._keep(part, numbers[agree], [stretch[agree] for stretch in rows], usual)
            left, numbers = left.chosen(~agree), numbers[~agree]
            tried += 1

    def _keep(self, part: _Part, numbers: Ints, rows: list[Bytes], usual: bool) -> None:
        """Let messages of one layout wait: their numbers and, per stretch, their bytes (`rows`)."""
        part.numbers.append(numbers)
        part.stretches.append(rows)
        part.usual = part.usual and usual
        self.waiting += numbers.nbytes + sum(stretch.nbytes for stretch in rows)

    def _learn(self, messages: Messages, known: list[_Part]) -> bool:
        """Whether the layout of the first message is known from now on."""
        if self._kept >= _MOST_LAYOUTS or messages.length[0] > _LARGEST_KEPT:
            return False
        known.append(_Part(self._layout_of_first(messages)))
        self._kept += 1
        return True

    def _keep_first(self, messages: Messages, numbers: Ints) -> None:
        """The first message by itself."""
        self.slow_messages += 1
        layout = self._layout_of_first(messages)
        self._alone.append(_Part(layout))
        self._keep(self._alone[-1], numbers[:1], layout.rows(messages.chosen(slice(1))), usual=True)

    def _layout_of_first(self, messages: Messages) -> Layout:
        """The layout by walking the first message. Raises `InputError` where it cannot be decoded."""
        try:
            return self._walk(messages.payload(0))
        except UndecodableError as error:
            raise undecodable(self._channel, messages.log_time[0], error) from None

    def _columns(self, part: _Part, heads: Heads) -> Columns:
        """The fields of the messages of one layout."""
        try:
            return part.layout.values(part.stretches, part.usual)
        except UndecodableError:
            stretches = [np.concatenate(of_blocks) for of_blocks in zip(*part.stretches, strict=True)]
        for row, number in enumerate(np.concatenate(part.numbers)):  # one of them cannot be decoded
            try:
                part.layout.values([[stretch[row : row + 1] for stretch in stretches]], part.usual)
            except UndecodableError as error:
                raise undecodable(self._channel, heads.log_time[number], error) from None
        raise AssertionError("messages that can be decoded one by one cannot be decoded together")


def _merged(heads: Heads, parts: Sequence[tuple[_Part, Columns]]) -> Decoded:
    """The rows of all layouts, in order of their messages."""
    if len(parts) == 1 and parts[0][0].layout.count == 1:
        return heads, parts[0][1]
    filled = [(part, columns) for part, columns in parts if part.layout.count]
    of_parts = [part for part, _ in filled]
    rows, places = _places(heads, of_parts)
    columns: dict[str, Values] = {}
    for path in parts[0][1] if filled else ():
        columns[path] = _at_places([of_part[path] for _, of_part in filled], places, _same(path, of_parts))
    return rows, columns


def _places(heads: Heads, parts: Sequence[_Part]) -> tuple[Heads, Ints]:
    """The heads of all rows in order, and the places among them of the rows of one layout after the other."""
    if not parts:
        return heads.chosen(slice(0)), np.empty(0, dtype=np.int64)
    numbers = [np.concatenate(part.numbers) for part in parts]
    counts = np.zeros(len(heads.ordinal), dtype=np.int64)
    for part, of_part in zip(parts, numbers, strict=True):
        counts[of_part] = part.layout.count
    if counts.min() == counts.max() == 1:
        return heads, np.concatenate(numbers)
    first = np.cumsum(counts) - counts
    pairs = zip(parts, numbers, strict=True)
    places = [np.add.outer(first[of_part], np.arange(part.layout.count)).ravel() for part, of_part in pairs]
    return heads.chosen(np.repeat(np.arange(len(counts)), counts)), np.concatenate(places)


def _same(path: str, parts: Sequence[_Part]) -> pl.Series | None:
    """The one value that all give a field in every row; none where they do not."""
    first, *others = [part.layout.constant(path, part.usual) for part in parts]
    return first if first is not None and all(other is not None and other.equals(first) for other in others) else None


def _at_places(values: Sequence[Values], places: Ints, constant: pl.Series | None) -> Values:
    """The values one after the other, put to these places."""
    arrays = [part for part in values if isinstance(part, np.ndarray)]
    if len(arrays) == len(values):
        joined = np.concatenate(arrays)
        placed = np.empty_like(joined)
        placed[places] = joined
        return placed
    if constant is not None:
        return constant.new_from_index(0, len(places))
    order = np.empty_like(places)
    order[places] = np.arange(len(places))
    return pl.concat([pl.Series(part) for part in values]).gather(order)
