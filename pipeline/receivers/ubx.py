"""u-blox UBX, gathered by iTOW: NAV-PVT or NAV-PVAT with NAV-COV, NAV-PL, NAV-SBAS, NAV-SAT and NAV-HPPOSLLH.

What older receivers send in place of NAV-PVT is read by `ubx_early`.
"""

from __future__ import annotations

from typing import Any

from pipeline.receivers import ubx_early
from pipeline.receivers.epochs import Epoch, Gathered, satellite_name
from pipeline.receivers.ubx_fields import accuracy, calendar_ns, covariance, fix_of, place, satellites_of, velocity
from schemas.enums import Fix

_SYSTEMS = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R", 7: "I"}
_SYSTEMS_BY_NAME = {"GPS": "G", "SBAS": "S", "Galileo": "E", "BeiDou": "C", "QZSS": "J", "GLONASS": "R", "NavIC": "I"}
_PVT = ubx_early.HIGHEST_RANK + 1
_REFINED = _PVT + 1


def parse(raw: bytes) -> Any:
    """The message, none if it is of no interest."""
    from pyubx2 import UBXReader

    return UBXReader.parse(raw) if raw[2:4] in _WANTED else None


class UbxDecoder:
    """Keeps count of the weeks while messages go by: most of them only tell the time of the week."""

    def __init__(self) -> None:
        self._week = 0
        self._latest_ms = 0

    def decode(self, gathered: Gathered, message: Any, raw: bytes) -> None:
        """Add what this message says to its epoch."""
        if self._latest_ms - message.iTOW > _HALF_WEEK_MS:
            self._week += 1
        self._latest_ms = message.iTOW
        told = _time_ns(message)
        position = message.identity if message.identity in _POSITIONS else ""
        epoch = gathered.at((self._week, message.iTOW), position, raw)
        if epoch.t_ns is not None and told is not None and abs(told[1] - epoch.t_ns) > _SAME_MOMENT_NS:
            # The same moment of another week: the log was interrupted, or several were joined.
            self._week += 1
            epoch = gathered.at((self._week, message.iTOW), position, raw)
        if told is not None:
            epoch.tell_time(*told)
        if message.identity in _DECODERS:
            _DECODERS[message.identity](gathered, epoch, message)


def _time_ns(m: Any) -> tuple[int, int] | None:
    """Rank of the message's time, and UTC as the receiver states it [ns since 1970]; none before it knows."""
    if m.identity not in ("NAV-PVT", "NAV-PVAT"):
        return ubx_early.time_ns(m)
    if not (m.validDate and m.validTime):
        return None
    t_ns = calendar_ns(m, int(m.second if hasattr(m, "second") else m.sec))
    return None if t_ns is None else (_PVT, t_ns)


def _position(_: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-PVT and NAV-PVAT: position [deg, mm], velocity [mm/s], accuracy [mm], kind of fix."""
    good = m.gnssFixOk if hasattr(m, "gnssFixOk") else m.gnssFixOK
    fix = Fix.NONE if getattr(m, "invalidLlh", False) else fix_of(m.fixType, good, m.diffSoln, m.carrSoln)
    epoch.tell("fix", _PVT, {"fix": fix.value, "satellites": m.numSV})
    epoch.tell("place", _PVT, place(m))
    epoch.tell("velocity", _PVT, velocity(m.velE / 1e3, m.velN / 1e3, m.velD / 1e3))
    epoch.tell("accuracy", _PVT, accuracy(m.hAcc / 1e3, m.vAcc / 1e3))


def _precise(_: Gathered, epoch: Epoch, m: Any) -> None:
    if not m.invalidLlh:
        epoch.tell("place", _REFINED, place(m))


def _covariances(_: Gathered, epoch: Epoch, m: Any) -> None:
    if m.posCovValid:
        values = (m.posCovEE, m.posCovNE, -m.posCovED, m.posCovNN, -m.posCovND, m.posCovDD)
        epoch.tell("accuracy", _REFINED, covariance(*values))


def _protection(gathered: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-PL: plPos1 and plPos2 are the horizontal axes of the ellipsoid, plPos3 the vertical one [mm]."""
    if not m.plPosValid:
        gathered.drop("protection level not valid")
        return
    epoch.gnss |= {"hpl_m": max(m.plPos1, m.plPos2) / 1e3, "vpl_m": m.plPos3 / 1e3}


def _sbas(_: Gathered, epoch: Epoch, m: Any) -> None:
    if m.geo and m.mode:
        epoch.gnss["sbas_prn"] = m.geo


def _satellites(_: Gathered, epoch: Epoch, m: Any) -> None:
    epoch.satellites = satellites_of(m, m.numSvs, _name, ("gnssId", "svId"), 1.0)


def _name(system: Any, number: int) -> str:
    """pyubx2 gives systems by name or by number."""
    return satellite_name(_SYSTEMS_BY_NAME.get(str(system), _SYSTEMS.get(system, "X")), number)


_HALF_WEEK_MS = 302_400_000
# Messages of one epoch may round its time, and know another number of leap seconds before they have been received.
_SAME_MOMENT_NS = 60_000_000_000
_POSITIONS = ("NAV-PVT", "NAV-PVAT", "NAV-SOL", "NAV-POSLLH")
_DECODERS = {
    "NAV-PVT": _position,
    "NAV-PVAT": _position,
    "NAV-HPPOSLLH": _precise,
    "NAV-COV": _covariances,
    "NAV-PL": _protection,
    "NAV-SBAS": _sbas,
    "NAV-SAT": _satellites,
    "NAV-SOL": ubx_early.solution,
    "NAV-STATUS": ubx_early.status,
    "NAV-POSLLH": ubx_early.position,
    "NAV-VELNED": ubx_early.motion,
    "NAV-SVINFO": ubx_early.satellites,
}
# Class and id of the messages above, and of NAV-TIMEGPS and NAV-TIMEUTC.
_WANTED = frozenset(
    b"\x01" + bytes([number])
    for number in (0x02, 0x03, 0x06, 0x07, 0x12, 0x14, 0x17, 0x20, 0x21, 0x30, 0x32, 0x35, 0x36, 0x62)
)
