"""Which fields the messages of a channel hold, found on one of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

_LARGEST_LIST = 64  # elements of a list that are offered one by one
_DEEPEST = 12

SECONDS = ("sec", "secs", "seconds")
NANOSECONDS = ("nanosec", "nsec", "nsecs", "nanos")


def fields_of(message: Any) -> dict[str, str]:
    """Field paths of a decoded message with their kind: `int`, `float`, `text`, `flag`, `null`."""
    return dict(_leaves(message, "", 0))


def _leaves(value: Any, path: str, depth: int) -> Iterator[tuple[str, str]]:
    if depth > _DEEPEST:
        return
    children = _children(value)
    if children is None:
        yield path, _kind(value)
        return
    for name, child in children:
        joined = f"{path}{name}" if name.startswith("[") or not path else f"{path}.{name}"
        yield from _leaves(child, joined, depth + 1)


def _children(value: Any) -> list[tuple[str, Any]] | None:
    """Named parts of a message or list; none for a plain value."""
    if isinstance(value, dict):
        return [(str(name), child) for name, child in value.items()]
    descriptor = getattr(value, "DESCRIPTOR", None)
    if descriptor is not None:
        return [(field.name, _protobuf_child(value, field)) for field in descriptor.fields]
    if isinstance(value, str | bytes) or not hasattr(value, "__len__"):
        return None
    return [(f"[{index}]", child) for index, child in enumerate(list(value[:_LARGEST_LIST]))]


def _protobuf_child(message: Any, field: Any) -> Any:
    """The value; a message field that is not set is shown with its defaults, down to one level of a type."""
    value = getattr(message, field.name)
    recursive = field.message_type is not None and field.message_type is message.DESCRIPTOR
    return None if recursive else value


def _kind(value: Any) -> str:
    if isinstance(value, bool):
        return "flag"
    if isinstance(value, int):
        return "int"
    if isinstance(value, float):
        return "float"
    return "null" if value is None else "text"


def stamp_parts(fields: dict[str, str], path: str) -> tuple[str, ...]:
    """The fields of a stamp: seconds and nanoseconds, or the one field itself; empty if it is not there."""
    for seconds in SECONDS:
        for nanoseconds in NANOSECONDS:
            parts = (f"{path}.{seconds}", f"{path}.{nanoseconds}")
            if parts[0] in fields and parts[1] in fields:
                return parts
    return (path,) if path in fields and fields[path] != "null" else ()
