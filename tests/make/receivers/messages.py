"""Messages of receivers written by hand, so that every bit in them is known."""

from __future__ import annotations

import struct
from binascii import crc_hqx
from collections.abc import Sequence

DO_NOT_USE = -2e10


def ubx(kind: bytes, payload: bytes) -> bytes:
    body = kind + struct.pack("<H", len(payload)) + payload
    first = second = 0
    for byte in body:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return b"\xb5\x62" + body + bytes([first, second])


def nav_pvt(
    itow_ms: int,
    calendar: Sequence[int] = (2025, 6, 1, 12, 0, 0),
    *,
    valid: int = 7,
    nano: int = 0,
    fix: int = 3,
    flags: int = 1,
    flags3: int = 0,
) -> bytes:
    """Latitude 50.5, longitude 4.5, height 100 m; velocity 2 m/s east, 1 m/s north, 0.3 m/s up."""
    accuracy, plane = (20, nano, fix, flags, 0, 9), (45_000_000, 505_000_000, 100_000, 55_000, 1500, 2500)
    motion = (1000, 2000, -300, 2236, 0, 100, 100, 120, flags3, 0, 0, 0, 0)
    return ubx(b"\x01\x07", struct.pack("<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIihH", itow_ms, *calendar, valid,
                                        *accuracy, *plane, *motion))  # fmt: skip


def nav_hpposllh(itow_ms: int, invalid: bool = False) -> bytes:
    """The position of `nav_pvt` with 37e-9, -42e-9 degrees and 0.5 mm more."""
    head = (0, 0, 0, int(invalid), itow_ms)
    place = (45_000_000, 505_000_000, 100_123, 55_123, 37, -42, 5, 0, 140, 200)
    return ubx(b"\x01\x14", struct.pack("<BBBBIiiiibbbbII", *head, *place))


def nav_cov(itow_ms: int) -> bytes:
    """Covariance 4, 1, 9 m2 north, east, down; north-east 0.5, north-down 0.25, east-down -0.125."""
    values = (4.0, 0.5, 0.25, 1.0, -0.125, 9.0)
    return ubx(b"\x01\x36", struct.pack("<IBBB9x6f6f", itow_ms, 0, 1, 1, *values, *values))


def sentence(body: str) -> bytes:
    checksum = 0
    for character in body.encode():
        checksum ^= character
    return f"${body}*{checksum:02X}\r\n".encode()


def gga(time: str, *, talker: str = "GP", quality: str = "1", tail: str = ",") -> bytes:
    return sentence(f"{talker}GGA,{time},5030.00000,N,00430.00000,E,{quality},09,0.9,55.0,M,45.0,M,{tail}")


def rmc(time: str, date: str = "010625", *, talker: str = "GP", status: str = "A", mode: str = "A") -> bytes:
    return sentence(f"{talker}RMC,{time},{status},5030.00000,N,00430.00000,E,40.0,090.0,{date},,,{mode}")


def sbf(number: int, tow_ms: int, week: int, content: bytes) -> bytes:
    body = struct.pack("<IH", tow_ms, week) + content
    body += bytes(-len(body) % 4)
    block = struct.pack("<HH", number, 8 + len(body)) + body
    return b"$@" + struct.pack("<H", crc_hqx(block, 0)) + block


def pvt_geodetic(
    tow_ms: int,
    mode: int = 6,
    *,
    week: int = 2368,
    error: int = 0,
    place: Sequence[float] = (0.88, 0.08, 100.0),
    velocity: Sequence[float] = (1.0, 2.0, 0.3),
    reference: int = 123,
    age: int = 250,
) -> bytes:
    """Latitude and longitude [rad], height over the ellipsoid; velocity north, east, up."""
    head = struct.pack("<BB3df3f", mode, error, *place, 45.0, *velocity)
    clock = struct.pack("<fdfBBBBHHI", 0.0, 0.0, 0.0, 0, 0, 12, 0, reference, age, 0)
    return sbf(4007 | 2 << 13, tow_ms, week, head + clock + struct.pack("<BBHHHHB", 0, 1, 0, 55, 102, 138, 0))


def pos_cov_geodetic(tow_ms: int, week: int = 2368, *, unknown: bool = False) -> bytes:
    """Covariance 4, 1, 9 m2 of latitude, longitude, height; lat-lon 0.5, lat-height 0.25, lon-height -0.125."""
    values = (4.0, 1.0, 9.0, 16.0, 0.5, 0.25, 0.0, -0.125, 0.0, 0.0)
    return sbf(5906, tow_ms, week, struct.pack("<BB10f", 6, 0, *((DO_NOT_USE,) * 10 if unknown else values)))


def dop(tow_ms: int, hpl_m: float, vpl_m: float, week: int = 2368) -> bytes:
    return sbf(4001, tow_ms, week, struct.pack("<BBHHHHff", 12, 0, 100, 80, 90, 110, hpl_m, vpl_m))
