"""Columnar decoding of JSON messages by their patterns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import polars as pl
import pyarrow as pa

from pipeline.ingest.conform import all_finite
from pipeline.ingest.json_layout import JsonLayout, NoPatternError, layout_of
from pipeline.ingest.layout import Repeated
from pipeline.ingest.mcap_block import Messages
from pipeline.ingest.template import Part

_MOST_LAYOUTS = 32
_MOST_ASIDE = 8  # messages without pattern that may come before one that has a pattern


class JsonDecoder:
    """Decodes the messages of a channel that match the pattern of one seen before."""

    def __init__(self, types: Mapping[str, pl.DataType]) -> None:
        self._types = types
        self._layouts: list[JsonLayout] = []
        self._tried = 0

    def decode(self, messages: Messages) -> tuple[list[Part], list[Messages]]:
        """Messages by pattern, learning new ones while there are few, and those that have none."""
        parts: list[Part] = []
        left: list[Messages] = []
        number = 0
        while len(messages) and number < _MOST_LAYOUTS:
            if number < len(self._layouts) or self._learn(messages.payload(0)):
                messages = _matched(messages, self._layouts[number], self._types, parts)
                number += 1
            elif len(left) < _MOST_ASIDE:
                left.append(messages.chosen(np.arange(1)))
                messages = messages.chosen(np.arange(1, len(messages)))
            else:
                break
        return parts, [*left, messages] if len(messages) else left

    def _learn(self, payload: bytes) -> bool:
        self._tried += 1
        if self._tried > 2 * _MOST_LAYOUTS:
            return False
        try:
            self._layouts.append(layout_of(payload, self._types))
        except NoPatternError:
            return False
        return True


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
    finite = all(all_finite(column) for column in values if column.dtype == pl.Float64)
    return values.to_dict() if finite else None
