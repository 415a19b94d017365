"""ROS 2 messages: the `ros2msg` text that a log carries, and one message of CDR by it."""

from __future__ import annotations

import re
import sys
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

PRIMITIVES = {
    "bool": "u1", "byte": "u1", "char": "i1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
HEADER_SIZE = 4  # encapsulation: representation, options
DEEPEST = 32  # messages inside each other
_CODES = {"u1": "B", "i1": "b", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q", "f4": "f", "f8": "d"}
# One line at a time, and no two parts of the pattern that could take the same characters: the time is linear.
_LINE = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?P<array>\[(?:<=)?\d{0,9}\])?\s+(?P<name>[A-Za-z]\w*)(?P<rest>(?:[\s=].*)?)"
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


@lru_cache(maxsize=64)  # the logs of a campaign share their schemas
def parse_definitions(name: str, text: str) -> Mapping[str, Definition]:
    """All messages of a concatenated definition by short name (`pkg/Type`); constants are left out."""
    found: dict[str, Definition] = {"builtin_interfaces/Time": _TIME, "builtin_interfaces/Duration": _TIME}
    for full, lines in _sections(name, text):
        package = full.split("/")[0]
        found[short_name(full)] = tuple(member for line in lines if (member := _member(line, package)))
    return found


def _sections(name: str, text: str) -> list[tuple[str, list[str]]]:
    """Name and lines of each message; lines of `=` part them, and `MSG:` names all but the first."""
    found: list[tuple[str, list[str]]] = [(name, [])]
    for line in text.splitlines():
        if line.startswith("===") and not line.strip().strip("="):
            found.append(("", []))
        elif line.startswith("MSG:"):
            found[-1] = (line.removeprefix("MSG:").strip(), found[-1][1])
        else:
            found[-1][1].append(line)
    if not all(full for full, _ in found):
        raise DefinitionError("a part of the definition has no name")
    return found


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


def message_reader(name: str, text: str) -> Callable[[bytes], dict[str, Any]]:
    """Reads one message to a dict; raises `DefinitionError` where the message does not follow its definition."""
    definitions = parse_definitions(name, text)
    if short_name(name) not in definitions:
        raise DefinitionError(f"no definition of {name}")

    def read(payload: bytes) -> dict[str, Any]:
        if len(payload) < HEADER_SIZE or payload[0] != 0 or payload[1] not in (0, 1):
            raise DefinitionError(f"encapsulation 0x{payload[:2].hex()} is not plain CDR")
        return _Reader(payload, definitions).message(short_name(name), 0)

    return read


class _Reader:
    """One message, front to back; numbers are aligned to their size, counted from the end of the header."""

    def __init__(self, payload: bytes, definitions: Mapping[str, Definition]) -> None:
        self._payload = payload
        self._definitions = definitions
        self._at = HEADER_SIZE
        self._little = bool(payload[1])

    def message(self, name: str, depth: int) -> dict[str, Any]:
        if name not in self._definitions or depth > DEEPEST:
            raise DefinitionError(f"no definition of {name}")
        members = self._definitions[name]
        if not members:
            self._take(1, 1)  # IDL knows no empty structure: ROS 2 puts one byte there
        return {member.name: self._member(member, depth) for member in members}

    def _member(self, member: Member, depth: int) -> Any:
        if member.count is None:
            return self._value(member.type, depth)
        count = member.count or self._numbers("u4", 1)[0]
        if member.type in PRIMITIVES:
            values = self._numbers(PRIMITIVES[member.type], count)
            return [bool(value) for value in values] if member.type == "bool" else values
        return [self._value(member.type, depth) for _ in range(count)]

    def _value(self, kind: str, depth: int) -> Any:
        if kind in PRIMITIVES:
            value = self._numbers(PRIMITIVES[kind], 1)[0]
            return bool(value) if kind == "bool" else value
        if kind == "string":
            return self._text()
        if kind == "wstring":
            raise DefinitionError("wide text is not read")
        return self.message(kind, depth + 1)

    def _numbers(self, kind: str, count: int) -> Sequence[Any]:
        if not count:
            return []
        size = int(kind[1])
        values = array(_CODES[kind], self._take(size * count, size))
        if self._little != (sys.byteorder == "little"):
            values.byteswap()
        return values

    def _text(self) -> str:
        content = self._take(self._numbers("u4", 1)[0], 1)
        if content and content[-1]:
            raise DefinitionError("a text has no closing zero")
        try:
            return content[:-1].decode()
        except UnicodeDecodeError:
            raise DefinitionError("a text is not UTF-8") from None

    def _take(self, size: int, alignment: int) -> bytes:
        start = self._at + -(self._at - HEADER_SIZE) % alignment
        if start + size > len(self._payload):
            raise DefinitionError("the message ends too early")
        self._at = start + size
        return self._payload[start : self._at]
