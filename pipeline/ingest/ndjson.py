"""Columnar decoding of JSON messages: a block's payloads joined to lines and parsed at once."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa

from pipeline.ingest.generic import parse_path
from pipeline.ingest.json_layout import JsonLayout, NoPatternError, layout_of
from pipeline.ingest.layout import Repeated
from pipeline.ingest.mcap_block import Messages
from pipeline.ingest.template import Part

_LINES = 20_000  # parsed at once
_MOST_LAYOUTS = 8


class JsonDecoder:
    """Decodes the messages of a channel: by pattern, else as lines; what both refuse is left over."""

    def __init__(self, types: Mapping[str, pl.DataType]) -> None:
        self._types = types
        self._schema = _schema_of(types)
        self._columns = [_expression(path) for path in types]
        self._layouts: list[JsonLayout] = []
        self._tried = 0

    def decode(self, messages: Messages) -> tuple[list[Part], list[Messages]]:
        parts: list[Part] = []
        left: list[Messages] = []
        for first in range(0, len(messages), _LINES):
            rest = messages.chosen(np.arange(first, min(first + _LINES, len(messages))))
            rest = self._by_pattern(rest, parts)
            if not len(rest):
                continue
            values = self._parse(rest)
            if values is None:
                left.append(rest)
            else:
                parts.append(Part(rest, values=values))
        return parts, left

    def _by_pattern(self, messages: Messages, parts: list[Part]) -> Messages:
        """Take the messages that match a known pattern, learning new ones while there are few."""
        for number in range(_MOST_LAYOUTS):
            if not len(messages):
                break
            if number == len(self._layouts) and not self._learn(messages.payload(0)):
                break
            messages = _matched(messages, self._layouts[number], self._types, parts)
        return messages

    def _learn(self, payload: bytes) -> bool:
        self._tried += 1
        if self._tried > 2 * _MOST_LAYOUTS:
            return False
        try:
            self._layouts.append(layout_of(payload, self._types))
        except NoPatternError:
            return False
        return True

    def _parse(self, messages: Messages) -> Mapping[str, Any] | None:
        content = messages.data.tobytes()  # slices of bytes are several times cheaper than those of a view
        bounds = zip(messages.start.tolist(), (messages.start + messages.length).tolist(), strict=True)
        lines = b"\n".join([content[start:end] for start, end in bounds])
        if lines.count(b"\n") != len(messages) - 1:
            return None
        try:
            frame = pl.read_ndjson(io.BytesIO(lines), schema=self._schema)
            # A blank line vanishes without a word, so every line must have become a row.
            return frame.select(self._columns).to_dict() if frame.height == len(messages) else None
        except pl.exceptions.PolarsError:
            return None


def _matched(messages: Messages, layout: JsonLayout, types: Mapping[str, pl.DataType], parts: list[Part]) -> Messages:
    """Keep what matches the layout, and return the rest."""
    if not layout.paths:
        return messages
    texts = _texts(messages)
    if texts is None:
        return messages
    groups = texts.to_frame("").select(pl.col("").str.extract_groups(layout.pattern)).unnest("")
    # A match without any group that is not null is none: its message goes the other way.
    whole = any(column.null_count() == 0 for column in groups)
    found = None if whole else groups.select(pl.any_horizontal(pl.all().is_not_null())).to_series()
    if found is not None:
        groups = groups.filter(found)
    values = _cast(groups, layout.paths, types) if groups.height else None
    if values is None:
        return messages
    absent = {path: Repeated(None, groups.height, types[path]) for path in layout.absent}
    mask = np.ones(len(messages), np.bool_) if found is None else found.to_numpy()
    taken = messages if found is None else messages.chosen(mask)
    parts.append(Part(taken, values={**values, **absent}))
    return messages.chosen(~mask)


def _texts(messages: Messages) -> pl.Series | None:
    """The payloads as texts, none if any is not UTF-8."""
    bounds = np.empty(2 * len(messages) + 1, dtype=np.int64)
    bounds[0:-1:2] = messages.start
    bounds[1::2] = messages.start + messages.length
    bounds[-1] = bounds[-2]
    # The texts between payloads are record heads: every other one is taken.
    pieces = pa.LargeBinaryArray.from_buffers(
        pa.large_binary(), 2 * len(messages), [None, pa.py_buffer(bounds), pa.py_buffer(messages.data)]
    )
    try:
        return pl.Series(pl.from_arrow(pieces.take(pa.array(np.arange(0, 2 * len(messages), 2))))).cast(pl.String)
    except pl.exceptions.PolarsError:
        return None


def _cast(groups: pl.DataFrame, paths: Sequence[str], types: Mapping[str, pl.DataType]) -> dict[str, pl.Series] | None:
    """Values of the groups, none where a number is beyond its type."""
    columns = [
        (pl.col(group) == "true" if types[path] == pl.Boolean else pl.col(group).cast(types[path])).alias(path)
        for group, path in zip(groups.columns, paths, strict=True)
    ]
    try:
        values = groups.select(columns)
    except pl.exceptions.PolarsError:
        return None
    finite = all(math.isfinite(column.sum()) for column in values if column.dtype == pl.Float64)
    return values.to_dict() if finite else None


def _schema_of(types: Mapping[str, pl.DataType]) -> dict[str, Any]:
    tree: dict[str | int, Any] = {}
    for path, dtype in types.items():
        node = tree
        *parents, last = parse_path(path)
        for step in parents:
            node = node.setdefault(step, {})
        node[last] = dtype
    return {str(name): _dtype(node) for name, node in tree.items()}


def _dtype(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    if all(isinstance(step, int) for step in node):
        return pl.List(_dtype(next(iter(node.values()))))
    return pl.Struct({str(name): _dtype(child) for name, child in node.items()})


def _expression(path: str) -> pl.Expr:
    first, *steps = parse_path(path)
    expression = pl.col(str(first))
    for step in steps:
        if isinstance(step, int):
            expression = expression.list.get(step, null_on_oob=True)
        else:
            expression = expression.struct.field(step)
    return expression.alias(path)
