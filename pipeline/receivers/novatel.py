"""NovAtel OEM, ASCII and binary: BESTPOS, BESTGNSSPOS or PSRPOS, BESTVEL, INSPVAX or INSPVA, gathered by GPS time.

OEM7 commands and logs reference manual.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np

from pipeline.ingest.novatel import FIX_BY_CODE
from pipeline.ingest.timescale import GPS_EPOCH_NS, utc_from_gps
from pipeline.receivers.epochs import Epoch, Gathered
from schemas.enums import Fix

# Messages with a position, by rank: that of the receiver before those of the inertial solution.
_RANKS = {"INSPVAS": 0, "INSPVA": 0, "INSPVAX": 1, "PSRPOS": 2, "BESTGNSSPOS": 3, "BESTPOS": 4}
_INERTIAL = ("INSPVAS", "INSPVA", "INSPVAX")
_WANTED = {
    42: "BESTPOS",
    47: "PSRPOS",
    99: "BESTVEL",
    507: "INSPVA",
    508: "INSPVAS",
    1429: "BESTGNSSPOS",
    1465: "INSPVAX",
}
_COARSE = 100  # "GPS reference time status": below it the time is approximate or not known
_WGS84 = 61
# "Inertial solution status": high variance, good, free, alignment complete. The others are no solution.
_SOLVED = (2, 3, 6, 7)
_WEEK_MS = 604_800_000


def parse(raw: bytes) -> Any:
    """The message, none if it is of no interest."""
    return _decoder().decode(raw) if _name(raw) in _WANTED.values() else None


@cache
def _decoder() -> Any:
    from novatel_edie import oem

    return oem.Decoder()


def _name(raw: bytes) -> str:
    if raw[:1] in (b"#", b"%"):
        return raw[1:].split(b",")[0].decode().removesuffix("A")
    return _WANTED.get(struct.unpack_from("<H", raw, 4)[0], "")


def decode(gathered: Gathered, m: Any, raw: bytes) -> None:
    """Add what this message says to its epoch."""
    name = _name(raw)
    if name not in ("INSPVAS", "INSPVA") and int(m.header.time_status) < _COARSE:
        gathered.drop("time not valid")
        return
    week, ms = int(m.header.week), round(float(m.header.milliseconds))
    epoch = gathered.at((week, ms), name if name in _RANKS else "", raw)
    gps_ns = GPS_EPOCH_NS + (week * _WEEK_MS + ms) * 1_000_000
    epoch.tell_time(0, int(utc_from_gps(np.array([gps_ns], dtype=np.int64))[0]))
    if name == "BESTVEL":
        _velocity(epoch, m)
    elif name in _INERTIAL:
        _inertial(epoch, m, _RANKS[name])
    elif int(m.datum_id) != _WGS84:
        gathered.drop("position in another datum than WGS 84")
    else:
        fix = FIX_BY_CODE.get(int(m.position_type), Fix.NONE) if int(m.solution_status) == 0 else Fix.NONE
        _place(epoch, m, _RANKS[name], fix)
        epoch.tell("satellites", _RANKS[name], {"satellites": int(m.num_soln_svs)})


def settle_source(gathered: Gathered) -> None:
    """Keep the epochs of the message of highest rank: several in turn would be several receivers under one name."""
    names = {
        name for epoch in gathered.epochs if epoch.gnss.get("fix", Fix.NONE) != Fix.NONE for name in epoch.positions
    }
    best = max(names, key=lambda name: _RANKS[name], default=None)
    if best is None:
        return
    other = [epoch for epoch in gathered.epochs if epoch.positions and best not in epoch.positions]
    gathered.drop(f"NovAtel position beside those of {best}", len(other))
    gathered.epochs = [epoch for epoch in gathered.epochs if best in epoch.positions]


def _inertial(epoch: Epoch, m: Any, rank: int) -> None:
    """INSPVAX tells what its position rests on, INSPVA does not."""
    solved = int(m.ins_solution_status) in _SOLVED
    kind = FIX_BY_CODE.get(int(m.position_type), Fix.NONE) if hasattr(m, "position_type") else Fix.ESTIMATED
    _place(epoch, m, rank, kind if solved else Fix.NONE)
    epoch.tell(
        "velocity",
        rank,
        {f"vel_{a}_mps": getattr(m, f"{d}_vel") for a, d in zip("enu", ("east", "north", "up"), strict=True)},
    )


def _place(epoch: Epoch, m: Any, rank: int, fix: Fix) -> None:
    """Height over the ellipsoid: with the undulation, where the message has one; INSPVA gives it as it is.

    The field of the height has one name in old definitions of a message, and another in new ones.
    """
    height = (m.height if hasattr(m, "height") else m.orthometric_height) + getattr(m, "undulation", 0.0)
    epoch.tell("fix", rank, {"fix": fix.value})
    epoch.tell("place", rank, {"latitude_deg": m.latitude, "longitude_deg": m.longitude, "height_m": height})
    if hasattr(m, "latitude_std_dev"):
        deviations = {"nn": m.latitude_std_dev, "ee": m.longitude_std_dev, "uu": m.height_std_dev}
        variances = {f"cov_{axes}_m2": value**2 for axes, value in deviations.items()}
        epoch.tell("accuracy", rank, variances | {"cov_en_m2": 0.0, "cov_eu_m2": 0.0, "cov_nu_m2": 0.0})


def _velocity(epoch: Epoch, m: Any) -> None:
    """BESTVEL: speed over ground, its direction, and the vertical speed."""
    if int(m.status) == 0:
        course = np.radians(m.ground_track)
        east, north = m.horizontal_speed * np.sin(course), m.horizontal_speed * np.cos(course)
        epoch.tell(
            "velocity", max(_RANKS.values()), {"vel_e_mps": float(east), "vel_n_mps": float(north), "vel_u_mps": m.z}
        )
