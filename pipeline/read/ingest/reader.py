"""Messages of a channel to columns, by the decoder of their encoding."""

from __future__ import annotations

from functools import partial

import numpy as np
import polars as pl

from pipeline.read.ingest.fields import definition_of
from pipeline.read.ingest.json_columns import JsonDecoder
from pipeline.read.ingest.layout import LayoutDecoder, Values
from pipeline.read.ingest.mcap_block import Messages, Stretches
from pipeline.read.ingest.plan import Source
from pipeline.read.ingest.protobuf import layout_by
from pipeline.read.ingest.ros_message import layout_of_cdr
from pipeline.read.ingest.stamps import LOG_TIME, PUBLISH_TIME
from schemas.arrays import Ints

ORDINAL = "(ordinal)"  # place of a message in the file


def _decoder_of(source: Source) -> JsonDecoder | LayoutDecoder:
    channel = source.channel
    if channel.encoding == "json":
        return JsonDecoder(channel, source.types)
    definition = definition_of(channel)
    if channel.encoding == "cdr":
        return LayoutDecoder(channel, partial(layout_of_cdr, definition, source.types, source.recipe.rows))
    return LayoutDecoder(channel, layout_by(definition.DESCRIPTOR, source.types))


class SourceReader:
    """Collects the fields of one source, block by block."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self._decoder = _decoder_of(source)
        used = {name for time in source.times.values() for name in time.fields}
        self._times = [name for name in (LOG_TIME, PUBLISH_TIME) if name in used]
        self._types = {name: pl.Int64() for name in (ORDINAL, *self._times)} | dict(source.types)
        self._parts: dict[str, list[Values]] = {name: [] for name in self._types}

    @property
    def slow_messages(self) -> int:
        """How many messages were decoded one by one."""
        return self._decoder.slow_messages

    @property
    def wanted(self) -> Stretches:
        """What is read of each message, by its length, as far as it is known by now."""
        return self._decoder.wanted

    def add(self, messages: Messages) -> None:
        """Decode these messages."""
        for decoded, columns in self._decoder.decode(messages):
            if not len(decoded):  # messages of empty arrays
                continue
            values: dict[str, Values] = {ORDINAL: decoded.ordinal, **columns}
            values |= {LOG_TIME: decoded.log_time} if LOG_TIME in self._times else {}
            values |= {PUBLISH_TIME: decoded.publish_time} if PUBLISH_TIME in self._times else {}
            for name, parts in self._parts.items():
                parts.append(values[name])

    def frame(self) -> pl.DataFrame:
        """One row per message in order of the file; what was collected is given up."""
        places = _concat_parts(self._parts[ORDINAL], pl.Int64())
        order = None if places.is_sorted() else np.argsort(places.to_numpy(), kind="stable")
        return pl.DataFrame(
            {name: _concat_parts(self._parts.pop(name), dtype, order) for name, dtype in self._types.items()}
        )


def _concat_parts(parts: list[Values], dtype: pl.DataType, order: Ints | None = None) -> pl.Series:
    """The parts one after the other, or in this order."""
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    if parts and len(arrays) == len(parts):
        values = np.concatenate(arrays)
        return pl.Series(values if order is None else values[order], dtype=dtype)
    whole = pl.concat([pl.Series(dtype=dtype), *(pl.Series(part, dtype=dtype) for part in parts)], rechunk=True)
    return whole if order is None else whole.gather(order)
