"""Messages of one layout decoded at once: fields gathered at fixed offsets, the rest of the layout proved.

A layout is made by walking one message. It holds for another message of the same length if all bytes
that shaped the walk (length prefixes, tags) are the same there; that is checked on every message.
There is no other way to decode: a message like no other is walked for itself.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa

from pipeline.read.ingest.mcap_block import Bytes, Heads, Messages
from pipeline.read.ingest.mcap_records import Channel
from schemas.arrays import Bools
from schemas.errors import InputError
from schemas.frozen import frozen

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
    """Where a value lies in each message, and how it is taken from these bytes of each message, in rows by block.

    `constant`: the one value of all messages, as a series of one row, where the layout leaves no other.
    """

    kind: type[pl.DataType]
    start: int
    end: int
    take: Callable[[Sequence[Bytes]], Values]
    constant: pl.Series | None = None

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

    # Nothing is lost where they become numbers of 64 bits.
    wide = "<f8" if kind is pl.Float64 else dtype if dtype.endswith("8") else "<i8"

    def take(blocks: Sequence[Bytes]) -> Values:
        """The numbers of all blocks, 64 bits wide."""
        return np.concatenate([rows.view(dtype)[:, 0] for rows in blocks], dtype=wide)

    return Field(kind, offset, offset + int(dtype[2:]), take)


def flag(offset: int) -> Field:
    """A boolean in one byte."""
    return Field(pl.Boolean, offset, offset + 1, lambda blocks: np.concatenate(blocks)[:, 0] != 0)


def text(offset: int, length: int) -> Field:
    """A text of known length."""
    return Field(pl.String, offset, offset + length, lambda blocks: _texts(np.concatenate(blocks)))


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
    return _always(pl.Series([value], dtype=dtype, strict=False))


def _always(value: pl.Series) -> Field:
    """The value of one row in all messages."""
    number = value.to_numpy() if value.dtype.is_numeric() and not value.null_count() else None

    def take(blocks: Sequence[Bytes]) -> Values:
        """The value once for each message."""
        count = sum(map(len, blocks))
        return value.new_from_index(0, count) if number is None else number.repeat(count)

    return Field(type(value.dtype), 0, 0, take, value)


class BytePattern:
    """What the bytes of a stretch must be under a mask."""

    def __init__(self, mask: Bytes, expected: Bytes) -> None:
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


class ByteStretch(NamedTuple):
    """Bytes of a message that are taken together; what they must be, and what they are where all texts are those of
    the message that the layout was made of.
    """

    start: int
    end: int
    required: BytePattern
    usual: BytePattern


@frozen
class Layout:
    """Of messages of one length: where they hold the fields, in the order of the rows that they make (mostly one),
    and the stretches that hold these and all that shapes the layout. `usual_fields`: as `fields`, of messages with the
    texts of the one that the layout was made of.
    """

    fields: Mapping[str, Sequence[Field]]
    usual_fields: Mapping[str, Sequence[Field]]
    stretches: Sequence[ByteStretch]

    @property
    def count(self) -> int:
        """Rows that each message makes."""
        return max(map(len, self.fields.values()), default=1)

    def rows(self, messages: Messages) -> list[Bytes]:
        """Each stretch of each message."""
        return [messages.stretches(stretch.start, stretch.end) for stretch in self.stretches]

    def are_usual(self, stretches: Sequence[Bytes]) -> bool:
        """Whether all messages have this layout, and the usual texts."""
        pairs = zip(self.stretches, stretches, strict=True)
        return all(stretch.usual.unlike(rows) is None for stretch, rows in pairs)

    def of(self, stretches: Sequence[Bytes]) -> Bools | None:
        """Which messages have this layout; None where all have."""
        found = [stretch.required.unlike(rows) for stretch, rows in zip(self.stretches, stretches, strict=True)]
        unlike = [rows for rows in found if rows is not None]
        return ~np.logical_or.reduce(unlike) if unlike else None

    def values(self, blocks: Sequence[Sequence[Bytes]], usual: bool) -> Columns:
        """The fields of messages that have this layout, and the `usual` texts, for each row that they make; `blocks`:
        their stretches.
        """
        starts = [stretch.start for stretch in self.stretches]

        def values(field: Field) -> Values:
            """The values of one field, from the stretch that holds its bytes."""
            number = bisect_right(starts, field.start) - 1
            places = slice(field.start - starts[number], field.end - starts[number])
            return field.values([stretches[number][:, places] for stretches in blocks])

        fields = self.usual_fields if usual else self.fields
        return {path: _in_turn([*map(values, of_path)]) for path, of_path in fields.items()}

    def constant(self, path: str, usual: bool) -> pl.Series | None:
        """The value that a field has in every row of such messages; none where it may differ."""
        fields = (self.usual_fields if usual else self.fields)[path]
        return fields[0].constant if len(fields) == 1 else None


def _in_turn(columns: Sequence[Values]) -> Values:
    """The first value of each, then the second of each, and so on."""
    if len(columns) == 1:
        return columns[0]
    return np.column_stack([*map(np.asarray, columns)]).ravel() if columns else np.empty(0)


def layout_of(payload: bytes, static: bytearray, fields: Mapping[str, Sequence[Field]]) -> Layout:
    """From one message; `static` masks the bits that shape the layout."""
    required = np.frombuffer(static, dtype=np.uint8)
    usual = required.copy()
    content = np.frombuffer(payload, dtype=np.uint8)
    used = required != 0
    for field in chain.from_iterable(fields.values()):
        used[field.start : field.end] = True
        if field.kind is pl.String:
            usual[field.start : field.end] = 0xFF
    places = np.flatnonzero(used)
    stretches = []
    for part in np.split(places, np.flatnonzero(np.diff(places) > _NEAR) + 1):
        start, end = (int(part[0]), int(part[-1]) + 1) if len(part) else (0, 0)
        patterns = (BytePattern(mask[start:end], content[start:end]) for mask in (required, usual))
        stretches.append(ByteStretch(start, end, *patterns))
    usual_fields = {path: [_usual(field, content) for field in of_path] for path, of_path in fields.items()}
    return Layout(fields, usual_fields, stretches)


def _usual(field: Field, content: Bytes) -> Field:
    """The field where its text is that of a message."""
    if field.kind is not pl.String or field.constant is not None:
        return field
    return _always(pl.Series(field.take([content[None, field.start : field.end]])))
