"""Whole messages of a receiver log: UBX, SBF, NMEA and NovAtel, by their start, length and checksum.

A start whose message does not prove whole counts as damaged, and the search goes on right behind that start: a
damaged length hides nothing of what follows it.
"""

from __future__ import annotations

import re
from binascii import crc32, crc_hqx
from collections.abc import Callable, Iterator
from enum import StrEnum
from functools import reduce
from itertools import accumulate
from operator import xor
from typing import NamedTuple


class Protocol(StrEnum):
    """A protocol of receivers: how its messages begin, and how the end of one is found."""

    UBX = "UBX"
    SBF = "SBF"
    NMEA = "NMEA"
    NOVATEL = "NovAtel"


class Frame(NamedTuple):
    """One whole message, start and checksum included."""

    protocol: Protocol
    content: bytes


# What a message begins with; a search for these bytes passes over what lies between messages, which may be gigabytes.
_FIRST = b"\xb5$\xaa#%"
_START = re.compile(
    rb"(?=[" + _FIRST + rb"])(?:"
    rb"(?P<UBX>\xb5\x62)|(?P<SBF>\$@)|(?P<NOVATEL>\xaaD[\x12\x13]|[#%][A-Z][A-Z0-9_]+A,)"
    rb"|(?P<NMEA>\$(?:[A-Z]{2}[A-Z0-9]{3}|P[A-Z0-9]{3,6}),))"
)
_SENTENCE = re.compile(rb"\$([ -#%-)+-~]+)\*([0-9A-Fa-f]{2})\r?\n?")
_BARE_SENTENCE = re.compile(rb"\$[ -#%-)+-~]+\r?\n")
# Commas of whole sentences that are decoded: a line with fewer was cut off.
_LEAST_FIELDS = {b"GGA": 14, b"GNS": 12, b"RMC": 11, b"GST": 8, b"ZDA": 6}
_NOVATEL_LINE = re.compile(rb"[#%]([ -)+-~]+)\*([0-9A-Fa-f]{8})\r?\n?")
_NOVATEL_SHORT_HEAD = 12
_NOVATEL_CRC = 4
# Of binary messages that are decoded.
NOVATEL_NAMES = {
    42: "BESTPOS", 47: "PSRPOS", 99: "BESTVEL", 507: "INSPVA", 508: "INSPVAS", 1429: "BESTGNSSPOS", 1465: "INSPVAX",
}  # fmt: skip
_UBX_OVERHEAD = 8
_SBF_HEAD = 8


def whole_messages(
    content: bytes, on_damage: Callable[[], None], on_unchecked: Callable[[], None] | None = None
) -> Iterator[Frame]:
    """All whole messages in order; `on_damage` is called once for each that is damaged or cut off.

    `on_unchecked`: for each sentence that ends its line without a checksum, which shows neither damage nor its absence.
    """
    if not any(first in content for first in _FIRST):
        return
    at = 0
    while start := _START.search(content, at):
        protocol = Protocol[str(start.lastgroup)]
        end = _ENDS[protocol](content, start.start())
        if end is not None:
            yield Frame(protocol, content[start.start() : end])
            at = end
            continue
        bare = _BARE_SENTENCE.match(content, start.start()) if protocol is Protocol.NMEA else None
        if bare is None or bare[0].count(b",") < _LEAST_FIELDS.get(bare[0][3:6], 1):
            on_damage()
            at = start.start() + 1
        else:
            (on_unchecked or on_damage)()
            at = bare.end()


def _ubx_end(content: bytes, start: int) -> int | None:
    """End of a whole message in the content, None if damaged. "UBX checksum": 8-bit Fletcher over class to payload."""
    end = start + _UBX_OVERHEAD + int.from_bytes(content[start + 4 : start + 6], "little")
    if end > len(content):
        return None
    body = content[start + 2 : end - 2]
    checksum = bytes((sum(body) & 0xFF, sum(accumulate(body)) & 0xFF))
    return end if content[end - 2 : end] == checksum else None


def _sbf_end(content: bytes, start: int) -> int | None:
    """End of a whole block in the content, None if damaged. "Block header": CRC-CCITT over id, length and body.

    The length is a multiple of four (SBF reference guide).
    """
    length = int.from_bytes(content[start + 6 : start + 8], "little")
    if length < _SBF_HEAD or length % 4 or start + length > len(content):
        return None
    crc = int.from_bytes(content[start + 2 : start + 4], "little")
    return start + length if crc_hqx(content[start + 4 : start + length], 0) == crc else None


def _nmea_end(content: bytes, start: int) -> int | None:
    """End of a whole sentence in the content, None if damaged. NMEA 0183: exclusive or from `$` to `*`."""
    sentence = _SENTENCE.match(content, start)
    if sentence is None or reduce(xor, sentence[1]) != int(sentence[2], 16):
        return None
    return sentence.end()


def _novatel_end(content: bytes, start: int) -> int | None:
    """End of a whole log in the content, None if damaged. "32-bit CRC" over all, of ASCII without its sign (OEM7)."""
    if content[start : start + 1] in (b"#", b"%"):
        line = _NOVATEL_LINE.match(content, start)
        return line.end() if line and _crc32(line[1]) == int(line[2], 16) else None
    if len(content) < start + _NOVATEL_SHORT_HEAD:
        return None
    if content[start + 2] == 0x13:
        end = start + _NOVATEL_SHORT_HEAD + content[start + 3] + _NOVATEL_CRC
    else:
        end = start + content[start + 3] + int.from_bytes(content[start + 8 : start + 10], "little") + _NOVATEL_CRC
    crc = content[end - _NOVATEL_CRC : end]
    return (
        end if len(crc) == _NOVATEL_CRC and _crc32(content[start : end - 4]) == int.from_bytes(crc, "little") else None
    )


def _crc32(content: bytes) -> int:
    """The CRC of zip files without its inversions at begin and end."""
    return crc32(content, 0xFFFFFFFF) ^ 0xFFFFFFFF


_ENDS: dict[Protocol, Callable[[bytes, int], int | None]] = {
    Protocol.UBX: _ubx_end,
    Protocol.SBF: _sbf_end,
    Protocol.NMEA: _nmea_end,
    Protocol.NOVATEL: _novatel_end,
}


def name_of(frame: Frame) -> str:
    """Protocol and name of a message, or its number where no list has its name."""
    protocol, content = frame
    if protocol is Protocol.NMEA or content[:1] in (b"#", b"%"):
        name = content[1:].split(b",")[0].decode()
    elif protocol is Protocol.UBX:
        from pyubx2 import UBX_MSGIDS

        name = str(UBX_MSGIDS.get(content[2:4], f"{content[2]:#04x} {content[3]:#04x}"))
    elif protocol is Protocol.SBF:
        from pysbf2 import SBF_MSGIDS

        number = int.from_bytes(content[4:6], "little") & 0x1FFF
        name = str(SBF_MSGIDS.get(number, (f"block {number}",))[0])
    else:
        number = int.from_bytes(content[4:6], "little")
        name = NOVATEL_NAMES.get(number, f"message {number}")
    return f"{protocol} {name}"
