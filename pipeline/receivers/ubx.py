"""u-blox UBX: NAV-PVT or NAV-PVAT with NAV-COV, NAV-PL, NAV-SBAS, NAV-SAT and NAV-HPPOSLLH, gathered by iTOW."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from pipeline.receivers.epochs import Epoch, Gathered, satellite_name
from schemas.enums import Fix

_SYSTEMS = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R", 7: "I"}
_SYSTEMS_BY_NAME = {"GPS": "G", "SBAS": "S", "Galileo": "E", "BeiDou": "C", "QZSS": "J", "GLONASS": "R", "NavIC": "I"}
_NO_FIX, _DEAD_RECKONING, _TIME_ONLY = 0, 1, 5
_RTK_FLOAT, _RTK_FIXED = 1, 2


def parse(raw: bytes) -> Any:
    """The message, none if it is of no interest."""
    from pyubx2 import UBXReader

    return UBXReader.parse(raw) if raw[2:4] in _WANTED else None


class UbxDecoder:
    """Keeps count of the weeks while messages go by: most of them only tell the time of the week."""

    def __init__(self) -> None:
        self._week = 0
        self._latest_ms = 0

    def decode(self, gathered: Gathered, message: Any, _raw: bytes) -> None:
        """Add what this message says to its epoch."""
        if self._latest_ms - message.iTOW > _HALF_WEEK_MS:
            self._week += 1
        self._latest_ms = message.iTOW
        t_ns = _time_ns(message) if message.identity in _POSITIONS else None
        epoch = gathered.at((self._week, message.iTOW))
        if epoch.t_ns is not None and t_ns is not None and t_ns != epoch.t_ns:
            # The same moment of another week: the log was interrupted, or several were joined.
            self._week += 1
            epoch = gathered.at((self._week, message.iTOW))
        if message.identity in _POSITIONS:
            if t_ns is None:
                gathered.drop("time not valid")
                return
            epoch.t_ns = t_ns
        _DECODERS[message.identity](gathered, epoch, message)


def _time_ns(m: Any) -> int | None:
    """UTC as the receiver states it, none before it knows [ns since 1970]."""
    if not (m.validDate and m.validTime):
        return None
    try:
        minute = datetime(m.year, m.month, m.day, m.hour, m.min, tzinfo=UTC)
    except ValueError:
        return None
    second = m.second if hasattr(m, "second") else m.sec
    return (int(minute.timestamp()) + int(second)) * _NS_PER_S + int(m.nano)


def _position(_: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-PVT and NAV-PVAT: position [deg, mm], velocity [mm/s], accuracy [mm], kind of fix."""
    fix = Fix.NONE if getattr(m, "invalidLlh", False) else _fix(m)
    epoch.gnss |= {"fix": fix.value, "satellites": m.numSV}
    if fix is Fix.NONE:
        return
    high_precision = epoch.gnss.get("latitude_deg") is not None
    if not high_precision:
        epoch.gnss |= {"latitude_deg": m.lat, "longitude_deg": m.lon, "height_m": m.height / 1e3}
    epoch.gnss |= {"vel_e_mps": m.velE / 1e3, "vel_n_mps": m.velN / 1e3, "vel_u_mps": -m.velD / 1e3}
    if "cov_ee_m2" not in epoch.gnss:
        # hAcc is the standard deviation in the plane: half of its variance on each axis.
        plane, up = 0.5 * (m.hAcc / 1e3) ** 2, (m.vAcc / 1e3) ** 2
        epoch.gnss |= _covariance(plane, 0.0, 0.0, plane, 0.0, up)


def _fix(m: Any) -> Fix:
    good = m.gnssFixOk if hasattr(m, "gnssFixOk") else m.gnssFixOK
    if not good or m.fixType in (_NO_FIX, _TIME_ONLY):
        return Fix.NONE
    if m.fixType == _DEAD_RECKONING:
        return Fix.ESTIMATED
    if m.carrSoln in (_RTK_FLOAT, _RTK_FIXED):
        return Fix.RTK_FIXED if m.carrSoln == _RTK_FIXED else Fix.RTK_FLOAT
    return Fix.DIFFERENTIAL if m.diffSoln else Fix.AUTONOMOUS


def _precise(_: Gathered, epoch: Epoch, m: Any) -> None:
    if not m.invalidLlh:
        epoch.gnss |= {"latitude_deg": m.lat, "longitude_deg": m.lon, "height_m": m.height / 1e3}


def _covariances(_: Gathered, epoch: Epoch, m: Any) -> None:
    if m.posCovValid:
        values = (m.posCovEE, m.posCovNE, -m.posCovED, m.posCovNN, -m.posCovND, m.posCovDD)
        epoch.gnss |= _covariance(*values)


def _covariance(ee: float, en: float, eu: float, nn: float, nu: float, uu: float) -> dict[str, float]:
    names = ("cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2")
    return dict(zip(names, (ee, en, eu, nn, nu, uu), strict=True))


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
    rows: list[dict[str, Any]] = []
    for index in range(1, m.numSvs + 1):
        value = {name: getattr(m, f"{name}_{index:02d}") for name in _SATELLITE_FIELDS}
        system = _SYSTEMS_BY_NAME.get(str(value["gnssId"]), _SYSTEMS.get(value["gnssId"], "X"))
        rows.append(
            {
                "sv": satellite_name(system, value["svId"]),
                "azimuth_deg": float(value["azim"]),
                "elevation_deg": float(value["elev"]),
                "residual_m": value["prRes"] if value["svUsed"] else None,
                "used": bool(value["svUsed"]),
            }
        )
    epoch.satellites = [row for row in rows if abs(row["elevation_deg"]) <= _HORIZON_TO_ZENITH_DEG]


_HORIZON_TO_ZENITH_DEG = 90.0
_HALF_WEEK_MS = 302_400_000
_NS_PER_S = 1_000_000_000
_POSITIONS = ("NAV-PVT", "NAV-PVAT")
# Class and id of the messages below.
_WANTED = (b"\x01\x07", b"\x01\x17", b"\x01\x14", b"\x01\x36", b"\x01\x62", b"\x01\x32", b"\x01\x35")
_SATELLITE_FIELDS = ("gnssId", "svId", "azim", "elev", "prRes", "svUsed")
_DECODERS = {
    "NAV-PVT": _position,
    "NAV-PVAT": _position,
    "NAV-HPPOSLLH": _precise,
    "NAV-COV": _covariances,
    "NAV-PL": _protection,
    "NAV-SBAS": _sbas,
    "NAV-SAT": _satellites,
}
