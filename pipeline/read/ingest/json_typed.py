"""JSON messages that all hold the same fields, each once: parsed into typed objects by msgspec, several times as fast.

Whatever else they may be is left to others, so that it is read or refused as it is there.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from operator import attrgetter
from typing import Any

import numpy as np
import polars as pl

from pipeline.read.ingest.layout import Columns, parse_path

_KINDS: dict[type[pl.DataType], type] = {pl.Float64: float, pl.Int64: int, pl.Boolean: bool, pl.String: str}
# Read as a whole number it would lose its sign.
_MINUS_ZERO = re.compile(rb"-0(?![.eE0-9])")


def typed_messages(types: Mapping[str, pl.DataType], first: Any) -> TypedMessages | None:
    """What parses messages that hold what the first, of this document, holds of the fields asked for, and no others.

    None where there is nothing of the kind; elements of arrays are not.
    """
    tree: dict[str, Any] = {}
    for path, dtype in types.items():
        *above, last = steps = [str(step) for step in parse_path(path)]
        value = first
        for step in steps:
            value = value.get(step) if isinstance(value, dict) else None
        if isinstance(value, dict | list):
            return None
        if value is not None:
            node = tree
            for step in above:
                node = node.setdefault(step, {})
            node[last] = _KINDS[type(dtype)]
    try:
        return TypedMessages(types, tree) if tree else None
    except ValueError:  # a name that msgspec does not take
        return None


class TypedMessages:
    """Parses messages that hold the fields of a tree of names and their kinds, and no others."""

    def __init__(self, types: Mapping[str, pl.DataType], tree: Mapping[str, Any]) -> None:
        import msgspec  # not at the start of a process that reads no JSON

        self._types = types
        self._held: dict[str, str] = {}  # the attribute of each field that is there
        self._tokens = 0  # names and texts of a message
        self._note_attributes(tree, "", "")
        self._error = msgspec.MsgspecError
        self._decoder = msgspec.json.Decoder(_struct_type(tree))

    def _note_attributes(self, tree: Mapping[str, Any], path: str, attribute: str) -> None:
        """Note under which attribute each field is found, and how many tokens a message has."""
        for number, (name, node) in enumerate(tree.items()):
            self._tokens += 1
            if isinstance(node, dict):
                self._note_attributes(node, f"{path}{name}.", f"{attribute}_{number}.")
            else:
                self._tokens += node is str
                self._held[f"{path}{name}"] = f"{attribute}_{number}"

    def columns(self, content: bytearray, count: int) -> Columns | None:
        """The fields of so many messages, each something between braces; None where one is not as the others.

        A name that is doubled anywhere shows by its quotation marks: no text holds any, where none is escaped.
        """
        marks = np.count_nonzero(np.frombuffer(content, dtype=np.uint8) == ord('"'))
        if marks != 2 * count * self._tokens or b"\\" in content:
            return None
        try:
            messages = self._decoder.decode_lines(content)
            if len(messages) != count:
                return None
            columns = {path: self._column_of_field(path, dtype, messages) for path, dtype in self._types.items()}
        except (self._error, UnicodeDecodeError, OverflowError):  # the last of numbers beyond 64 bits
            return None
        real = [column for column in columns.values() if column.dtype == pl.Float64]
        if any((column == 0.0).any() for column in real) and _MINUS_ZERO.search(content):
            return None
        return columns

    def _column_of_field(self, path: str, dtype: pl.DataType, messages: list[Any]) -> pl.Series:
        """The values of one field of all messages."""
        if path not in self._held:
            return pl.Series([None], dtype=dtype).new_from_index(0, len(messages))
        values = map(attrgetter(self._held[path]), messages)
        if dtype != pl.String:
            return pl.Series(np.fromiter(values, _KINDS[type(dtype)], len(messages)), dtype=dtype)
        texts = list(values)
        if texts.count(texts[0]) == len(texts):  # mostly each is as the one before
            return pl.Series(texts[:1], dtype=dtype).new_from_index(0, len(texts))
        return pl.Series(texts, dtype=dtype)


def _struct_type(tree: Mapping[str, Any]) -> Any:
    """A type whose objects have all of these fields and no others."""
    import msgspec

    kinds = [_struct_type(node) if isinstance(node, dict) else node for node in tree.values()]
    names = {f"_{number}": name for number, name in enumerate(tree)}
    fields = list(zip(names, kinds, strict=True))
    return msgspec.defstruct("Message", fields, rename=names, forbid_unknown_fields=True, gc=False)
