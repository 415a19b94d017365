"""The layout of a protobuf message, by the descriptors that the log carries."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import polars as pl

from pipeline.read.ingest.layout import (
    Field,
    Layout,
    UndecodableError,
    Values,
    constant,
    fixed,
    flag,
    layout_of,
    parse_path,
    text,
)
from pipeline.read.ingest.mcap_block import Bytes

# Wire types (protobuf encoding guide).
_VARINT = 0
_I64 = 1
_LEN = 2
_I32 = 5
_LONGEST_TAG = 5  # bytes: tags and lengths are numbers of 32 bits
# descriptor.proto: FieldDescriptorProto.Type
_BOOL, _STRING, _MESSAGE, _BYTES = 8, 9, 11, 12
_FIXED_WIDTH = {1: "<f8", 6: "<u8", 16: "<i8", 2: "<f4", 7: "<u4", 15: "<i4"}
_WIRE_OF_WIDTH = {"8": _I64, "4": _I32, "": _VARINT}
# What remains of the 64 bits: an int32 below zero is written with all 64 bits of its sign.
_VARINTS = {3: np.int64, 4: np.uint64, 5: np.int32, 13: np.uint32, 14: np.int32}
_ZIGZAG = (17, 18)  # sint32, sint64

Raw = tuple[int, int, int]  # wire type, from, to


def layout_by(descriptor: Any, types: Mapping[str, pl.DataType]) -> Callable[[bytes], Layout]:
    """What finds the layout of a message: where the fields asked for lie in it."""
    tree: dict[str | int, Any] = {}
    for path in types:
        node = tree
        for step in parse_path(path):
            node = node.setdefault(step, {})
        node[""] = path
    return partial(_layout_of_message, descriptor, tree, types)


def _layout_of_message(
    descriptor: Any, tree: Mapping[Any, Any], types: Mapping[str, pl.DataType], payload: bytes
) -> Layout:
    """Where the wanted fields lie in this message."""
    walk = _ProtobufWalk(payload, types)
    walk.walk_message(descriptor, tree, 0, len(payload))
    return layout_of(payload, walk.static, walk.fields)


class _ProtobufWalk:
    """The walk through one message; what is not wanted only shapes the layout."""

    def __init__(self, payload: bytes, types: Mapping[str, pl.DataType]) -> None:
        self.fields: dict[str, list[Field]] = {}
        self.static = bytearray(len(payload))
        self._payload = payload
        self._types = types

    def walk_message(self, descriptor: Any, tree: Mapping[Any, Any], start: int, end: int) -> None:
        """The wanted fields of the message in this extent."""
        extents = self._scan(start, end)
        for step, subtree in tree.items():
            field = descriptor.fields_by_name.get(step) if isinstance(step, str) else None
            if field is None:
                raise UndecodableError(f"no field {step}")
            places = extents.get(field.number, [])
            if field.is_repeated:
                self._walk_elements(field, subtree, self._unpacked(field.type, places))
            elif len(places) > 1:
                raise UndecodableError(f"the field {step} occurs twice")
            elif places:
                self._walk_value(field, subtree, places[0])
            else:
                self._absent(field, subtree)

    def _walk_value(self, field: Any, tree: Mapping[Any, Any], place: Raw) -> None:
        """Take a wanted field, or walk on into its message."""
        if field.type == _MESSAGE and place[0] == _LEN:
            self.walk_message(field.message_type, tree, *place[1:])
        elif (path := tree.get("")) is None or len(tree) > 1:
            raise UndecodableError(f"the field {field.name} is no message")
        else:
            self.fields[path] = [_field_of_kind(field.type, *place).as_type(self._types[path])]

    def _scan(self, at: int, end: int) -> dict[int, list[Raw]]:
        """All fields of one message by number; tags, lengths and widths of varints are marked as static."""
        extents: dict[int, list[Raw]] = {}
        while at < end:
            tag, start = self._varint(at, end, 0xFF, _LONGEST_TAG)
            number = tag >> 3
            wire = tag & 7
            if wire == _VARINT:
                _, at = self._varint(start, end, 0x80)
            elif wire == _LEN:
                length, start = self._varint(start, end, 0xFF, _LONGEST_TAG)
                at = start + length
            elif wire in (_I64, _I32):
                at = start + (8 if wire == _I64 else 4)
            else:
                raise UndecodableError("a group or unknown wire type")
            if at > end or number == 0 or tag >> 32:
                raise UndecodableError("a field runs past its message")
            extents.setdefault(number, []).append((wire, start, at))
        return extents

    def _varint(self, at: int, end: int, mask: int, longest: int = 10) -> tuple[int, int]:
        """Value and next offset; the mask fixes the value itself, or its width only."""
        value = 0
        for place in range(longest):
            if at >= end:
                break
            byte = self._payload[at]
            self.static[at] = mask
            value |= (byte & 0x7F) << (7 * place)
            at += 1
            if byte < 0x80:
                return value, at
        raise UndecodableError("a number runs past its message, or is too long")

    def _unpacked(self, kind: int, places: list[Raw]) -> list[Raw]:
        """The elements of an array; numbers may be packed side by side."""
        elements: list[Raw] = []
        for wire, start, end in places:
            if wire == _LEN and kind not in (_STRING, _MESSAGE, _BYTES):
                elements += self._packed_places(kind, start, end)
            else:
                elements.append((wire, start, end))
        return elements

    def _packed_places(self, kind: int, at: int, end: int) -> Iterator[Raw]:
        """Places of numbers that are packed side by side."""
        dtype = _FIXED_WIDTH.get(kind, "")
        while at < end:
            start = at
            at = at + int(dtype[2]) if dtype else self._varint(at, end, 0x80)[1]
            if at > end:
                raise UndecodableError("an array ends inside a number")
            yield _WIRE_OF_WIDTH[dtype[2:]], start, at

    def _walk_elements(self, field: Any, tree: Mapping[Any, Any], elements: list[Raw]) -> None:
        """Take the wanted elements of an array; those that are not there are null."""
        for index, subtree in tree.items():
            if not isinstance(index, int):
                raise UndecodableError(f"the field {field.name} is an array")
            if index < len(elements):
                self._walk_value(field, subtree, elements[index])
            else:
                self._null(subtree)

    def _absent(self, field: Any, tree: Mapping[Any, Any]) -> None:
        """A field that is left out: null where presence is known, else the default."""
        if field.has_presence:
            self._null(tree)
        elif (path := tree.get("")) is not None:
            self.fields[path] = [constant(field.default_value, self._types[path])]

    def _null(self, tree: Mapping[Any, Any]) -> None:
        """Every field below an absent message is null."""
        for step, node in tree.items():
            if step == "":
                self.fields[node] = [constant(None, self._types[node])]
            else:
                self._null(node)


def _field_of_kind(kind: int, wire: int, start: int, end: int) -> Field:
    """How a field of this kind is read at its place."""
    if kind in _FIXED_WIDTH and wire == _WIRE_OF_WIDTH[_FIXED_WIDTH[kind][2:]]:
        return fixed(start, _FIXED_WIDTH[kind])
    if kind == _STRING and wire == _LEN:
        return text(start, end - start)
    if kind == _BOOL and wire == _VARINT and end - start == 1:
        return flag(start)
    if wire == _VARINT and (kind in _VARINTS or kind in _ZIGZAG):
        return Field(pl.Int64, start, end, lambda blocks: _varint_values(np.concatenate(blocks), kind))
    raise UndecodableError("a field is written as another type than its schema says")


def _varint_values(septets: Bytes, kind: int) -> Values:
    """Varints of one width."""
    total = np.zeros(len(septets), dtype=np.uint64)
    for place in range(septets.shape[1]):
        total |= (septets[:, place] & 0x7F).astype(np.uint64) << np.uint64(7 * place)
    if kind in _ZIGZAG:
        return (total >> np.uint64(1)).astype(np.int64) ^ -(total & np.uint64(1)).astype(np.int64)
    return total.astype(_VARINTS[kind])
