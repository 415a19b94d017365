"""The layout of a ROS 2 message in CDR, by the `ros2msg` text that the log carries."""

from __future__ import annotations

import re
from collections.abc import Mapping

import polars as pl

from pipeline.ingest.layout import Field, Layout, UnfitError, fixed, flag, layout_of, text
from pipeline.ingest.ros_message import PRIMITIVES, Definition, DefinitionError, Place, RosWalk


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
        array = re.fullmatch(r"(.*)\[(\d+)\]", path)
        place, index = walk.places.get(path), 0
        if place is None and array and (found := walk.places.get(array[1])) and int(array[2]) < (found.size or 0):
            place, index = found, int(array[2])
        elif place is None or (place.size is not None and place.kind != "string"):
            raise UnfitError(f"no field {path}")
        fields[path] = _field(place, index, walk.little).as_type(dtype)
        if place.kind == "string":
            static[fields[path].end] = 0xFF  # the closing zero
    return layout_of(payload, static, fields)


def _field(place: Place, index: int, little: bool) -> Field:
    if place.kind == "string":
        if not place.size:
            raise UnfitError("a text without its closing zero")
        return text(place.offset, place.size - 1)
    code = PRIMITIVES[place.kind]
    offset = place.offset + index * int(code[1])
    return flag(offset) if place.kind == "bool" else fixed(offset, ("<" if little else ">") + code)
