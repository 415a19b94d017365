"""Messages of a channel to columns: the columnar decoder of its encoding, and the ordinary one for the rest."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Protocol

import numpy as np
import polars as pl

from pipeline.read.ingest.generic import decode_columns, definition_of
from pipeline.read.ingest.json_columns import JsonDecoder
from pipeline.read.ingest.layout import Columns, LayoutDecoder, Values
from pipeline.read.ingest.mcap_block import Messages
from pipeline.read.ingest.mcap_records import Channel
from pipeline.read.ingest.plan import Source
from pipeline.read.ingest.protobuf import layout_by
from pipeline.read.ingest.ros_message import layout_of_cdr
from pipeline.read.ingest.stamps import LOG_TIME, PUBLISH_TIME
from schemas.arrays import Ints

ORDINAL = "(ordinal)"  # place of a message in the file


class Decoder(Protocol):
    def decode(self, messages: Messages) -> tuple[list[tuple[Messages, Columns]], list[Messages]]:
        """Messages with their fields, and those that are left to the ordinary decoder."""


def decoder_of(channel: Channel, types: Mapping[str, pl.DataType]) -> Decoder:
    """The columnar decoder of the channel's encoding."""
    if channel.encoding == "json":
        return JsonDecoder(types)
    if channel.encoding == "cdr":
        definitions, name = definition_of(channel)
        return LayoutDecoder(partial(layout_of_cdr, definitions, name, types))
    return LayoutDecoder(layout_by(definition_of(channel).DESCRIPTOR, types))


class SourceReader:
    """Collects the fields of one source, block by block."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.slow_messages = 0
        self._decoder = None if source.recipe.rows else decoder_of(source.channel, source.types)
        used = {name for time in source.times.values() for name in time.fields}
        self._times = [name for name in (LOG_TIME, PUBLISH_TIME) if name in used]
        self._types = {name: pl.Int64() for name in (ORDINAL, *self._times)} | dict(source.types)
        self._parts: dict[str, list[Values]] = {name: [] for name in self._types}

    def add(self, messages: Messages) -> None:
        """Decode these messages."""
        parts, left = self._decoder.decode(messages) if self._decoder else ([], [messages])
        for decoded, columns in parts:
            self._keep(decoded, columns)
        for rest in left:
            self.slow_messages += len(rest)
            columns, numbers = decode_columns(self.source.channel, rest, self.source.types, self.source.recipe.rows)
            self._keep(rest.chosen(np.array(numbers, dtype=np.int64)), columns)

    def _keep(self, messages: Messages, columns: Columns) -> None:
        values: dict[str, Values] = {ORDINAL: messages.ordinal, **columns}
        values |= {LOG_TIME: messages.log_time} if LOG_TIME in self._times else {}
        values |= {PUBLISH_TIME: messages.publish_time} if PUBLISH_TIME in self._times else {}
        for name, parts in self._parts.items():
            parts.append(values[name])

    def frame(self) -> pl.DataFrame:
        """One row per message in order of the file; what was collected is given up."""
        places = _joined(self._parts[ORDINAL], pl.Int64())
        order = None if places.is_sorted() else np.argsort(places.to_numpy(), kind="stable")
        return pl.DataFrame({name: _joined(self._parts.pop(name), dtype, order) for name, dtype in self._types.items()})


def _joined(parts: list[Values], dtype: pl.DataType, order: Ints | None = None) -> pl.Series:
    """The parts one after the other, or in this order."""
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    if parts and len(arrays) == len(parts):
        values = np.concatenate(arrays)
        return pl.Series(values if order is None else values[order], dtype=dtype)
    whole = pl.concat([pl.Series(dtype=dtype), *(pl.Series(part, dtype=dtype) for part in parts)], rechunk=True)
    return whole if order is None else whole.gather(order)
