"""Messages of a channel to columns: the columnar decoder of its encoding, and the ordinary one for the rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import polars as pl

from pipeline.ingest.generic import decode_columns
from pipeline.ingest.mcap_block import Block, Ints
from pipeline.ingest.mcap_model import Channel
from pipeline.ingest.plan import Source
from pipeline.ingest.stamps import LOG_TIME, PUBLISH_TIME
from pipeline.ingest.template import Part, TemplateDecoder, Unfit, Values

ORDINAL = "(ordinal)"  # place of a message in the file


class Decoder(Protocol):
    def decode(self, block: Block, rows: Ints) -> tuple[list[Part], Ints]: ...


def decoder_of(channel: Channel, types: Mapping[str, pl.DataType]) -> Decoder | None:
    """The columnar decoder, or none where the encoding or schema has none."""
    try:
        if channel.encoding == "json":
            from pipeline.ingest.ndjson import JsonDecoder

            return JsonDecoder(types)
        if channel.encoding == "cdr" and channel.schema and channel.schema.encoding == "ros2msg":
            from pipeline.ingest.cdr import CdrWalk

            return TemplateDecoder(CdrWalk(channel.schema.name, channel.schema.data.decode(), types))
        if channel.encoding == "protobuf":
            from pipeline.ingest.generic import protobuf_descriptor
            from pipeline.ingest.protobuf import ProtobufWalk

            return TemplateDecoder(ProtobufWalk(protobuf_descriptor(channel), types))
    except (Unfit, UnicodeDecodeError):
        return None
    return None


class SourceReader:
    """Collects the fields of one source, block by block."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.slow_messages = 0
        self._decoder = decoder_of(source.channel, source.types)
        used = {name for time in source.times.values() for name in time.fields}
        self._times = [name for name in (LOG_TIME, PUBLISH_TIME) if name in used]
        self._columns: dict[str, list[Values]] = {
            name: [] for name in (ORDINAL, *self._times, *source.types)
        }

    def add(self, block: Block, rows: Ints) -> None:
        """Decode these messages of the block."""
        parts, left = self._decoder.decode(block, rows) if self._decoder else ([], rows)
        for done, values in parts:
            self._keep(block, done, values)
        if len(left):
            self.slow_messages += len(left)
            self._keep(block, left, self._one_by_one(block, left))

    def _one_by_one(self, block: Block, rows: Ints) -> Mapping[str, Any]:
        bounds = zip(block.start[rows].tolist(), block.length[rows].tolist(), strict=True)
        payloads = (block.data[start : start + length].tobytes() for start, length in bounds)
        numbers = (block.first_ordinal + rows).tolist()
        return decode_columns(self.source.channel, payloads, self.source.types, numbers).to_dict()

    def _keep(self, block: Block, rows: Ints, values: Mapping[str, Values]) -> None:
        self._columns[ORDINAL].append(block.first_ordinal + rows)
        for name in self._times:
            times = block.log_time if name == LOG_TIME else block.publish_time
            self._columns[name].append(times[rows])
        for path in self.source.types:
            self._columns[path].append(values[path])

    def frame(self) -> pl.DataFrame:
        """One row per message in order of the file; what was collected is given up."""
        ordinals = np.concatenate(self._columns[ORDINAL])
        order = None if (np.diff(ordinals) > 0).all() else np.argsort(ordinals)
        types: dict[str, pl.DataType] = {name: pl.Int64() for name in (ORDINAL, *self._times)}
        types |= self.source.types
        series = []
        for name, dtype in types.items():
            column = _joined(name, self._columns.pop(name), dtype)
            series.append(column if order is None else column.gather(order))
        return pl.DataFrame(series)


def _joined(name: str, parts: list[Values], dtype: pl.DataType) -> pl.Series:
    """One column of what the parts hold, in the type asked for."""
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    if len(arrays) == len(parts):
        kind = {pl.Float64: np.float64, pl.Int64: np.int64, pl.Boolean: np.bool_}[type(dtype)]
        return pl.Series(name, np.concatenate([part.astype(kind, copy=False) for part in arrays]))
    return pl.concat([pl.Series(name, part).cast(dtype) for part in parts], rechunk=True)
