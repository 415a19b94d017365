"""JSON messages to columns: at once where all hold the same fields, else by pyarrow.

Both hold every value against the type asked for. What pyarrow refuses or may misread (a text over several lines, 9.0
for a whole number) is parsed message by message.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Literal

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.json

from pipeline.read.ingest.json_typed import TypedMessages, typed_messages
from pipeline.read.ingest.layout import Columns, Decoded, UndecodableError, Values, parse_path, undecodable
from pipeline.read.ingest.mcap_block import Heads, Messages, joined_heads
from pipeline.read.ingest.mcap_records import Channel
from schemas.arrays import Ints

_ARROW = {pl.Float64: pa.float64(), pl.Int64: pa.int64(), pl.Boolean: pa.bool_(), pl.String: pa.string()}
# Literals that pyarrow takes and JSON does not know, and `null` after an object, which pyarrow does not survive.
_LITERALS = (b"NaN", b"Inf")
_AS_VALUE = re.compile(rb"[:,\[]\s*-?(?:NaN|Inf)")
_NULL_AFTER = re.compile(rb"\}\s*null")


class JsonDecoder:
    """Decodes the messages of a channel; `slow_messages`: those parsed one by one; `waiting`: bytes that wait for it.

    Raises `InputError` for a message that cannot be decoded.
    """

    def __init__(self, channel: Channel, types: Mapping[str, pl.DataType], with_publish_time: bool = False) -> None:
        self.slow_messages = 0
        self.waiting = 0
        self._with_publish_time = with_publish_time
        self._channel = channel
        self._types = types
        tree: dict[str, Any] = {}
        for path, dtype in types.items():
            *above, last = parse_path(path)
            node = tree
            for step in above:
                node = node.setdefault("[]" if isinstance(step, int) else step, {})
            node["[]" if isinstance(last, int) else last] = _ARROW[type(dtype)]
        self._schema = pa.schema(list(_arrow_fields(tree)))
        self._first_schema: pa.Schema | None = None  # what of it the first messages held, while no other has held more
        self._narrow = True
        self._typed: TypedMessages | None = None  # while all messages hold what the first did
        self._is_first = True
        self._content: list[memoryview] = []
        self._lengths: list[Ints] = []
        self._heads: list[Heads] = []

    def add(self, messages: Messages) -> None:
        """Take the texts of all messages."""
        text = _with_byte_before(messages)
        self._content.append(text)
        self._lengths.append(messages.length)
        self._heads.append(messages.heads(self._with_publish_time))
        self.waiting += len(text)

    def decoded(self) -> Iterator[Decoded]:
        """The fields of all messages that wait."""
        if not self.waiting:
            return
        texts = _Texts(bytearray().join(self._content), np.concatenate(self._lengths))
        heads = joined_heads(self._heads)
        self.waiting = 0
        self._content.clear()
        self._lengths.clear()
        self._heads.clear()
        columns = self._at_once(texts) if texts.are_between_braces() else None
        if columns is None:
            self.slow_messages += len(texts)
            columns = one_by_one(self._channel, texts, heads.log_time, self._types)
        yield heads, columns

    def _at_once(self, texts: _Texts) -> Columns | None:
        """The fields of messages each between braces: as many objects as messages are then one each."""
        if self._is_first:
            self._is_first = False
            with suppress(UndecodableError):
                self._typed = typed_messages(self._types, parse_json(next(iter(texts))))
        if self._typed is not None:
            columns = self._typed.columns(texts.content, len(texts))
            if columns is not None:
                return columns
            self._typed = None
        try:
            table = self._parse_with_arrow(texts.content) if texts.are_plain() else None
        except pa.ArrowInvalid:
            return None
        return self._columns_of_table(table) if table is not None and table.num_rows == len(texts) else None

    def _columns_of_table(self, table: pa.Table) -> Columns:
        """The fields that were asked for, null where no message has them."""
        frame = pl.DataFrame(pl.from_arrow(table))
        present = {path: dtype for path, dtype in self._types.items() if parse_path(path)[0] in frame.columns}
        columns: dict[str, Values] = {**frame.select(_value_expression(path).alias(path) for path in present).to_dict()}
        for path, dtype in self._types.items():
            if path not in present:
                columns[path] = pl.Series([None], dtype=dtype).new_from_index(0, len(table))
        return columns

    def _parse_with_arrow(self, content: bytearray) -> pa.Table:
        """The messages as a table.

        Columns that the first messages lacked are left out as long as no message has one: each costs a message time.
        """
        if self._first_schema is not None:
            try:
                return _read_with_arrow(content, self._first_schema, "error")
            except pa.ArrowInvalid:
                self._first_schema = None
        table = _read_with_arrow(content, self._schema, "ignore")
        if self._narrow:
            self._narrow = False
            filled = [field for field in self._schema if table[field.name].null_count < len(table)]
            self._first_schema = pa.schema(filled) if filled else None
        return table


def one_by_one(
    channel: Channel, payloads: Iterable[bytes], log_times: Iterable[int], types: Mapping[str, pl.DataType]
) -> Columns:
    """The fields by Python's own parser. Raises `InputError` for the first message that cannot be decoded."""
    steps = {path: parse_path(path) for path in types}
    values: dict[str, list[Any]] = {path: [] for path in types}
    for payload, log_time in zip(payloads, log_times, strict=True):
        try:
            document = parse_json(payload)
            for path, dtype in types.items():
                values[path].append(_fit_value(_value_at(document, steps[path]), dtype))
        except UndecodableError as error:
            raise undecodable(channel, log_time, error) from None
    return {path: pl.Series(path, column, dtype=types[path]) for path, column in values.items()}


def _read_with_arrow(content: bytearray, schema: pa.Schema, unexpected: Literal["error", "ignore"]) -> pa.Table:
    """JSON lines as a table of this schema."""
    return pa.json.read_json(
        pa.BufferReader(content),
        read_options=pa.json.ReadOptions(use_threads=False, block_size=len(content) + 1),
        parse_options=pa.json.ParseOptions(explicit_schema=schema, unexpected_field_behavior=unexpected),
    )


def _arrow_fields(tree: Mapping[str, Any]) -> list[pa.Field]:
    """Fields of a tree of names."""
    return [pa.field(name, _arrow_type(node)) for name, node in tree.items()]


def _arrow_type(node: Any) -> pa.DataType:
    """Type of a node of a tree of names."""
    if not isinstance(node, dict):
        return node
    return pa.list_(_arrow_type(node["[]"])) if "[]" in node else pa.struct(_arrow_fields(node))


def _value_expression(path: str) -> pl.Expr:
    """Expression for the value at a path."""
    first, *steps = parse_path(path)
    value = pl.col(str(first))
    for step in steps:
        value = value.list.get(step, null_on_oob=True) if isinstance(step, int) else value.struct.field(step)
    return value


class _Texts:
    """The texts of messages, one after the other, on a line each; `content` has a byte before each for that."""

    def __init__(self, content: bytearray, lengths: Ints) -> None:
        self.content = content
        self.lengths = lengths
        self._ends = np.cumsum(lengths + 1)
        self._bytes = np.frombuffer(content, dtype=np.uint8)
        self._bytes[self._ends - lengths - 1] = ord("\n")

    def __len__(self) -> int:
        """Number of texts."""
        return len(self.lengths)

    def __iter__(self) -> Iterator[bytes]:
        """The texts in order."""
        for end, length in zip(self._ends.tolist(), self.lengths.tolist(), strict=True):
            yield bytes(self.content[end - length : end])

    def are_plain(self) -> bool:
        """Whether all is UTF-8, and nothing in it that pyarrow would misread."""
        content = self.content
        # A letter is found ten times as fast as a word.
        strange = any(word[:1] in content and word in content for word in _LITERALS) and _AS_VALUE.search(content)
        return not (strange or (b"null" in content and _NULL_AFTER.search(content))) and _is_utf8(content)

    def are_between_braces(self) -> bool:
        """Whether each is something between braces, but for white space around it."""
        if not self.lengths.all():
            return False
        starts = self._ends - self.lengths
        others = (self._bytes[starts] != ord("{")) | (self._bytes[self._ends - 1] != ord("}"))
        cuts = zip(starts[others].tolist(), self._ends[others].tolist(), strict=True)
        texts = (self.content[start:end].strip(b" \t\r\n") for start, end in cuts)
        return all(text[:1] == b"{" and text[-1:] == b"}" for text in texts)


def _with_byte_before(messages: Messages) -> memoryview:
    """The payloads side by side, each with the last byte of the head before it: room for a new line."""
    bounds = np.column_stack([messages.start - 1, messages.start + messages.length]).reshape(-1)
    buffers = [None, pa.py_buffer(np.append(bounds, bounds[-1])), pa.py_buffer(messages.data)]
    parts = pa.LargeBinaryArray.from_buffers(pa.large_binary(), len(bounds), buffers)
    # Between them are the heads of records. Not `pa.array`: it imports pandas, where that is installed.
    every_other = pl.int_range(0, len(bounds), 2, eager=True)
    taken = parts.take(every_other.to_arrow())
    return memoryview(taken.buffers()[2])[: int(messages.length.sum()) + len(messages)]


def _is_utf8(content: bytearray) -> bool:
    """Whether all bytes are UTF-8."""
    if content.isascii():
        return True
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return True


def parse_json(payload: bytes) -> Any:
    """One JSON document; literals that are not JSON (NaN, Infinity) and doubled names are refused."""
    try:
        return json.loads(payload, parse_constant=_refuse_literal, object_pairs_hook=_object_without_doubles)
    except (ValueError, RecursionError) as error:
        raise UndecodableError(f"not JSON: {error}") from None


def _object_without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object; of two values under one name, nobody can say which is meant."""
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError("a name occurs twice in one object")
    return members


def _refuse_literal(literal: str) -> Any:
    """Refuse a literal that is not JSON."""
    raise ValueError(f"the literal {literal}")


def _value_at(document: Any, steps: list[str | int]) -> Any:
    """The value at a path, none where there is none."""
    value = document
    for step in steps:
        if isinstance(step, str):
            value = value.get(step) if isinstance(value, dict) else None
        else:
            value = value[step] if isinstance(value, list) and step < len(value) else None
    return value


# What values of a type may be, and how the type is called.
_KINDS: dict[type[pl.DataType], tuple[type, str]] = {
    pl.Float64: (float, "a number"),
    pl.Int64: (int, "a 64-bit integer"),
    pl.String: (str, "text"),
    pl.Boolean: (bool, "true or false"),
}


def _fit_value(value: Any, dtype: pl.DataType) -> Any:
    """The value in the type asked for: whole numbers also serve as floats and as ids, which are texts, and floats that
    are whole as integers.
    """
    kind, name = _KINDS[type(dtype)]
    fits = value is None or type(value) is kind
    if fits and (kind is not int or value is None or -(2**63) <= value < 2**63):
        return value
    if kind is float and type(value) is int and abs(value) < 2**1023:
        return float(value)
    if kind is str and type(value) is int and value.bit_length() <= 64:
        return str(value)
    if kind is int and type(value) is float and value.is_integer() and abs(value) < 2**53:
        return int(value)
    # Python does not even write integers of 4,300 digits.
    long = isinstance(value, int) and value.bit_length() > 1024
    shown = f"an integer of {value.bit_length()} bits" if long else repr(value)[:80]
    raise UndecodableError(f"{shown} is not {name}")
