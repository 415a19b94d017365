"""Flat ROS 2 messages: their definition, and rows in little-endian CDR (OMG DDSI-RTPS 2.2, clause 10)."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import Any

from schemas.arrays import NS_PER_S

Fields = tuple[tuple[str, str], ...]
"""Names and kinds: `time`, `double`, `int64`, `fixed32`, `level`, `bool`, `string`; `int8`, `uint8`, `uint16` (ROS 2
only), `doubles` and `covariance type` (protobuf only).
"""

_HEADER = b"\x00\x01\x00\x00"
# Kind: type in the definition, format, alignment; times and strings are laid out by themselves.
_PLAIN = {
    "double": ("float64", "<d", 8),
    "int64": ("int64", "<q", 8),
    "fixed32": ("uint32", "<I", 4),
    "level": ("uint8", "<B", 1),
    "bool": ("bool", "<?", 1),
    "int8": ("int8", "<b", 1),
    "uint8": ("uint8", "<B", 1),
    "uint16": ("uint16", "<H", 2),
}
_UNKNOWN: Mapping[str, Any] = {"double": float("nan"), "string": "", "bool": False}
_TIME = "\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"


def definition(fields: Fields) -> str:
    """The definition text as it stands in a bag."""
    kinds = {"time": "builtin_interfaces/Time", "string": "string"} | {kind: row[0] for kind, row in _PLAIN.items()}
    lines = [f"{kinds[kind]} {name}" for name, kind in fields]
    return "\n".join(lines) + (_TIME if any(kind == "time" for _, kind in fields) else "\n")


def cdr_messages(fields: Fields, rows: Iterator[Mapping[str, Any]]) -> Iterator[bytes]:
    """One message per row. What is not known is NaN, an empty text or false: this encoding has no null."""
    for row in rows:
        content = bytearray()
        for name, kind in fields:
            value = row[name] if row[name] is not None else _UNKNOWN[kind]
            _append(content, kind, value)
        yield _HEADER + bytes(content)


def _append(content: bytearray, kind: str, value: Any) -> None:
    if kind == "time":
        seconds, rest = divmod(value, NS_PER_S)
        content += bytes(-len(content) % 4) + struct.pack("<iI", seconds, rest)
    elif kind == "string":
        text = value.encode() + b"\0"
        content += bytes(-len(content) % 4) + struct.pack("<I", len(text)) + text
    else:
        _, form, alignment = _PLAIN[kind]
        content += bytes(-len(content) % alignment) + struct.pack(form, value)
