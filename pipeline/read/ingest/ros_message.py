"""ROS 2 messages: the `ros2msg` text that a log carries, and the layout of a message of CDR by it."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import polars as pl

from pipeline.read.ingest.layout import Field, Layout, UndecodableError, constant, fixed, flag, layout_of, text
from schemas.frozen import frozen

PRIMITIVES = {
    "bool": "u1", "byte": "u1", "char": "i1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
HEADER_SIZE = 4  # encapsulation: representation, options
DEEPEST = 32  # messages inside each other
_MOST_SHOWN = 64  # elements of an array that are named one by one
# One line at a time, and no two parts of the pattern that could take the same characters: the time is linear.
_LINE = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?\d{0,9}\])?\s+(?P<name>[A-Za-z]\w*)(?P<rest>(?:[\s=].*)?)",
    re.ASCII,
)


class DefinitionError(ValueError):
    """A definition that is not understood."""


@frozen
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
    by_short_name: dict[str, Definition] = {}
    for full, lines in _sections(name, text):
        members = tuple(member for line in lines if (member := _parse_member(line, full.split("/")[0])))
        if len({member.name for member in members}) < len(members):
            raise DefinitionError(f"{full} names a field twice")
        if by_short_name.setdefault(short_name(full), members) != members:
            raise DefinitionError(f"{full} is defined twice with different content")
    return _BUILT_IN | by_short_name


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


def _parse_member(line: str, package: str) -> Member | None:
    """The field that a line defines; None for comments, constants and empty lines."""
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
    """The walk through one message of CDR; numbers are aligned to their size, counted from behind the header.

    `places` tells where its fields were met, `counts` how many messages its arrays of them hold, `lengths` where what
    shapes it stands. Raises `UndecodableError` where the message does not follow its definition.
    """

    def __init__(self, payload: bytes, definitions: Mapping[str, Definition], name: str) -> None:
        if len(payload) < HEADER_SIZE or payload[0] != 0 or payload[1] not in (0, 1):
            raise UndecodableError(f"encapsulation 0x{payload[:2].hex()} is not plain CDR")
        self.little = bool(payload[1])
        self.places: dict[str, FieldPlace] = {}
        self.counts: dict[str, int] = {}
        self.lengths: list[int] = []
        self._payload = payload
        self._definitions = definitions
        self._at = HEADER_SIZE
        self._walk_message(name, "", 0)

    def kinds(self) -> Iterator[tuple[str, str]]:
        """The fields with their kind: `int`, `float`, `text`, `flag`."""
        for path, place in self.places.items():
            code = PRIMITIVES.get(place.kind)
            kind = "text" if code is None else "flag" if place.kind == "bool" else "float" if code[0] == "f" else "int"
            if code is None or place.size is None:
                yield path, kind
            else:
                yield from ((f"{path}[{index}]", kind) for index in range(min(place.size, _MOST_SHOWN)))

    def _walk_message(self, name: str, path: str, depth: int) -> None:
        """Walk through the members of a message."""
        if name not in self._definitions or depth > DEEPEST:
            raise UndecodableError(f"no definition of {name}")
        members = self._definitions[name]
        if not members:
            self._take_bytes(1, 1)  # IDL knows no empty structure: ROS 2 puts one byte there
        for member in members:
            self._walk_member(member, f"{path}.{member.name}" if path else member.name, depth)

    def _walk_member(self, member: Member, path: str, depth: int) -> None:
        """Walk through a member: a value, an array or a sequence."""
        if member.count is None:
            self._walk_value(member.type, path, depth)
            return
        count = member.count or self._read_length()
        if member.type in PRIMITIVES:
            if count:
                self._note_numbers(member.type, path, count)
            return
        self.counts[path] = count
        for index in range(count):
            self._walk_value(member.type, f"{path}[{index}]", depth)

    def _walk_value(self, kind: str, path: str, depth: int) -> None:
        """Walk through one value of a kind."""
        if kind in PRIMITIVES:
            self._note_numbers(kind, path, None)
        elif kind == "string":
            self._note_text(path)
        elif kind == "wstring":
            raise UndecodableError("wide text is not read")
        else:
            self._walk_message(kind, path, depth + 1)

    def _note_numbers(self, kind: str, path: str, count: int | None) -> None:
        """Note where a number, or so many of them, lie."""
        size = int(PRIMITIVES[kind][1])
        offset = self._take_bytes(size * (1 if count is None else count), size)
        self.places[path] = FieldPlace(kind, offset, count)

    def _note_text(self, path: str) -> None:
        """A text with its closing zero, which programs leave out where there is no text."""
        length = self._read_length()
        offset = self._take_bytes(length, 1)
        if length and self._payload[self._at - 1]:
            raise UndecodableError("a text has no closing zero")
        self.places[path] = FieldPlace("string", offset, length)

    def _read_length(self) -> int:
        """The length that stands here."""
        offset = self._take_bytes(4, 4)
        self.lengths.append(offset)
        return int.from_bytes(self._payload[offset : self._at], "little" if self.little else "big")

    def _take_bytes(self, size: int, alignment: int) -> int:
        """Where the next bytes of a size lie, aligned."""
        start = self._at + -(self._at - HEADER_SIZE) % alignment
        if start + size > len(self._payload):
            raise UndecodableError("the message ends too early")
        self._at = start + size
        return start


def layout_of_cdr(
    definition: tuple[Mapping[str, Definition], str], types: Mapping[str, pl.DataType], rows: str, payload: bytes
) -> Layout:
    """Where the wanted fields lie, and which bytes shape the message.

    `rows`: an array of which each element makes a row; fields that it does not hold are those of the message.
    """
    walk = RosWalk(payload, *definition)
    elements = [f"{rows}[{index}]." for index in range(walk.counts.get(rows, 0))] if rows else [""]
    fields = {
        path: [_field_of_path(walk, f"{element}{path}", path, dtype) for element in elements]
        for path, dtype in types.items()
    }
    static = bytearray(len(payload))
    static[0:2] = b"\xff\xff"
    for offset in walk.lengths:
        static[offset : offset + 4] = b"\xff" * 4
    for field in chain.from_iterable(fields.values()):
        if field.kind is pl.String and field.end > field.start:
            static[field.end] = 0xFF  # the closing zero
    return layout_of(payload, static, fields)


def _field_of_path(walk: RosWalk, path: str, outside: str, dtype: pl.DataType) -> Field:
    """The field of this path in an element or, by the path `outside` of it, in the message."""
    place = walk.places.get(path) or walk.places.get(outside)
    if place is not None and (place.size is None or place.kind == "string"):
        return _field_at(place, 0, walk.little).as_type(dtype)
    array = re.fullmatch(r"(.*)\[([0-9]+)\]", path)
    place = walk.places.get(array[1]) if array else None
    if array and place and int(array[2]) < (place.size or 0):
        return _field_at(place, int(array[2]), walk.little).as_type(dtype)
    if "[" not in path:
        raise UndecodableError(f"no field {path}")
    return constant(None, dtype)  # beyond the end of a sequence


def _field_at(place: FieldPlace, index: int, little: bool) -> Field:
    """How the field at a place is read; `index`: which element of an array."""
    if place.kind == "string":
        return text(place.offset, place.size - 1) if place.size else constant("", pl.String())
    code = PRIMITIVES[place.kind]
    offset = place.offset + index * int(code[1])
    return flag(offset) if place.kind == "bool" else fixed(offset, ("<" if little else ">") + code)
