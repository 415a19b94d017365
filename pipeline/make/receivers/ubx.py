"""u-blox UBX, gathered by iTOW: NAV-PVT or NAV-PVAT with NAV-COV, NAV-PL, NAV-SBAS, NAV-SAT and NAV-HPPOSLLH.

Receivers without NAV-PVT (generations 4 to 6) tell an epoch by NAV-SOL in earth-fixed coordinates to the centimetre.
NAV-POSLLH and NAV-VELNED tell place and velocity better, NAV-STATUS the kind of fix, NAV-TIMEUTC and NAV-TIMEGPS the
time, NAV-SVINFO the satellites. Later ones still send them.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any

from pipeline.make.receivers.earth_fixed import geodetic, local_velocity
from pipeline.make.receivers.epochs import Epoch, Gathered, covariance, satellite_name, velocity
from pipeline.read.ingest.recipes_drivers import UBX_SYSTEMS
from pipeline.read.ingest.timescale import utc_of_week
from schemas.arrays import NS_PER_S
from schemas.enums import Fix

Columns = dict[str, Any]

_SYSTEMS_BY_NAME = {"GPS": "G", "SBAS": "S", "Galileo": "E", "BeiDou": "C", "QZSS": "J", "GLONASS": "R", "NavIC": "I"}
# Numbers of satellites in NAV-SVINFO: first of the system, last, letter, number of the first.
_SVIDS = (
    (1, 32, "G", 1), (33, 64, "C", 6), (65, 96, "R", 1), (120, 158, "S", 20), (159, 163, "C", 1), (193, 202, "J", 1),
    (211, 246, "E", 1),
)  # fmt: skip
# Messages of one epoch may round its time, and know another number of leap seconds before they have been received.
_SAME_MOMENT_NS = 60 * NS_PER_S


def parse(raw: bytes) -> Any:
    """The message, none if it is of no interest."""
    from pyubx2 import UBXReader

    return UBXReader.parse(raw) if raw[2:4] in _WANTED else None


def decode(gathered: Gathered, message: Any, raw: bytes) -> None:
    """Add what this message says to its epoch, whose key is the time of the week; most tell no more of the time."""
    rank, time_of = _TIMES.get(message.identity, (0, _no_time))
    t_ns = time_of(message)
    position = message.identity if message.identity in _POSITIONS else ""
    epoch = gathered.at(message.iTOW, position, raw)
    if epoch.t_ns is not None and t_ns is not None and abs(t_ns - epoch.t_ns) > _SAME_MOMENT_NS:
        # The same moment of another week: the log was interrupted, or several were joined.
        epoch = gathered.begin(message.iTOW, position, raw)
    if t_ns is not None:
        epoch.put_time(rank, t_ns)
    for what, rank, columns_of in _CONTENTS.get(message.identity, ()):
        if columns := columns_of(message):
            epoch.put(what, rank, columns)
    if message.identity == "NAV-PL" and not message.plPosValid:
        gathered.drop("protection level not valid")
    _see_satellites(epoch, message)


def _no_time(_: Any) -> int | None:
    return None


def _calendar_ns(m: Any, second: int) -> int | None:
    """UTC of a message's calendar and `nano`, none where there is no such day [ns since 1970]."""
    try:
        minute = datetime(m.year, m.month, m.day, m.hour, m.min, tzinfo=UTC)
    except ValueError:
        return None
    return (int(minute.timestamp()) + second) * NS_PER_S + int(m.nano)


def _pvt_time(m: Any) -> int | None:
    if not (m.validDate and m.validTime):
        return None
    return _calendar_ns(m, int(m.second if hasattr(m, "second") else m.sec))


def _week_time(m: Any, known: bool) -> int | None:
    return utc_of_week(m.week, m.iTOW * 1_000_000 + m.fTOW) if known else None


def _fix(fix_type: int, good: bool, differential: bool, carrier: int = 0) -> Fix:
    """Kind of fix from `fixType` (or `gpsFix`), the flag that it is within its limits, `diffSoln` and `carrSoln`."""
    if not good or fix_type in (0, 5):  # none, time only
        return Fix.NONE
    if fix_type == 1:
        return Fix.ESTIMATED
    if carrier in (1, 2):
        return Fix.RTK_FIXED if carrier == 2 else Fix.RTK_FLOAT
    return Fix.DIFFERENTIAL if differential else Fix.AUTONOMOUS


def _pvt_fix(m: Any) -> Columns:
    good = m.gnssFixOk if hasattr(m, "gnssFixOk") else m.gnssFixOK
    fix = Fix.NONE if getattr(m, "invalidLlh", False) else _fix(m.fixType, good, m.diffSoln, m.carrSoln)
    return {"fix": fix.value, "satellites": m.numSV}


def _place(m: Any) -> Columns:
    """Longitude and latitude [deg] and height over the ellipsoid [mm]."""
    return {"latitude_deg": m.lat, "longitude_deg": m.lon, "height_m": m.height / 1e3}


def _velocity(m: Any) -> Columns:
    """Velocity [mm/s]."""
    return velocity(m.velE / 1e3, m.velN / 1e3, -(m.velD / 1e3))


def _early_velocity(m: Any) -> Columns:
    """Velocity [cm/s]."""
    return velocity(m.velE * 1e-2, m.velN * 1e-2, -(m.velD * 1e-2))


def _accuracy(m: Any) -> Columns:
    """`hAcc` is the standard deviation in the plane (half of its variance on each axis), `vAcc` upwards [mm]."""
    plane = 0.5 * (m.hAcc / 1e3) ** 2
    return covariance(plane, 0.0, 0.0, plane, 0.0, (m.vAcc / 1e3) ** 2)


def _stated_covariance(m: Any) -> Columns:
    values = (m.posCovEE, m.posCovNE, -m.posCovED, m.posCovNN, -m.posCovND, m.posCovDD)
    return covariance(*values) if m.posCovValid else {}


def _protection(m: Any) -> Columns:
    """plPos1 and plPos2 are the horizontal axes of the ellipsoid, plPos3 the vertical one [mm]."""
    return {"hpl_m": max(m.plPos1, m.plPos2) / 1e3, "vpl_m": m.plPos3 / 1e3} if m.plPosValid else {}


def _earth_fixed_place(m: Any) -> Columns:
    """Of NAV-SOL [cm]; its accuracy is of all three axes together and not used."""
    known = m.ecefX or m.ecefY or m.ecefZ
    return geodetic(m.ecefX * 1e-2, m.ecefY * 1e-2, m.ecefZ * 1e-2) if known else {}


def _earth_fixed_velocity(m: Any) -> Columns:
    place = _earth_fixed_place(m)
    speeds_mps = (m.ecefVX * 1e-2, m.ecefVY * 1e-2, m.ecefVZ * 1e-2)
    return local_velocity(place["latitude_deg"], place["longitude_deg"], speeds_mps) if place else {}


def _see_satellites(epoch: Epoch, m: Any) -> None:
    """NAV-SAT, or NAV-SVINFO, which tells the same of the epoch [deg; residual in m or cm]."""
    if m.identity == "NAV-SAT":
        epoch.satellites = _satellites(m, m.numSvs, 1.0)
    elif m.identity == "NAV-SVINFO" and not epoch.satellites:
        epoch.satellites = _satellites(m, m.numCh, 1e-2)


def _satellites(m: Any, count: int, residual_m: float) -> list[Columns]:
    """Those that are known and above or below a horizon; `residual_m`: the unit of the residual."""
    rows: list[Columns] = []
    for index in range(1, count + 1):
        azimuth, elevation, residual, used = (
            getattr(m, f"{name}_{index:02d}") for name in ("azim", "elev", "prRes", "svUsed")
        )
        name = _name(m, index)
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


def _name(m: Any, index: int) -> str | None:
    """None for a satellite whose number the receiver does not know (255)."""
    if m.identity == "NAV-SVINFO":
        svid = getattr(m, f"svid_{index:02d}")
        known = ((system, svid - low + first) for low, high, system, first in _SVIDS if low <= svid <= high)
        return next((satellite_name(*satellite) for satellite in known), None)
    system = getattr(m, f"gnssId_{index:02d}")  # pyubx2 gives systems by name or by number
    letter = _SYSTEMS_BY_NAME.get(str(system), UBX_SYSTEMS.get(system, "X"))
    return satellite_name(letter, getattr(m, f"svId_{index:02d}"))


# What messages say of an epoch, and with which rank: it gives way to a higher one.
_PVT = (("fix", 3, _pvt_fix), ("place", 3, _place), ("velocity", 3, _velocity), ("accuracy", 3, _accuracy))
_CONTENTS: dict[str, tuple[tuple[str, int, Callable[[Any], Columns]], ...]] = {
    "NAV-PVT": _PVT,
    "NAV-PVAT": _PVT,
    "NAV-HPPOSLLH": (("place", 4, lambda m: {} if m.invalidLlh else _place(m)),),
    "NAV-COV": (("accuracy", 4, _stated_covariance),),
    "NAV-PL": (("protection", 0, _protection),),
    "NAV-SBAS": (("sbas", 0, lambda m: {"sbas_prn": m.geo} if m.geo and m.mode else {}),),
    "NAV-SOL": (
        ("fix", 1, lambda m: {"fix": _fix(m.gpsFix, m.gpsfixOK, m.diffSoln).value, "satellites": m.numSV}),
        ("place", 1, _earth_fixed_place),
        ("velocity", 1, _earth_fixed_velocity),
    ),
    "NAV-STATUS": (("fix", 0, lambda m: {"fix": _fix(m.gpsFix, m.gpsFixOk, m.diffSoln).value}),),
    "NAV-POSLLH": (("place", 2, _place), ("accuracy", 2, _accuracy)),
    "NAV-VELNED": (("velocity", 2, _early_velocity),),
}
_TIMES: dict[str, tuple[int, Callable[[Any], int | None]]] = {
    "NAV-PVT": (3, _pvt_time),
    "NAV-PVAT": (3, _pvt_time),
    "NAV-TIMEUTC": (2, lambda m: _calendar_ns(m, m.sec) if m.validUTC else None),
    "NAV-SOL": (1, lambda m: _week_time(m, m.wknSet and m.towSet)),
    "NAV-TIMEGPS": (1, lambda m: _week_time(m, m.towValid and m.weekValid)),
}
_POSITIONS = ("NAV-PVT", "NAV-PVAT", "NAV-SOL", "NAV-POSLLH")
# Class and id of the messages above, of NAV-SAT and of NAV-SVINFO.
_WANTED = frozenset(
    b"\x01" + bytes([number])
    for number in (0x02, 0x03, 0x06, 0x07, 0x12, 0x14, 0x17, 0x20, 0x21, 0x30, 0x32, 0x35, 0x36, 0x62)
)
