"""Messages of a channel to columns: the columnar decoder of its encoding, and the ordinary one for the rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import polars as pl

from pipeline.ingest.generic import decode_columns
from pipeline.ingest.layout import Repeated, Rows, UnfitError, Values, joined_rows
from pipeline.ingest.mcap_block import Messages
from pipeline.ingest.mcap_model import Channel
from pipeline.ingest.plan import Source
from pipeline.ingest.stamps import LOG_TIME, PUBLISH_TIME
from pipeline.ingest.template import Part, Template, TemplateDecoder
from schemas.errors import InputError

ORDINAL = "(ordinal)"  # place of a message in the file


_ROWS = 32_768  # messages of one layout whose fields are taken together


class Decoder(Protocol):
    def decode(self, messages: Messages) -> tuple[list[Part], list[Messages]]: ...


def decoder_of(channel: Channel, types: Mapping[str, pl.DataType]) -> Decoder | None:
    """The columnar decoder, or none where the encoding or schema has none."""
    try:
        if channel.encoding == "json":
            from pipeline.ingest.json_columns import JsonDecoder

            return JsonDecoder(types)
        if channel.encoding == "cdr" and channel.schema and channel.schema.encoding == "ros2msg":
            from pipeline.ingest.cdr import CdrWalk

            return TemplateDecoder(CdrWalk(channel.schema.name, channel.schema.data.decode(), types))
        if channel.encoding == "protobuf":
            from pipeline.ingest.generic import protobuf_descriptor
            from pipeline.ingest.protobuf import ProtobufWalk

            return TemplateDecoder(ProtobufWalk(protobuf_descriptor(channel), types))
    except (UnfitError, ValueError):  # a schema that is not understood: the ordinary decoder says why
        return None
    return None


class SourceReader:
    """Collects the fields of one source, block by block."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.slow_messages = 0
        self._decoder = None if source.recipe.rows else decoder_of(source.channel, source.types)
        used = {name for time in source.times.values() for name in time.fields}
        self._times = [name for name in (LOG_TIME, PUBLISH_TIME) if name in used]
        self._columns: dict[str, list[Values]] = {name: [] for name in (ORDINAL, *self._times, *source.types)}
        self._template: Template | None = None
        self._waiting: list[Rows] = []
        self._waiting_rows = 0
        self._last_ordinal = -1
        self._in_order = True

    def add(self, messages: Messages) -> None:
        """Decode these messages."""
        parts, left = self._decoder.decode(messages) if self._decoder else ([], [messages])
        for part in parts:
            self._note(part.messages)
            if part.template is None:
                self._take_fields()
                self._keep(part.values)
                continue
            if self._template is not part.template:
                self._take_fields()
            # Only the bytes that are needed: to hold the part would hold its whole chunk in memory.
            self._template = part.template
            self._waiting.append(part.rows)
            self._waiting_rows += len(part.messages)
            if self._waiting_rows >= _ROWS:
                self._take_fields()
        for rest in left:
            self._take_fields()
            self.slow_messages += len(rest)
            frame, numbers = decode_columns(self.source.channel, rest, self.source.types, self.source.recipe.rows)
            if numbers:
                self._note(rest.chosen(np.array(numbers, dtype=np.int64)))
                self._keep(frame.to_dict())

    def _note(self, messages: Messages) -> None:
        self._columns[ORDINAL].append(messages.ordinal)
        self._in_order &= bool(messages.ordinal[0] >= self._last_ordinal)
        self._last_ordinal = int(messages.ordinal[-1])
        for name in self._times:
            self._columns[name].append(messages.times("log_time" if name == LOG_TIME else "publish_time"))

    def _take_fields(self) -> None:
        """The fields of the messages of one layout that were only checked so far."""
        waiting, self._waiting, self._waiting_rows = self._waiting, [], 0
        if self._template is None or not waiting:
            return
        try:
            self._keep(self._template.values(joined_rows(waiting)))
        except UnfitError as error:
            raise InputError(f"a message cannot be decoded: {error}", place=self.source.channel.place) from None

    def _keep(self, values: Mapping[str, Any]) -> None:
        for path, dtype in self.source.types.items():
            self._columns[path].append(_typed(values[path], dtype))

    def frame(self) -> pl.DataFrame:
        """One row per message in order of the file; what was collected is given up."""
        self._take_fields()
        parts = [np.asarray(part) for part in self._columns[ORDINAL]]
        order = None if self._in_order else np.argsort(np.concatenate(parts), kind="stable")
        types: dict[str, pl.DataType] = {name: pl.Int64() for name in (ORDINAL, *self._times)}
        types |= self.source.types
        series = []
        for name, dtype in types.items():
            series.append(_joined(name, self._columns.pop(name), dtype, order))
        return pl.DataFrame(series)


_KINDS = {pl.Float64: np.float64, pl.Int64: np.int64, pl.Boolean: np.bool_}


def _typed(values: Values, dtype: pl.DataType) -> Values:
    """In the type asked for, on its own memory."""
    if isinstance(values, Repeated):
        whole = values.value is not None and type(dtype) in _KINDS
        return np.full(values.count, values.value, _KINDS[type(dtype)]) if whole else values
    if isinstance(values, pl.Series):
        return values.cast(dtype)
    if values.dtype == np.uint64 and len(values) and values.max() >= 2**63 and dtype == pl.Int64():
        raise InputError("has a number too large for a signed 64-bit integer", found=str(values.max()))
    return np.ascontiguousarray(values.astype(_KINDS[type(dtype)]))


def _joined(name: str, parts: list[Values], dtype: pl.DataType, order: npt.NDArray[np.int64] | None) -> pl.Series:
    """One column of what the parts hold, put in order."""
    if not parts:
        return pl.Series(name, [], dtype=dtype)
    arrays = [part for part in parts if isinstance(part, np.ndarray)]
    if len(arrays) == len(parts):
        joined = np.concatenate(arrays)
        return pl.Series(name, joined if order is None else joined[order])
    repeated = [part for part in parts if isinstance(part, Repeated)]
    if len(repeated) == len(parts) and len({part.value for part in repeated}) == 1:
        whole = Repeated(repeated[0].value, sum(part.count for part in repeated), dtype)
        return whole.series().alias(name)
    series = [part.series() if isinstance(part, Repeated) else pl.Series(part) for part in parts]
    column = pl.concat([part.cast(dtype).alias(name) for part in series], rechunk=True)
    return column if order is None else column.gather(order)
