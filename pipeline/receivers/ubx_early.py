"""UBX messages of receivers that have no NAV-PVT (generations 4 to 6), and that later ones still send.

NAV-SOL tells time, kind of fix, place and velocity of an epoch, in earth-fixed coordinates to the centimetre.
NAV-POSLLH and NAV-VELNED tell place and velocity better, NAV-STATUS the kind of fix, NAV-TIMEUTC and NAV-TIMEGPS the
time.
"""

from __future__ import annotations

from typing import Any

from pipeline.ingest.timescale import utc_of_week
from pipeline.receivers.earth_fixed import geodetic, local_velocity
from pipeline.receivers.epochs import Epoch, Gathered, satellite_name
from pipeline.receivers.ubx_fields import accuracy, calendar_ns, fix_of, place, satellites_of, velocity

# What each tells gives way to what a message of higher rank tells of the same epoch; NAV-PVT is above all of these.
_STATUS, _SOL, _SINGLE, HIGHEST_RANK = 0, 1, 2, 2
# Numbers of satellites in NAV-SVINFO: first of the system, last, letter, number of the first.
_SVIDS = (
    (1, 32, "G", 1),
    (33, 64, "C", 6),
    (65, 96, "R", 1),
    (120, 158, "S", 20),
    (159, 163, "C", 1),
    (193, 202, "J", 1),
    (211, 246, "E", 1),
)


def time_ns(m: Any) -> tuple[int, int] | None:
    """Rank of the message's time, and UTC [ns since 1970]; none where it has no time or does not know it."""
    if m.identity == "NAV-TIMEUTC":
        t_ns = calendar_ns(m, m.sec) if m.validUTC else None
        return None if t_ns is None else (_SINGLE, t_ns)
    if m.identity == "NAV-SOL":
        known = m.wknSet and m.towSet
    elif m.identity == "NAV-TIMEGPS":
        known = m.towValid and m.weekValid
    else:
        return None
    return (_SOL, utc_of_week(m.week, m.iTOW * 1_000_000 + m.fTOW)) if known else None


def solution(_: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-SOL: kind of fix, place [cm], velocity [cm/s]; its accuracy is of all three axes together and not used."""
    fix = fix_of(m.gpsFix, m.gpsfixOK, m.diffSoln)
    epoch.tell("fix", _SOL, {"fix": fix.value, "satellites": m.numSV})
    if not (m.ecefX or m.ecefY or m.ecefZ):
        return
    where = geodetic(m.ecefX * 1e-2, m.ecefY * 1e-2, m.ecefZ * 1e-2)
    speeds = (m.ecefVX * 1e-2, m.ecefVY * 1e-2, m.ecefVZ * 1e-2)
    epoch.tell("place", _SOL, where)
    epoch.tell("velocity", _SOL, local_velocity(where["latitude_deg"], where["longitude_deg"], speeds))


def status(_: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-STATUS: kind of fix."""
    epoch.tell("fix", _STATUS, {"fix": fix_of(m.gpsFix, m.gpsFixOk, m.diffSoln).value})


def position(_: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-POSLLH: place, accuracy [mm]."""
    epoch.tell("place", _SINGLE, place(m))
    epoch.tell("accuracy", _SINGLE, accuracy(m.hAcc / 1e3, m.vAcc / 1e3))


def motion(_: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-VELNED: velocity [cm/s]."""
    epoch.tell("velocity", _SINGLE, velocity(m.velE * 1e-2, m.velN * 1e-2, m.velD * 1e-2))


def satellites(_: Gathered, epoch: Epoch, m: Any) -> None:
    """NAV-SVINFO: azimuth and elevation [deg], residual [cm]; NAV-SAT of the same epoch tells the same."""
    if not epoch.satellites:
        epoch.satellites = satellites_of(m, m.numCh, _name, ("svid",), 1e-2)


def _name(svid: int) -> str | None:
    """None for a satellite whose number the receiver does not know (255)."""
    return next(
        (satellite_name(system, svid - low + first) for low, high, system, first in _SVIDS if low <= svid <= high), None
    )
