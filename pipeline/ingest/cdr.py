"""Columnar decoding of ROS 2 messages in CDR, laid out by the `ros2msg` text that the log carries."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from pipeline.ingest.layout import Field, Fixed, Flag, Text, UnfitError, check_type
from pipeline.ingest.ros_message import (
    PRIMITIVES,
    Definition,
    DefinitionError,
    RosWalk,
    parse_definitions,
    short_name,
)
from pipeline.ingest.template import Template, template_of


class CdrWalk:
    """Walks one message by its definition; calling it gives the template of the message's layout."""

    def __init__(self, name: str, text: str, types: Mapping[str, pl.DataType]) -> None:
        self._definitions = parse_definitions(name, text)
        self._root = short_name(name)
        self._types = types
        if self._root not in self._definitions:
            raise UnfitError(f"no definition of {name}")

    def __call__(self, payload: bytes) -> Template:
        try:
            walk = _Layout(payload, self._definitions, self._types)
            walk.message(self._root)
        except DefinitionError as error:
            raise UnfitError(str(error)) from None
        missing = set(self._types) - set(walk.fields)
        if missing:
            raise UnfitError(f"no field {', '.join(sorted(missing))}")
        return template_of(payload, walk.static, walk.fields)


class _Layout(RosWalk):
    """Where the wanted fields lie, and which bytes shape the message: those are checked on every message."""

    most_elements = 4096

    def __init__(self, payload: bytes, definitions: Mapping[str, Definition], types: Mapping[str, pl.DataType]) -> None:
        super().__init__(payload, definitions)
        self.fields: dict[str, Field] = {}
        self.static = bytearray(len(payload))
        self.static[0:2] = b"\xff\xff"
        self._types = types

    def on_number(self, path: str, kind: str, offset: int, count: int | None) -> None:
        code = PRIMITIVES[kind]
        if count is None:
            self._keep(path, code, kind, offset)
            return
        for wanted in self._types:
            index = wanted[len(path) + 1 : -1] if wanted.startswith(f"{path}[") else ""
            if index.isdigit() and int(index) < count:
                self._keep(wanted, code, kind, offset + int(code[1]) * int(index))

    def on_length(self, offset: int) -> None:
        self.static[offset : offset + 4] = b"\xff" * 4

    def on_text(self, path: str, offset: int, length: int) -> str:
        if path in self._types:
            if length == 0 or self.payload[offset + length - 1] != 0:
                raise UnfitError("a text without its closing zero")
            self.static[offset + length - 1] = 0xFF
            self.fields[path] = check_type(Text(offset, length - 1), self._types[path])
        return ""

    def _keep(self, path: str, code: str, kind: str, offset: int) -> None:
        if path in self._types:
            field: Field = Flag(offset) if kind == "bool" else Fixed(offset, ("<" if self.little else ">") + code)
            self.fields[path] = check_type(field, self._types[path])
