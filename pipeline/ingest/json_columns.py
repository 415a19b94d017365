"""Columnar decoding of JSON messages by pyarrow, whose parser holds every value against the type asked for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.json

from pipeline.ingest.generic import parse_path
from pipeline.ingest.mcap_block import Messages
from pipeline.ingest.template import Part

_ARROW = {pl.Float64: pa.float64(), pl.Int64: pa.int64(), pl.Boolean: pa.bool_(), pl.String: pa.string()}
# Literals that are no JSON but that pyarrow takes, and `null` between two objects, which it does not survive.
_NOT_FOR_ARROW = r"NaN|Inf|\}\s*null|(?:\[\s*){64}"


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

    def decode(self, messages: Messages) -> tuple[list[Part], list[Messages]]:
        """All messages as columns, or all of them left over."""
        content = _joined(messages)
        if content is None:
            return [], [messages]
        try:
            table = pa.json.read_json(
                pa.BufferReader(content),
                read_options=pa.json.ReadOptions(use_threads=False, block_size=len(content) + 1),
                parse_options=pa.json.ParseOptions(explicit_schema=self._schema, unexpected_field_behavior="ignore"),
            )
        except pa.ArrowInvalid:
            return [], [messages]
        # Every payload starts and ends as an object does: so many objects as messages are one each.
        if table.num_rows != len(messages):
            return [], [messages]
        frame = pl.DataFrame(pl.from_arrow(table))
        values = frame.select(_value(path).alias(path) for path in self._types).to_dict()
        return [Part(messages, values=values)], []


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


def _joined(messages: Messages) -> bytes | None:
    """The payloads, one after the other; none if any is not the UTF-8 text of something between braces."""
    bounds = np.empty(2 * len(messages) + 1, dtype=np.int64)
    bounds[0:-1:2] = messages.start
    bounds[1::2] = messages.start + messages.length
    bounds[-1] = bounds[-2]
    # The texts between payloads are record heads: every other one is taken.
    pieces = pa.LargeBinaryArray.from_buffers(
        pa.large_binary(), 2 * len(messages), [None, pa.py_buffer(bounds), pa.py_buffer(messages.data)]
    )
    try:
        binary = pl.Series(pl.from_arrow(pieces.take(pa.array(np.arange(0, 2 * len(messages), 2)))))
        texts = binary.cast(pl.String).str.strip_chars(" \t\r\n")
    except pl.exceptions.PolarsError:
        return None
    fits = texts.str.starts_with("{") & texts.str.ends_with("}") & ~texts.str.contains(_NOT_FOR_ARROW)
    return texts.str.join("\n").item().encode() if fits.all() else None
