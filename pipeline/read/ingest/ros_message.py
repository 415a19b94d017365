"""ROS 2 messages: the `ros2msg` text that a log carries, one message of CDR by it, and the layout of such messages."""

from __future__ import annotations

import re
import sys
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import polars as pl

from pipeline.read.ingest.layout import Field, Layout, UnfitError, fixed, flag, layout_of, text

PRIMITIVES = {
    "bool": "u1", "byte": "u1", "char": "i1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
HEADER_SIZE = 4  # encapsulation: representation, options
DEEPEST = 32  # messages inside each other
_CODES = {"u1": "B", "i1": "b", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q", "f4": "f", "f8": "d"}
# One line at a time, and no two parts of the pattern that could take the same characters: the time is linear.
_LINE = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?\d{0,9}\])?\s+(?P<name>[A-Za-z]\w*)(?P<rest>(?:[\s=].*)?)",
    re.ASCII,
)


class DefinitionError(ValueError):
    """A definition that is not understood, or a message that does not follow it."""


@dataclass(frozen=True)
class Member:
    """A field of a message: `count` none for a single value, 0 for a sequence, else a fixed array."""

    name: str
    type: str
    count: int | None


Definition = tuple[Member, ...]
_TIME = (Member("sec", "uint32", None), Member("nanosec", "uint32", None))
_BUILT_IN = {"builtin_interfaces/Time": _TIME, "builtin_interfaces/Duration": _TIME}


@lru_cache(maxsize=64)  # the logs of a campaign share their schemas
def parse_definitions(name: str, text: str) -> Mapping[str, Definition]:
    """All messages of a concatenated definition by short name (`pkg/Type`); constants are left out."""
    met: dict[str, Definition] = {}
    for full, lines in _sections(name, text):
        members = tuple(member for line in lines if (member := _member(line, full.split("/")[0])))
        if len({member.name for member in members}) < len(members):
            raise DefinitionError(f"{full} names a field twice")
        if met.setdefault(short_name(full), members) != members:
            raise DefinitionError(f"{full} is defined twice with different content")
    return _BUILT_IN | met


def _sections(name: str, text: str) -> list[tuple[str, list[str]]]:
    """Name and lines of each message; lines of `=` part them, and `MSG:` names all but the first."""
    sections: list[tuple[str, list[str]]] = [(name, [])]
    for line in text.splitlines():
        if line.startswith("===") and not line.strip().strip("="):
            sections.append(("", []))
        elif line.startswith("MSG:"):
            sections[-1] = (line.removeprefix("MSG:").strip(), sections[-1][1])
        else:
            sections[-1][1].append(line)
    if not all(full for full, _ in sections):
        raise DefinitionError("a part of the definition has no name")
    return sections


def short_name(full: str) -> str:
    """`pkg/Type` of `pkg/msg/Type`."""
    parts = full.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _member(line: str, package: str) -> Member | None:
    content = line.split("#", 1)[0].strip()
    match = _LINE.fullmatch(content)
    if not content or (match and match["rest"].lstrip().startswith("=")):
        return None
    if match is None:
        raise DefinitionError(f"the definition line {content[:80]!r} is not understood")
    kind = match["type"]
    if kind not in PRIMITIVES and kind not in ("string", "wstring"):
        kind = short_name(kind) if "/" in kind else f"{package}/{kind}"
    size = match["array"]
    if size is None:
        return Member(match["name"], kind, None)
    return Member(match["name"], kind, int(size[1:-1]) if size[1:-1].isdigit() else 0)


class FieldPlace(NamedTuple):
    """Where a field lies: a number or flag, `size` of them in an array, or the bytes of a text."""

    kind: str
    offset: int
    size: int | None


class RosWalk:
    """One message of CDR, front to back, as a dict; numbers are aligned to their size, counted from behind the header.

    `places` and `lengths` tell where its fields and the lengths that shape it were met. Raises `DefinitionError` where
    the message does not follow its definition.
    """

    def __init__(self, payload: bytes, definitions: Mapping[str, Definition]) -> None:
        if len(payload) < HEADER_SIZE or payload[0] != 0 or payload[1] not in (0, 1):
            raise DefinitionError(f"encapsulation 0x{payload[:2].hex()} is not plain CDR")
        self.little = bool(payload[1])
        self.places: dict[str, FieldPlace] = {}
        self.lengths: list[int] = []
        self._payload = payload
        self._definitions = definitions
        self._at = HEADER_SIZE

    def message(self, name: str, path: str = "", depth: int = 0) -> dict[str, Any]:
        if name not in self._definitions or depth > DEEPEST:
            raise DefinitionError(f"no definition of {name}")
        members = self._definitions[name]
        if not members:
            self._take(1, 1)  # IDL knows no empty structure: ROS 2 puts one byte there
        return {m.name: self._member(m, f"{path}.{m.name}" if path else m.name, depth) for m in members}

    def _member(self, member: Member, path: str, depth: int) -> Any:
        if member.count is None:
            return self._value(member.type, path, depth)
        count = member.count or self._length()
        if member.type in PRIMITIVES:
            return self._numbers(member.type, path, count) if count else []
        return [self._value(member.type, f"{path}[{index}]", depth) for index in range(count)]

    def _value(self, kind: str, path: str, depth: int) -> Any:
        if kind in PRIMITIVES:
            return self._numbers(kind, path, None)[0]
        if kind == "string":
            return self._text(path)
        if kind == "wstring":
            raise DefinitionError("wide text is not read")
        return self.message(kind, path, depth + 1)

    def _numbers(self, kind: str, path: str, count: int | None) -> Sequence[Any]:
        code = PRIMITIVES[kind]
        size = int(code[1])
        offset = self._take(size * (1 if count is None else count), size)
        self.places[path] = FieldPlace(kind, offset, count)
        values = array(_CODES[code], self._payload[offset : self._at])
        if self.little != (sys.byteorder == "little"):
            values.byteswap()
        return [bool(value) for value in values] if kind == "bool" else values

    def _text(self, path: str) -> str:
        """A text with its closing zero, which programs leave out where there is no text."""
        length = self._length()
        offset = self._take(length, 1)
        self.places[path] = FieldPlace("string", offset, length)
        content = self._payload[offset : self._at]
        if content and content[-1]:
            raise DefinitionError("a text has no closing zero")
        try:
            return content[:-1].decode()
        except UnicodeDecodeError:
            raise DefinitionError("a text is not UTF-8") from None

    def _length(self) -> int:
        offset = self._take(4, 4)
        self.lengths.append(offset)
        return int.from_bytes(self._payload[offset : self._at], "little" if self.little else "big")

    def _take(self, size: int, alignment: int) -> int:
        start = self._at + -(self._at - HEADER_SIZE) % alignment
        if start + size > len(self._payload):
            raise DefinitionError("the message ends too early")
        self._at = start + size
        return start


def layout_of_cdr(
    definitions: Mapping[str, Definition], name: str, types: Mapping[str, pl.DataType], payload: bytes
) -> Layout:
    """Where the wanted fields lie, and which bytes shape the message."""
    try:
        walk = RosWalk(payload, definitions)
        walk.message(name)
    except DefinitionError as error:
        raise UnfitError(str(error)) from None
    static = bytearray(len(payload))
    static[0:2] = b"\xff\xff"
    for offset in walk.lengths:
        static[offset : offset + 4] = b"\xff" * 4
    fields: dict[str, Field] = {}
    for path, dtype in types.items():
        array = re.fullmatch(r"(.*)\[([0-9]+)\]", path)
        place = walk.places.get(path)
        index = 0
        if place is None and array and (whole := walk.places.get(array[1])) and int(array[2]) < (whole.size or 0):
            place = whole
            index = int(array[2])
        elif place is None or (place.size is not None and place.kind != "string"):
            raise UnfitError(f"no field {path}")
        fields[path] = _field(place, index, walk.little).as_type(dtype)
        if place.kind == "string":
            static[fields[path].end] = 0xFF  # the closing zero
    return layout_of(payload, static, fields)


def _field(place: FieldPlace, index: int, little: bool) -> Field:
    if place.kind == "string":
        if not place.size:
            raise UnfitError("a text without its closing zero")
        return text(place.offset, place.size - 1)
    code = PRIMITIVES[place.kind]
    offset = place.offset + index * int(code[1])
    return flag(offset) if place.kind == "bool" else fixed(offset, ("<" if little else ">") + code)
