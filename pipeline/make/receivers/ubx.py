"""u-blox UBX, gathered by iTOW: NAV-PVT or NAV-PVAT with NAV-COV, NAV-PL, NAV-SBAS, NAV-HPPOSLLH.

Satellites: NAV-SAT or NAV-SVINFO. Receivers before generation 7 send no NAV-PVT and are not read.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from pipeline.make.receivers.epochs import Gathered, covariance_columns, satellite_name, velocity_columns
from pipeline.read.ingest.recipes_drivers import UBX_SYSTEMS
from schemas.arrays import NS_PER_S
from schemas.enums import Fix

Columns = dict[str, Any]

_UNRESOLVED = "time not yet resolved by the receiver (kept as stated)"
_WEEK_MS = 604_800_000
_LEAP_NS = 60 * NS_PER_S  # leap seconds and more: what is farther off is of another week

_SYSTEMS_BY_NAME = {"GPS": "G", "SBAS": "S", "Galileo": "E", "BeiDou": "C", "QZSS": "J", "GLONASS": "R", "NavIC": "I"}
# Numbers of satellites in NAV-SVINFO: first of the system, last, letter, number of the first.
_SVIDS = (
    (1, 32, "G", 1), (33, 64, "C", 6), (65, 96, "R", 1), (120, 158, "S", 20), (159, 163, "C", 1), (193, 202, "J", 1),
    (211, 246, "E", 1),
)  # fmt: skip


def parse(raw: bytes) -> Any:
    """The message, none if it is of no interest."""
    from pyubx2 import UBXReader

    return UBXReader.parse(raw) if raw[2:4] in _WANTED else None


def decode(gathered: Gathered, message: Any, raw: bytes) -> None:
    """Add what this message says to its epoch, whose key is the time of the week."""
    is_position = message.identity in _POSITIONS
    epoch = gathered.epoch_at(message.iTOW, message.identity if is_position else "", raw)
    if is_position:
        epoch.t_ns = _time_ns(message)
        if epoch.t_ns is not None and not getattr(message, "fullyResolved", 1):
            gathered.count_dropped(_UNRESOLVED)
            epoch.unresolved = True
    for what, rank, columns_of in _CONTENTS.get(message.identity, ()):
        if columns := columns_of(message):
            epoch.put_columns(what, rank, columns)
    if message.identity == "NAV-PL" and not message.plPosValid:
        gathered.count_dropped("protection level not valid")
    if message.identity == "NAV-SAT":
        epoch.satellites = _satellite_rows(message, message.numSvs, 1.0)
    elif message.identity == "NAV-SVINFO" and not epoch.satellites:
        epoch.satellites = _satellite_rows(message, message.numCh, 1e-2)


def settle_times(gathered: Gathered) -> None:
    """UTC of epochs that the receiver had not resolved yet: the time of the week goes on from the next that it had.

    Where it never had, times stay as they are stated, and are counted as what they are.
    """
    resolved = 0
    for epochs in (gathered.epochs[::-1], gathered.epochs):
        known: tuple[int, int] | None = None
        for epoch in epochs:
            if epoch.t_ns is None:
                continue
            if not epoch.unresolved:
                known = (epoch.t_ns, int(epoch.key))
            elif known is not None:
                since_ms = (int(epoch.key) - known[1] + _WEEK_MS // 2) % _WEEK_MS - _WEEK_MS // 2
                if abs(since_ms * 1_000_000 - (epoch.t_ns - known[0])) <= _LEAP_NS:
                    epoch.t_ns, epoch.unresolved = known[0] + since_ms * 1_000_000, False
                    resolved += 1
    if resolved:
        left = gathered.dropped.pop(_UNRESOLVED, 0) - resolved
        gathered.count_dropped(_UNRESOLVED, left)
        gathered.count_dropped("time not yet resolved (put right by the time of the week)", resolved)


def _time_ns(m: Any) -> int | None:
    """UTC of the calendar and `nano`, none where it is not valid or no day [ns since 1970]."""
    if not (m.validDate and m.validTime):
        return None
    try:
        minute = datetime(m.year, m.month, m.day, m.hour, m.min, tzinfo=UTC)
    except ValueError:
        return None
    second = int(m.second if hasattr(m, "second") else m.sec)
    return (int(minute.timestamp()) + second) * NS_PER_S + int(m.nano)


def _fix_columns(m: Any) -> Columns:
    """Kind of fix, and number of satellites used."""
    return {"fix": _fix_kind(m).value, "satellites": m.numSV}


def _fix_kind(m: Any) -> Fix:
    """Kind of fix from `fixType`, the flag that it is within its limits, `diffSoln` and `carrSoln`."""
    good = m.gnssFixOk if hasattr(m, "gnssFixOk") else m.gnssFixOK
    if not good or getattr(m, "invalidLlh", False) or m.fixType in (0, 5):  # none, time only
        return Fix.NONE
    if m.fixType == 1:
        return Fix.ESTIMATED
    if m.carrSoln in (1, 2):
        return Fix.RTK_FIXED if m.carrSoln == 2 else Fix.RTK_FLOAT
    return Fix.DIFFERENTIAL if m.diffSoln else Fix.AUTONOMOUS


def _position_columns(m: Any) -> Columns:
    """Longitude and latitude [deg] and height over the ellipsoid [mm]."""
    return {"latitude_deg": m.lat, "longitude_deg": m.lon, "height_m": m.height / 1e3}


def _velocity_columns(m: Any) -> Columns:
    """Velocity [mm/s]."""
    return velocity_columns(m.velE / 1e3, m.velN / 1e3, -(m.velD / 1e3))


def _accuracy_columns(m: Any) -> Columns:
    """Variances from `hAcc`, the deviation in the plane (half of its variance on each axis), and `vAcc` [mm]."""
    plane = 0.5 * (m.hAcc / 1e3) ** 2
    return covariance_columns(plane, 0.0, 0.0, plane, 0.0, (m.vAcc / 1e3) ** 2)


def _covariance_columns(m: Any) -> Columns:
    """Covariance of a position, if the receiver states one."""
    values = (m.posCovEE, m.posCovNE, -m.posCovED, m.posCovNN, -m.posCovND, m.posCovDD)
    return covariance_columns(*values) if m.posCovValid else {}


def _protection_columns(m: Any) -> Columns:
    """Protection levels: plPos1 and plPos2 are the horizontal axes of the ellipsoid, plPos3 the vertical one [mm]."""
    return {"hpl_m": max(m.plPos1, m.plPos2) / 1e3, "vpl_m": m.plPos3 / 1e3} if m.plPosValid else {}


def _satellite_rows(m: Any, count: int, residual_m: float) -> list[Columns]:
    """Satellites known and above or below a horizon [deg]; `residual_m`: the unit of the residual."""
    rows: list[Columns] = []
    for index in range(1, count + 1):
        azimuth, elevation, residual, used = (
            getattr(m, f"{name}_{index:02d}") for name in ("azim", "elev", "prRes", "svUsed")
        )
        name = _satellite_name(m, index)
        if name is not None and abs(float(elevation)) <= 90.0:
            rows.append(
                {
                    "sv": name,
                    "azimuth_deg": float(azimuth),
                    "elevation_deg": float(elevation),
                    "residual_m": residual * residual_m if used else None,
                    "used": bool(used),
                }
            )
    return rows


def _satellite_name(m: Any, index: int) -> str | None:
    """Name of a satellite; None where the receiver does not know its number (255)."""
    if m.identity == "NAV-SVINFO":
        svid = getattr(m, f"svid_{index:02d}")
        known = ((system, svid - low + first) for low, high, system, first in _SVIDS if low <= svid <= high)
        return next((satellite_name(*satellite) for satellite in known), None)
    system = getattr(m, f"gnssId_{index:02d}")  # pyubx2 gives systems by name or by number
    letter = _SYSTEMS_BY_NAME.get(str(system), UBX_SYSTEMS.get(system, "X"))
    return satellite_name(letter, getattr(m, f"svId_{index:02d}"))


# What messages say of an epoch, and with which rank: it gives way to a higher one.
_PVT = (
    ("fix", 0, _fix_columns),
    ("place", 0, _position_columns),
    ("velocity", 0, _velocity_columns),
    ("accuracy", 0, _accuracy_columns),
)
_CONTENTS: dict[str, tuple[tuple[str, int, Callable[[Any], Columns]], ...]] = {
    "NAV-PVT": _PVT,
    "NAV-PVAT": _PVT,
    "NAV-HPPOSLLH": (("place", 1, lambda m: {} if m.invalidLlh else _position_columns(m)),),
    "NAV-COV": (("accuracy", 1, _covariance_columns),),
    "NAV-PL": (("protection", 0, _protection_columns),),
    "NAV-SBAS": (("sbas", 0, lambda m: {"sbas_prn": m.geo} if m.geo and m.mode else {}),),
}
_POSITIONS = ("NAV-PVT", "NAV-PVAT")
# Class and id of the messages above, of NAV-SAT and of NAV-SVINFO.
_WANTED = frozenset(b"\x01" + bytes([number]) for number in (0x07, 0x14, 0x17, 0x30, 0x32, 0x35, 0x36, 0x62))
