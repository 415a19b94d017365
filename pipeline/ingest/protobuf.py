"""Columnar decoding of protobuf messages by the descriptors that the log carries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import polars as pl

from pipeline.ingest.generic import parse_path
from pipeline.ingest.layout import Constant, Field, Fixed, Flag, Text, UnfitError, Varint, check_type
from pipeline.ingest.template import Template, template_of

# Wire types (protobuf encoding guide).
_VARINT, _I64, _LEN, _I32 = 0, 1, 2, 5

# descriptor.proto: FieldDescriptorProto.Type
_DOUBLE, _FLOAT, _INT64, _UINT64, _INT32, _FIXED64, _FIXED32, _BOOL, _STRING = 1, 2, 3, 4, 5, 6, 7, 8, 9
_MESSAGE, _UINT32, _ENUM, _SFIXED32, _SFIXED64, _SINT32, _SINT64 = 11, 13, 14, 15, 16, 17, 18

_FIXED_WIDTH = {
    _DOUBLE: (_I64, "<f8"), _FIXED64: (_I64, "<u8"), _SFIXED64: (_I64, "<i8"),
    _FLOAT: (_I32, "<f4"), _FIXED32: (_I32, "<u4"), _SFIXED32: (_I32, "<i4"),
}  # fmt: skip
# bits, signed, zigzag; an int32 below zero is written with all 64 bits of its sign
_VARINTS = {
    _INT64: (64, True, False), _UINT64: (64, False, False), _INT32: (32, True, False),
    _UINT32: (32, False, False), _ENUM: (32, True, False),
    _SINT32: (32, True, True), _SINT64: (64, True, True),
}  # fmt: skip

Span = tuple[int, int]  # from, to
Raw = tuple[int, int, Span]  # wire type, offset of the value, extent of the value


class ProtobufWalk:
    """Walks one message by its descriptor; calling it gives the template of the message's layout."""

    def __init__(self, descriptor: Any, types: Mapping[str, pl.DataType]) -> None:
        self._descriptor = descriptor
        self._types = types
        self._tree: dict[str | int, Any] = {}
        for path in types:
            node = self._tree
            for step in parse_path(path):
                node = node.setdefault(step, {})
            node[""] = path

    def __call__(self, payload: bytes) -> Template:
        walk = _Walk(payload, self._types)
        walk.message(self._descriptor, self._tree, (0, len(payload)))
        return template_of(payload, walk.static, walk.fields)


class _Walk:
    """The state of one walk."""

    def __init__(self, payload: bytes, types: Mapping[str, pl.DataType]) -> None:
        self.fields: dict[str, Field] = {}
        self.static = bytearray(len(payload))
        self._payload = payload
        self._types = types

    def message(self, descriptor: Any, tree: Mapping[Any, Any], span: Span) -> None:
        """The wanted fields of the message in this extent; what is not wanted only shapes the layout."""
        met = self._scan(span)
        for step, subtree in tree.items():
            field = descriptor.fields_by_name.get(step) if isinstance(step, str) else None
            if field is None:
                raise UnfitError(f"no field {step}")
            occurrences = met.get(field.number, [])
            if len(occurrences) > 1:
                raise UnfitError("a field occurs twice")
            if not occurrences:
                self._absent(field, subtree)
            elif field.is_repeated:
                self._packed(field, subtree, occurrences[0])
            elif field.type == _MESSAGE:
                self._submessage(field, subtree, occurrences[0])
            else:
                self._keep(subtree, self._value(field, occurrences[0]))

    def _scan(self, span: Span) -> dict[int, list[Raw]]:
        """All fields of one message by number; tags, lengths and widths of varints are marked as static."""
        met: dict[int, list[Raw]] = {}
        at, end = span
        while at < end:
            tag, at = self._varint(at, end, exact=True)
            number, wire = tag >> 3, tag & 7
            start = at
            if wire == _VARINT:
                _, at = self._varint(at, end, exact=False)
            elif wire == _LEN:
                length, start = self._varint(at, end, exact=True)
                at = start + length
            elif wire in (_I64, _I32):
                at += 8 if wire == _I64 else 4
            else:
                raise UnfitError("a group or unknown wire type")
            if at > end or number == 0:
                raise UnfitError("a field runs past its message")
            met.setdefault(number, []).append((wire, start, (start, at)))
        return met

    def _varint(self, at: int, end: int, exact: bool) -> tuple[int, int]:
        """Value and next offset; `exact` fixes the value itself, otherwise its width only."""
        value = 0
        for place in range(10):
            if at >= end:
                raise UnfitError("a number runs past its message")
            byte = self._payload[at]
            self.static[at] = 0xFF if exact else 0x80
            value |= (byte & 0x7F) << (7 * place)
            at += 1
            if byte < 0x80:
                return value, at
        raise UnfitError("a number of more than ten bytes")

    def _submessage(self, field: Any, tree: Mapping[Any, Any], raw: Raw) -> None:
        if raw[0] != _LEN:
            raise UnfitError("wire type")
        self.message(field.message_type, tree, raw[2])

    def _packed(self, field: Any, tree: Mapping[Any, Any], raw: Raw) -> None:
        """Elements of a packed array of fixed width."""
        if field.type not in _FIXED_WIDTH or raw[0] != _LEN:
            raise UnfitError("an array without fixed width")
        width = int(_FIXED_WIDTH[field.type][1][2])
        start, end = raw[2]
        if (end - start) % width:
            raise UnfitError("an array that ends inside an element")
        for index, subtree in tree.items():
            offset = start + width * index if isinstance(index, int) else end
            if offset < end:
                self._keep(subtree, Fixed(offset, _FIXED_WIDTH[field.type][1]))
            else:
                self._null(subtree)

    def _value(self, field: Any, raw: Raw) -> Field:
        wire, offset, (start, end) = raw
        if field.type in _FIXED_WIDTH and wire == _FIXED_WIDTH[field.type][0]:
            return Fixed(offset, _FIXED_WIDTH[field.type][1])
        if field.type == _STRING and wire == _LEN:
            return Text(start, end - start)
        if wire == _VARINT and field.type == _BOOL and end - start == 1:
            return Flag(offset)
        if wire == _VARINT and field.type in _VARINTS:
            bits, signed, zigzag = _VARINTS[field.type]
            return Varint(offset, end - start, bits, signed, zigzag)
        raise UnfitError("wire type")

    def _absent(self, field: Any, tree: Mapping[Any, Any]) -> None:
        """A field that is left out: null where presence is known or it is an array, else the default."""
        if field.is_repeated or field.has_presence:
            self._null(tree)
            return
        path = tree.get("")
        if path is not None:
            default = field.default_value
            dtype = self._types[path]
            self.fields[path] = Constant(float(default) if dtype == pl.Float64 else default, dtype)

    def _null(self, tree: Mapping[Any, Any]) -> None:
        for step, node in tree.items():
            if step == "":
                self.fields[node] = Constant(None, self._types[node])
            else:
                self._null(node)

    def _keep(self, tree: Mapping[Any, Any], field: Field) -> None:
        path = tree.get("")
        if path is None or len(tree) > 1:
            raise UnfitError("a field is used as a message")
        self.fields[path] = check_type(field, self._types[path])
