"""What a receiver's message is called, for the list of those that were met."""

from __future__ import annotations

import struct
from collections.abc import Callable

from pipeline.receivers.frames import Frame, Protocol
from pipeline.receivers.novatel import BINARY_NAMES


def name_of(frame: Frame) -> str:
    """Protocol and name, or number where no list has its name."""
    return f"{frame.protocol} {_NAMES[frame.protocol](frame.content)}"


def _ubx(content: bytes) -> str:
    from pyubx2 import UBX_MSGIDS

    return str(UBX_MSGIDS.get(content[2:4], f"{content[2]:#04x} {content[3]:#04x}"))


def _sbf(content: bytes) -> str:
    from pysbf2 import SBF_MSGIDS

    number = int.from_bytes(content[4:6], "little") & 0x1FFF
    return str(SBF_MSGIDS.get(number, (f"block {number}",))[0])


def _nmea(content: bytes) -> str:
    return content[1:].split(b",")[0].decode()


def _rtcm(content: bytes) -> str:
    return str(int.from_bytes(content[3:5], "big") >> 4)


def _novatel(content: bytes) -> str:
    if content[:1] in (b"#", b"%"):
        return content[1:].split(b",")[0].decode()
    number = struct.unpack_from("<H", content, 4)[0]
    return BINARY_NAMES.get(number, f"message {number}")


_NAMES: dict[Protocol, Callable[[bytes], str]] = {
    Protocol.UBX: _ubx,
    Protocol.SBF: _sbf,
    Protocol.NMEA: _nmea,
    Protocol.RTCM: _rtcm,
    Protocol.NOVATEL: _novatel,
}
