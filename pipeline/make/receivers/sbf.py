"""Septentrio SBF: PVTGeodetic or PVTCartesian with their covariances and DOP (HPL, VPL), gathered by GPS time."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from pipeline.make.receivers.earth_fixed import east_north_up, geodetic, local_velocity
from pipeline.make.receivers.epochs import Epoch, Gathered, covariance_columns
from pipeline.read.ingest.recipes_drivers import SBF_FIXES
from pipeline.read.ingest.timescale import utc_of_week
from schemas.enums import Fix

_NO_TOW, _NO_WEEK = 0xFFFFFFFF, 0xFFFF
_DO_NOT_USE = -2e10
_SBAS_PRNS = range(120, 159)
# SBF reference guide, "Datum" of PVTGeodetic; of a base station: what its operator chose.
_DATUM_OF_BASE = 19
_DATUMS = {30: "ETRS89", 31: "NAD83(2011)", 32: "NAD83(PA11)", 33: "NAD83(MA11)", 34: "GDA94", 35: "GDA2020",
           36: "JGD2011", 250: "user-defined", 251: "user-defined"}  # fmt: skip
_NEAR_WGS84 = (30,)


def parse(raw: bytes) -> Any:
    """The block, none if it is of no interest."""
    from pysbf2 import SBFReader

    return SBFReader.parse(raw) if int.from_bytes(raw[4:6], "little") & _BLOCK_NUMBER in _WANTED else None


def decode(gathered: Gathered, message: Any, raw: bytes) -> None:
    """Add what this block says to its epoch."""
    decoder = _DECODERS[message.identity]
    tow_ms, week = struct.unpack_from("<IH", raw, 8)
    if tow_ms == _NO_TOW or week == _NO_WEEK:
        gathered.count_dropped("time not valid")
        return
    position = message.identity if message.identity in _POSITIONS else ""
    if position and message.Error == 0 and not _has_wgs84_datum(gathered, message):
        return
    epoch = gathered.epoch_at((week, tow_ms), position, raw)
    epoch.t_ns = utc_of_week(week, tow_ms * 1_000_000)
    decoder(epoch, message)


def _has_wgs84_datum(gathered: Gathered, message: Any) -> bool:
    """Whether a position is of WGS 84 or near to it, which is counted by name; user-defined ones are left out."""
    number = int(getattr(message, "Datum", 0))
    if number in (0, _DATUM_OF_BASE, 255):
        return True
    name = _DATUMS.get(number, f"datum {number}")
    if number in _NEAR_WGS84:
        gathered.count_dropped(f"position in {name} (kept: decimetres from WGS 84)")
        return True
    gathered.count_dropped(f"position in another datum than WGS 84 ({name})")
    return False


def _put_solution(epoch: Epoch, m: Any) -> bool:
    """Put down what both PVT blocks share; whether they hold a position."""
    fix = SBF_FIXES.get(m.Type, Fix.NONE) if m.Error == 0 else Fix.NONE
    epoch.gnss |= {"fix": fix.value, "satellites": m.NrSV if m.NrSV != 255 else None}
    # Base stations are numbered too: only an SBAS solution refers to a satellite.
    if fix is Fix.SBAS and m.ReferenceID in _SBAS_PRNS:
        epoch.gnss["sbas_prn"] = m.ReferenceID
        epoch.gnss["sbas_age_s"] = m.MeanCorrAge if round(m.MeanCorrAge * 100) != _NO_WEEK else None
    return fix is not Fix.NONE


def _put_geodetic(epoch: Epoch, m: Any) -> None:
    """Position and velocity of a PVTGeodetic block."""
    if _put_solution(epoch, m) and m.Latitude != _DO_NOT_USE:
        place = {"latitude_deg": float(np.degrees(m.Latitude)), "longitude_deg": float(np.degrees(m.Longitude))}
        epoch.gnss |= place | _without_unknown(
            {"height_m": m.Height, "vel_e_mps": m.Ve, "vel_n_mps": m.Vn, "vel_u_mps": m.Vu}
        )


def _put_cartesian(epoch: Epoch, m: Any) -> None:
    """Position and velocity of a PVTCartesian block."""
    if not _put_solution(epoch, m) or m.X == _DO_NOT_USE:
        return
    place = geodetic(m.X, m.Y, m.Z)
    epoch.gnss |= place
    if m.Vx != _DO_NOT_USE:
        epoch.gnss |= local_velocity(place["latitude_deg"], place["longitude_deg"], (m.Vx, m.Vy, m.Vz))


def _put_geodetic_covariance(epoch: Epoch, m: Any) -> None:
    """Covariance of a PosCovGeodetic block."""
    epoch.gnss |= _without_unknown(
        covariance_columns(m.Cov_lonlon, m.Cov_latlon, m.Cov_lonhgt, m.Cov_latlat, m.Cov_lathgt, m.Cov_hgthgt)
    )


def _put_cartesian_covariance(epoch: Epoch, m: Any) -> None:
    """Covariance turned into east, north, up where the epoch's position is known (SBF writes it first)."""
    latitude = epoch.gnss.get("latitude_deg")
    longitude = epoch.gnss.get("longitude_deg")
    if latitude is None or longitude is None or m.Cov_xx == _DO_NOT_USE:
        return
    turn = east_north_up(latitude, longitude)
    earth_fixed = np.array(
        [[m.Cov_xx, m.Cov_xy, m.Cov_xz], [m.Cov_xy, m.Cov_yy, m.Cov_yz], [m.Cov_xz, m.Cov_yz, m.Cov_zz]]
    )
    local = turn @ earth_fixed @ turn.T
    epoch.gnss |= _without_unknown(covariance_columns(*local[np.triu_indices(3)]))


def _put_protection_levels(epoch: Epoch, m: Any) -> None:
    """Put down the protection levels of a block."""
    epoch.gnss |= _without_unknown({"hpl_m": m.HPL, "vpl_m": m.VPL})


def _without_unknown(values: dict[str, float]) -> dict[str, float]:
    """The values that are known: Septentrio marks the others with -2e10."""
    return {name: value for name, value in values.items() if value != _DO_NOT_USE}


_BLOCK_NUMBER = 0x1FFF  # the other bits of the id are the revision
_POSITIONS = ("PVTGeodetic", "PVTCartesian")
_WANTED = (4001, 4006, 4007, 5905, 5906)
_DECODERS = {
    "PVTGeodetic": _put_geodetic,
    "PVTCartesian": _put_cartesian,
    "PosCovGeodetic": _put_geodetic_covariance,
    "PosCovCartesian": _put_cartesian_covariance,
    "DOP": _put_protection_levels,
}
