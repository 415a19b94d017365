"""Messages of a channel to columns, by the decoder of their encoding."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import polars as pl

from pipeline.read.ingest.fields import definition_of
from pipeline.read.ingest.json_columns import JsonDecoder
from pipeline.read.ingest.layout import Layout, Values
from pipeline.read.ingest.layout_decoder import LayoutDecoder
from pipeline.read.ingest.mcap_block import Messages
from pipeline.read.ingest.plan import Source
from pipeline.read.ingest.protobuf import layout_by
from pipeline.read.ingest.ros_message import layout_of_cdr
from pipeline.read.ingest.stamps import LOG_TIME, PUBLISH_TIME

ORDINAL = "(ordinal)"  # place of a message in the file


_TOGETHER = 4 * 1024 * 1024  # bytes that are decoded at once


def _decoder_of(source: Source, with_publish_time: bool) -> JsonDecoder | LayoutDecoder:
    """The decoder of a channel's encoding."""
    channel = source.channel
    if channel.encoding == "json":
        return JsonDecoder(channel, source.types, with_publish_time)
    definition = definition_of(channel)
    walk: Callable[[bytes], Layout]
    if channel.encoding == "cdr":
        walk = partial(layout_of_cdr, definition, source.types, source.recipe.rows)
    else:
        walk = layout_by(definition.DESCRIPTOR, source.types)
    return LayoutDecoder(channel, walk, with_publish_time)


class SourceReader:
    """Collects the fields of one source, block by block; `frames`: those that its speeds are in, as they were met."""

    def __init__(self, source: Source) -> None:
        self.source = source
        used = {name for time in source.times.values() for name in time.fields}
        self._decoder = _decoder_of(source, PUBLISH_TIME in used)
        self._times = [name for name in (LOG_TIME, PUBLISH_TIME) if name in used]
        self._types = {name: pl.Int64() for name in (ORDINAL, *self._times)} | dict(source.types)
        self.frames: dict[str, None] = {}
        if not source.needs_frame:
            self._types.pop(source.frame, None)
        self._parts: dict[str, list[Values]] = {name: [] for name in self._types}

    @property
    def slow_messages(self) -> int:
        """How many messages were decoded one by one."""
        return self._decoder.slow_messages

    def add(self, messages: Messages) -> None:
        """Take these messages; what waits is decoded once it is much."""
        self._decoder.add(messages)
        if self._decoder.waiting >= _TOGETHER:
            self.decode()

    def decode(self) -> None:
        """Decode the messages that wait."""
        for heads, columns in self._decoder.decoded():
            if not len(heads.ordinal):  # messages of empty arrays
                continue
            values: dict[str, Values] = {ORDINAL: heads.ordinal, LOG_TIME: heads.log_time, **columns}
            if heads.publish_time is not None:
                values[PUBLISH_TIME] = heads.publish_time
            for name, parts in self._parts.items():
                parts.append(values[name])
            if self.source.frame:
                self.frames |= dict.fromkeys(_different(pl.Series(values[self.source.frame])))

    def frame(self) -> pl.DataFrame:
        """One row per decoded message in order of the file; what was collected is given up."""
        return pl.DataFrame({name: _concat_parts(self._parts.pop(name), dtype) for name, dtype in self._types.items()})


def _different(names: pl.Series) -> list[str]:
    """Each name once, in order; mostly all are as the first."""
    names = names.drop_nulls()
    return [*names.head(1), *names.filter(names != names[0]).unique(maintain_order=True)] if len(names) else []


def _concat_parts(parts: list[Values], dtype: pl.DataType) -> pl.Series:
    """The parts one after the other."""
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    if parts and len(arrays) == len(parts):
        return pl.Series(np.concatenate(arrays), dtype=dtype)
    return pl.concat([pl.Series(dtype=dtype), *(pl.Series(part, dtype=dtype) for part in parts)], rechunk=True)
