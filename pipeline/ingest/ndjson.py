"""Columnar decoding of JSON messages: a block's payloads joined to lines and parsed at once."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from pipeline.ingest.generic import parse_path
from pipeline.ingest.mcap_block import Messages
from pipeline.ingest.template import Part

_LINES = 20_000  # parsed at once


class JsonDecoder:
    """Decodes the messages of a channel; a batch that the strict parser refuses is left to the other."""

    def __init__(self, types: Mapping[str, pl.DataType]) -> None:
        self._schema = _schema_of(types)
        self._columns = [_expression(path) for path in types]

    def decode(self, messages: Messages) -> tuple[list[Part], list[Messages]]:
        parts: list[Part] = []
        left: list[Messages] = []
        for first in range(0, len(messages), _LINES):
            batch = messages.chosen(np.arange(first, min(first + _LINES, len(messages))))
            values = self._parse(batch)
            if values is None:
                left.append(batch)
            else:
                parts.append(Part(batch, values=values))
        return parts, left

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
