"""NovAtel OEM, ASCII and binary: BESTPOS, BESTGNSSPOS or PSRPOS, BESTVEL, INSPVAX or INSPVA, gathered by GPS time.

OEM7 commands and logs reference manual.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np

from pipeline.make.receivers.epochs import Epoch, Gathered, covariance_columns, velocity_columns
from pipeline.make.receivers.frames import NOVATEL_NAMES
from pipeline.read.ingest.novatel import FIX_BY_CODE, SOLVED
from pipeline.read.ingest.timescale import utc_of_week
from schemas.enums import Fix

# Messages with a position, by rank: that of the receiver before those of the inertial solution.
_RANKS = {"INSPVAS": 0, "INSPVA": 0, "INSPVAX": 1, "PSRPOS": 2, "BESTGNSSPOS": 3, "BESTPOS": 4}
_INERTIAL = ("INSPVAS", "INSPVA", "INSPVAX")
_COARSE = 100  # "GPS reference time status": below it the time is approximate or not known
_WGS84 = 61
_VELOCITY = ("vel_e_mps", "vel_n_mps", "vel_u_mps")
# Of the format: BESTVEL comes at 1 Hz at least, one of two may be late; over more there is no velocity of an epoch.
_LONGEST_BETWEEN_NS = 1_500_000_000


def parse(raw: bytes) -> Any:
    """The message, none if it is of no interest."""
    return _decoder().decode(raw) if _message_name(raw) in NOVATEL_NAMES.values() else None


@cache
def _decoder() -> Any:
    """The decoder of NovAtel's logs."""
    from novatel_edie import oem

    return oem.Decoder()


def _message_name(raw: bytes) -> str:
    """Name of a message, of ASCII or binary form."""
    if raw[:1] in (b"#", b"%"):
        return raw[1:].split(b",")[0].decode().removesuffix("A")
    return NOVATEL_NAMES.get(struct.unpack_from("<H", raw, 4)[0], "")


def decode(gathered: Gathered, m: Any, raw: bytes) -> None:
    """Add what this message says to its epoch."""
    name = _message_name(raw)
    if name not in ("INSPVAS", "INSPVA") and int(m.header.time_status) < _COARSE:
        gathered.count_dropped("time not valid")
        return
    week = int(m.header.week)
    ms = round(float(m.header.milliseconds))
    if name == "BESTVEL" and int(m.status):
        return
    epoch = gathered.epoch_at((name if name == "BESTVEL" else "", week, ms), name if name in _RANKS else "", raw)
    epoch.t_ns = utc_of_week(week, ms * 1_000_000)
    if name == "BESTVEL":
        epoch.t_ns -= round(m.latency * 1e9)
        epoch.gnss |= _bestvel_columns(m)
    elif name in _INERTIAL:
        _put_inertial(epoch, m, _RANKS[name])
    elif int(m.datum_id) != _WGS84:
        gathered.count_dropped("position in another datum than WGS 84")
    else:
        fix = FIX_BY_CODE.get(int(m.position_type), Fix.NONE) if int(m.solution_status) == 0 else Fix.NONE
        _put_position(epoch, m, _RANKS[name], fix)
        epoch.put_columns("satellites", _RANKS[name], {"satellites": int(m.num_soln_svs)})


def settle_source(gathered: Gathered) -> None:
    """Keep the epochs of the message of highest rank, with their velocities: several in turn would be several receivers
    under one name.
    """
    velocities = [epoch for epoch in gathered.epochs if epoch.key[0] == "BESTVEL"]
    gathered.epochs = [epoch for epoch in gathered.epochs if epoch.key[0] != "BESTVEL"]
    names = {
        name for epoch in gathered.epochs if epoch.gnss.get("fix", Fix.NONE) != Fix.NONE for name in epoch.positions
    }
    best = max(names, key=lambda name: _RANKS[name], default=None)
    if best is None:
        return
    others = [epoch for epoch in gathered.epochs if epoch.positions and best not in epoch.positions]
    gathered.count_dropped(f"NovAtel position beside those of {best}", len(others))
    gathered.epochs = [epoch for epoch in gathered.epochs if best in epoch.positions]
    _give_velocities(velocities, gathered.epochs)


def _put_inertial(epoch: Epoch, m: Any, rank: int) -> None:
    """INSPVAX tells what its position rests on, INSPVA does not."""
    solved = int(m.ins_solution_status) in SOLVED
    kind = FIX_BY_CODE.get(int(m.position_type), Fix.NONE) if hasattr(m, "position_type") else Fix.ESTIMATED
    _put_position(epoch, m, rank, kind if solved else Fix.NONE)
    epoch.put_columns("velocity", rank, velocity_columns(m.east_vel, m.north_vel, m.up_vel))


def _put_position(epoch: Epoch, m: Any, rank: int, fix: Fix) -> None:
    """Put down the position. Height over the ellipsoid: with the undulation, where the message has one.

    INSPVA gives it as it is. The field of the height has one name in old definitions of a message, and another in new
    ones.
    """
    height = (m.height if hasattr(m, "height") else m.orthometric_height) + getattr(m, "undulation", 0.0)
    epoch.put_columns("fix", rank, {"fix": fix.value})
    epoch.put_columns("place", rank, {"latitude_deg": m.latitude, "longitude_deg": m.longitude, "height_m": height})
    if hasattr(m, "latitude_std_dev"):
        east = m.longitude_std_dev**2
        north = m.latitude_std_dev**2
        up = m.height_std_dev**2
        epoch.put_columns("accuracy", rank, covariance_columns(east, 0.0, 0.0, north, 0.0, up))


def _bestvel_columns(m: Any) -> dict[str, float]:
    """BESTVEL: speed over ground, its direction, and the vertical speed."""
    course = np.radians(m.ground_track)
    return velocity_columns(m.horizontal_speed * np.sin(course), m.horizontal_speed * np.cos(course), m.z)


def _give_velocities(velocities: list[Epoch], epochs: list[Epoch]) -> None:
    """The velocity of each epoch between the two of BESTVEL around it: "latency" is how much older it is."""
    if not velocities or not epochs:
        return
    rows = sorted((epoch.t_ns or 0, *(epoch.gnss[name] for name in _VELOCITY)) for epoch in velocities)
    at = np.array([row[0] for row in rows])
    wanted = np.array([epoch.t_ns for epoch in epochs])
    before = at[np.maximum(np.searchsorted(at, wanted, side="right") - 1, 0)]
    after = at[np.minimum(np.searchsorted(at, wanted), len(at) - 1)]
    near = (before <= wanted) & (wanted <= after) & (after - before <= _LONGEST_BETWEEN_NS)
    between = [np.interp((wanted - at[0]) * 1e-9, (at - at[0]) * 1e-9, [row[i] for row in rows]) for i in (1, 2, 3)]
    for number in np.flatnonzero(near):
        epochs[number].gnss |= velocity_columns(*(v[number] for v in between))
