"""Columnar decoding of ROS 2 messages in CDR, laid out by the `ros2msg` text that the log carries."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from pipeline.ingest.layout import Field, Fixed, Flag, Text, UnfitError, check_type
from pipeline.ingest.ros_message import (
    DEEPEST,
    HEADER_SIZE,
    PRIMITIVES,
    Definition,
    Member,
    parse_definitions,
    short_name,
)
from pipeline.ingest.template import Template, template_of

_MOST_ELEMENTS = 4096


class CdrWalk:
    """Walks one message by its definition; calling it gives the template of the message's layout."""

    def __init__(self, name: str, text: str, types: Mapping[str, pl.DataType]) -> None:
        self._definitions = parse_definitions(name, text)
        self._root = short_name(name)
        self._types = types
        if self._root not in self._definitions:
            raise UnfitError(f"no definition of {name}")

    def __call__(self, payload: bytes) -> Template:
        if len(payload) < HEADER_SIZE or payload[0] != 0 or payload[1] not in (0, 1):
            raise UnfitError("not plain CDR")
        walk = _Walk(payload, self._definitions, self._types)
        walk.message(self._root, "", 0)
        missing = set(self._types) - set(walk.fields)
        if missing:
            raise UnfitError(f"no field {', '.join(sorted(missing))}")
        return template_of(payload, walk.static, walk.fields)


class _Walk:
    """The state of one walk."""

    def __init__(self, payload: bytes, definitions: Mapping[str, Definition], types: Mapping[str, pl.DataType]) -> None:
        self.fields: dict[str, Field] = {}
        self.static = bytearray(len(payload))
        self.static[0:2] = b"\xff\xff"
        self._payload = payload
        self._definitions = definitions
        self._types = types
        self._at = HEADER_SIZE
        self._order = "little" if payload[1] else "big"
        self._mark = "<" if payload[1] else ">"

    def message(self, name: str, path: str, depth: int) -> None:
        if name not in self._definitions or depth > DEEPEST:
            raise UnfitError(f"no definition of {name}")
        members = self._definitions[name]
        if not members:
            self._skip(1, 1)  # IDL knows no empty structure: ROS 2 puts one byte there
        for member in members:
            self._member(member, f"{path}.{member.name}" if path else member.name, depth)

    def _member(self, member: Member, path: str, depth: int) -> None:
        if member.count is None:
            self._value(member.type, path, depth)
            return
        count = member.count or self._prefix()
        if member.type in PRIMITIVES:
            self._numbers(member.type, path, count)
            return
        if count > _MOST_ELEMENTS:
            raise UnfitError("too many elements")
        for index in range(count):
            self._value(member.type, f"{path}[{index}]", depth)

    def _value(self, kind: str, path: str, depth: int) -> None:
        if kind in PRIMITIVES:
            self._keep(path, kind, self._skip(_size(kind), _size(kind)))
        elif kind == "string":
            self._text(path)
        elif kind == "wstring":
            raise UnfitError("wide text")
        else:
            self.message(kind, path, depth + 1)

    def _numbers(self, kind: str, path: str, count: int) -> None:
        if count == 0:
            return
        size = _size(kind)
        offset = self._skip(size * count, size)
        for wanted in self._types:
            if wanted.startswith(f"{path}["):
                index = wanted[len(path) + 1 : -1]
                if index.isdigit() and int(index) < count:
                    self._keep(wanted, kind, offset + size * int(index))

    def _keep(self, path: str, kind: str, offset: int) -> None:
        if path not in self._types:
            return
        field: Field = Flag(offset) if kind == "bool" else Fixed(offset, self._mark + PRIMITIVES[kind])
        self.fields[path] = check_type(field, self._types[path])

    def _text(self, path: str) -> None:
        length = self._prefix()
        offset = self._skip(length, 1)
        if path in self._types:
            if length == 0 or self._payload[offset + length - 1] != 0:
                raise UnfitError("a text without its closing zero")
            self.static[offset + length - 1] = 0xFF
            self.fields[path] = check_type(Text(offset, length - 1), self._types[path])

    def _prefix(self) -> int:
        """A length, which shapes what follows and is therefore checked on every message."""
        offset = self._skip(4, 4)
        self.static[offset : offset + 4] = b"\xff" * 4
        return int.from_bytes(self._payload[offset : offset + 4], self._order)  # type: ignore[arg-type]

    def _skip(self, size: int, alignment: int) -> int:
        start = self._at + -(self._at - HEADER_SIZE) % alignment
        if start + size > len(self._payload):
            raise UnfitError("the message ends too early")
        self._at = start + size
        return start


def _size(kind: str) -> int:
    return int(PRIMITIVES[kind][1])
