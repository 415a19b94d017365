"""Columnar decoding of JSON messages by pyarrow, whose parser holds every value against the type asked for."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.json

from pipeline.read.ingest.generic import parse_path
from pipeline.read.ingest.layout import Columns, Values
from pipeline.read.ingest.mcap_block import Bytes, Messages
from schemas.arrays import Ints

_ARROW = {pl.Float64: pa.float64(), pl.Int64: pa.int64(), pl.Boolean: pa.bool_(), pl.String: pa.string()}
# Literals that pyarrow takes and JSON does not know, and `null` after an object, which pyarrow does not survive.
_LITERALS = (b"NaN", b"Inf")
_AS_VALUE = re.compile(rb"[:,\[]\s*-?(?:NaN|Inf)")
_NULL_AFTER = re.compile(rb"\}\s*null")


class JsonDecoder:
    """Decodes the messages of a channel; whatever pyarrow refuses is left to the ordinary parser."""

    def __init__(self, types: Mapping[str, pl.DataType]) -> None:
        self._types = types
        tree: dict[str, Any] = {}
        for path, dtype in types.items():
            *above, last = parse_path(path)
            node = tree
            for step in above:
                node = node.setdefault("[]" if isinstance(step, int) else step, {})
            node["[]" if isinstance(last, int) else last] = _ARROW[type(dtype)]
        self._schema = pa.schema(list(_struct(tree)))
        self._met: pa.Schema | None = None  # what of it the first messages held, while no other has held more
        self._narrow = True

    def decode(self, messages: Messages) -> tuple[list[tuple[Messages, Columns]], list[Messages]]:
        """All messages as columns, or all of them left over."""
        content = _joined(messages)
        if content is None:
            return [], [messages]
        try:
            table = self._parsed(content)
        except pa.ArrowInvalid:
            return [], [messages]
        # Every payload starts and ends as an object does: so many objects as messages are one each.
        if table.num_rows != len(messages):
            return [], [messages]
        frame = pl.DataFrame(pl.from_arrow(table))
        met = {path: dtype for path, dtype in self._types.items() if parse_path(path)[0] in frame.columns}
        columns: dict[str, Values] = {**frame.select(_value(path).alias(path) for path in met).to_dict()}
        for path, dtype in self._types.items():
            if path not in met:
                columns[path] = pl.Series([None], dtype=dtype).new_from_index(0, len(messages))
        return [(messages, columns)], []

    def _parsed(self, content: bytearray) -> pa.Table:
        """Without the columns that the first messages lacked, as long as none has more: each costs a message time."""
        if self._met is not None:
            try:
                return _read(content, self._met, "error")
            except pa.ArrowInvalid:
                self._met = None
        table = _read(content, self._schema, "ignore")
        if self._narrow:
            self._narrow = False
            filled = [field for field in self._schema if table[field.name].null_count < len(table)]
            self._met = pa.schema(filled) if filled else None
        return table


def _read(content: bytearray, schema: pa.Schema, unexpected: Literal["error", "ignore"]) -> pa.Table:
    return pa.json.read_json(
        pa.BufferReader(content),
        read_options=pa.json.ReadOptions(use_threads=False, block_size=len(content) + 1),
        parse_options=pa.json.ParseOptions(explicit_schema=schema, unexpected_field_behavior=unexpected),
    )


def _struct(tree: Mapping[str, Any]) -> list[pa.Field]:
    return [pa.field(name, _type(node)) for name, node in tree.items()]


def _type(node: Any) -> pa.DataType:
    if not isinstance(node, dict):
        return node
    return pa.list_(_type(node["[]"])) if "[]" in node else pa.struct(_struct(node))


def _value(path: str) -> pl.Expr:
    first, *steps = parse_path(path)
    value = pl.col(str(first))
    for step in steps:
        value = value.list.get(step, null_on_oob=True) if isinstance(step, int) else value.struct.field(step)
    return value


def _joined(messages: Messages) -> bytearray | None:
    """The payloads, one after the other; none if any is not the UTF-8 text of something between braces."""
    content = bytearray().join(_with_byte_before(*part) for part in messages.by_piece())
    ends = np.cumsum(messages.length + 1)
    np.frombuffer(content, dtype=np.uint8)[ends - messages.length - 1] = ord("\n")
    # A letter is found ten times as fast as a word.
    strange = any(word[:1] in content and word in content for word in _LITERALS) and _AS_VALUE.search(content)
    if strange or (b"null" in content and _NULL_AFTER.search(content)) or not _is_utf8(content):
        return None
    return content if _all_between_braces(messages) else None


def _with_byte_before(piece: Bytes, starts: Ints, ends: Ints) -> memoryview:
    """The payloads of one piece side by side, each with the last byte of the head before it: room for a new line."""
    bounds = np.column_stack([starts - 1, ends]).reshape(-1)
    buffers = [None, pa.py_buffer(np.append(bounds, bounds[-1])), pa.py_buffer(piece)]
    parts = pa.LargeBinaryArray.from_buffers(pa.large_binary(), len(bounds), buffers)
    # Between them are the heads of records. Not `pa.array`: it imports pandas, where that is installed.
    every_other = pl.int_range(0, len(bounds), 2, eager=True)
    taken = parts.take(every_other.to_arrow())
    return memoryview(taken.buffers()[2])[: int((ends - starts).sum()) + len(starts)]


def _all_between_braces(messages: Messages) -> bool:
    """Whether the text of every message is something between braces, but for white space around it."""
    if not messages.length.all():
        return False
    ends = [(piece[starts] == ord("{")) & (piece[ends - 1] == ord("}")) for piece, starts, ends in messages.by_piece()]
    texts = (messages.payload(row).strip(b" \t\r\n") for row in np.flatnonzero(~np.concatenate(ends)).tolist())
    return all(text[:1] == b"{" and text[-1:] == b"}" for text in texts)


def _is_utf8(content: bytearray) -> bool:
    if content.isascii():
        return True
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return True
