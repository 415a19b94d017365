"""Recipes for the GNSS messages of ROS 2 receiver drivers.

Each schema may have several recipes, for the versions of its driver; the first whose fields are all
there is used. Numbers that a receiver marks as "do not use" become null.
"""

from __future__ import annotations

import math

import polars as pl

from pipeline.read.ingest import novatel
from pipeline.read.ingest.recipe import (
    FIX_TYPE,
    Recipe,
    covariance_enu,
    covariance_of_deviations,
    fix_from,
    null_where,
    position_columns,
)
from pipeline.read.ingest.stamps import CivilTime
from schemas.enums import Fix

_RAD = 180.0 / math.pi


# Septentrio SBF reference guide, block PVTGeodetic: Mode, bits 0-3.
SBF_FIXES = {
    1: Fix.AUTONOMOUS, 2: Fix.DIFFERENTIAL, 3: Fix.NONE, 4: Fix.RTK_FIXED, 5: Fix.RTK_FLOAT, 6: Fix.SBAS,
    7: Fix.RTK_FIXED, 8: Fix.RTK_FLOAT, 10: Fix.DIFFERENTIAL,
}  # fmt: skip
_SBF_KEY = ("block_header.wnc", "block_header.tow")


def _sbf_float(path: str) -> pl.Expr:
    """A float of an SBF block; -2e10 means "do not use"."""
    return null_where(pl.col(path) < -1e10, pl.col(path))


def _pvt_geodetic() -> Recipe:
    """septentrio_gnss_driver/msg/PVTGeodetic: position, velocity, kind of fix."""
    mode = pl.col("mode") & 0x0F
    sbas = mode == 6
    return Recipe(
        stream="gnss",
        columns={
            "latitude_deg": _sbf_float("latitude") * _RAD,
            "longitude_deg": _sbf_float("longitude") * _RAD,
            "height_m": _sbf_float("height"),
            "vel_e_mps": _sbf_float("ve"),
            "vel_n_mps": _sbf_float("vn"),
            "vel_u_mps": _sbf_float("vu"),
            "fix": fix_from(mode, SBF_FIXES, known=pl.col("error") == 0),
            "satellites": null_where(pl.col("nr_sv") == 255, pl.col("nr_sv")),
            "sbas_prn": pl.when(sbas & (pl.col("reference_id") != 65535)).then(pl.col("reference_id")),
            "sbas_age_s": pl.when(sbas & (pl.col("mean_corr_age") != 65535)).then(pl.col("mean_corr_age") * 0.01),
        },
        whole=(*_SBF_KEY, "mode", "error", "nr_sv", "reference_id", "mean_corr_age"),
        key=_SBF_KEY,
    )


def _pos_cov_geodetic() -> Recipe:
    """septentrio_gnss_driver/msg/PosCovGeodetic: the covariance of the position of the same epoch."""
    names = {
        "ee": "lonlon", "en": "latlon", "eu": "lonhgt", "nn": "latlat", "nu": "lathgt", "uu": "hgthgt",
    }  # fmt: skip
    return Recipe(
        stream="gnss",
        columns={f"cov_{axes}_m2": _sbf_float(f"cov_{name}") for axes, name in names.items()},
        whole=_SBF_KEY,
        key=_SBF_KEY,
        supplement=True,
    )


def _ublox_fix(fix_type: pl.Expr, is_ok: pl.Expr, differential: pl.Expr, carrier: pl.Expr) -> pl.Expr:
    """u-blox interface description, UBX-NAV-PVT: fixType, flags. SBAS looks like other corrections."""
    cases = (
        (~is_ok | ~fix_type.is_in([1, 2, 3, 4]), Fix.NONE),
        (fix_type == 1, Fix.ESTIMATED),
        (carrier == 2, Fix.RTK_FIXED),
        (carrier == 1, Fix.RTK_FLOAT),
        (differential, Fix.DIFFERENTIAL),
    )
    first = pl.coalesce(*(pl.when(case).then(pl.lit(fix.value)) for case, fix in cases), pl.lit(Fix.AUTONOMOUS.value))
    return first.cast(FIX_TYPE)


def _ublox_columns(h_acc: str, v_acc: str, velocity: tuple[str, str, str], satellites: str) -> dict[str, pl.Expr]:
    """Position, velocity and accuracy in the units of UBX: 1e-7 deg, mm, mm/s.

    The horizontal accuracy is that of the radial error, shared by two axes without correlation.
    """
    zero = pl.when(pl.col(h_acc).is_not_null()).then(0.0)
    axis = (pl.col(h_acc) * 1e-3) ** 2 / 2
    east, north, down = velocity
    return {
        "latitude_deg": pl.col("lat") / 1e7,
        "longitude_deg": pl.col("lon") / 1e7,
        "height_m": pl.col("height") / 1e3,
        "cov_ee_m2": axis, "cov_nn_m2": axis, "cov_uu_m2": (pl.col(v_acc) * 1e-3) ** 2,
        "cov_en_m2": zero, "cov_eu_m2": zero, "cov_nu_m2": zero,
        "vel_e_mps": pl.col(east) / 1e3, "vel_n_mps": pl.col(north) / 1e3, "vel_u_mps": pl.col(down) / -1e3,
        "satellites": pl.col(satellites),
    }  # fmt: skip


def _ubx_nav_pvt() -> Recipe:
    """ublox_ubx_msgs/msg/UBXNavPVT: flags taken apart into fields."""
    fix = _ublox_fix(pl.col("gps_fix.fix_type"), pl.col("gnss_fix_ok"), pl.col("diff_soln"), pl.col("carr_soln.status"))
    return Recipe(
        stream="gnss",
        columns={"fix": fix} | _ublox_columns("h_acc", "v_acc", ("vel_e", "vel_n", "vel_d"), "num_sv"),
        types={"gnss_fix_ok": pl.Boolean(), "diff_soln": pl.Boolean()},
        whole=("gps_fix.fix_type", "carr_soln.status", "num_sv"),
    )


def _nav_pvt(h_acc: str, v_acc: str, velocity: tuple[str, str, str], satellites: str, fix_type: str) -> Recipe:
    """ublox_msgs/msg/NavPVT: the UBX message as it is; its time is the UTC calendar in it."""
    flags = pl.col("flags")
    fix = _ublox_fix(pl.col(fix_type), (flags & 1) == 1, (flags & 2) == 2, (flags // 64) & 3)
    return Recipe(
        stream="gnss",
        stamps={},
        columns={"fix": fix} | _ublox_columns(h_acc, v_acc, velocity, satellites),
        whole=(fix_type, "flags", satellites),
        time=CivilTime(("year", "month", "day", "hour", "min", "sec"), "nano", "valid"),
    )


# RINEX letters of u-blox gnssId (interface description, "GNSS identifiers").
UBX_SYSTEMS = {0: "G", 1: "S", 2: "E", 3: "C", 5: "J", 6: "R", 7: "I"}


def _nav_sat(stamps: dict[str, str], rows: str, used: pl.Expr, types: dict[str, pl.DataType]) -> Recipe:
    """UBX-NAV-SAT: one row per satellite; SBAS numbers are PRN, of which RINEX takes 100 off."""
    system = pl.col("gnss_id").replace_strict(UBX_SYSTEMS, default=None, return_dtype=pl.String)
    number = pl.when(pl.col("gnss_id") == 1).then(pl.col("sv_id") - 100).otherwise(pl.col("sv_id"))
    return Recipe(
        stream="satellites",
        stamps=stamps,
        columns={
            "sv": pl.format("{}{}", system, number.cast(pl.String).str.zfill(2)),
            "azimuth_deg": pl.col("azim"),
            "elevation_deg": pl.col("elev"),
            "residual_m": pl.col("pr_res") * 0.1,
            "used": used,
        },
        types=types,
        whole=("gnss_id", "sv_id", "flags"),
        rows=rows,
    )


def _bestpos() -> Recipe:
    """novatel_oem7_msgs/msg/BESTPOS: its height is over mean sea level, so the undulation is added."""
    return Recipe(
        stream="gnss",
        columns={
            "latitude_deg": pl.col("lat"),
            "longitude_deg": pl.col("lon"),
            "height_m": pl.col("hgt") + pl.col("undulation"),
            **covariance_of_deviations("lon_stdev", "lat_stdev", "hgt_stdev"),
            "fix": fix_from(pl.col("pos_type.type"), novatel.FIX_BY_CODE, known=pl.col("sol_status.status") == 0),
            "satellites": pl.col("num_sol_svs"),
        },
        whole=("sol_status.status", "pos_type.type", "num_sol_svs"),
    )


# gps_msgs/GPSStatus: status.
_GPS_STATUS = {
    0: Fix.AUTONOMOUS, 1: Fix.SBAS, 2: Fix.DIFFERENTIAL, 18: Fix.DIFFERENTIAL, 19: Fix.RTK_FIXED, 20: Fix.RTK_FLOAT,
    33: Fix.SBAS,
}  # fmt: skip


def _gps_fix() -> Recipe:
    """gps_msgs/msg/GPSFix: speed and track as velocity; NaN where not known."""
    status = pl.col("status.status")
    heading = pl.col("track").fill_nan(None).radians()
    speed = pl.col("speed").fill_nan(None)
    return Recipe(
        stream="gnss",
        columns={
            **position_columns(status),
            "vel_e_mps": speed * heading.sin(),
            "vel_n_mps": speed * heading.cos(),
            "vel_u_mps": pl.col("climb").fill_nan(None),
            "fix": fix_from(status, _GPS_STATUS),
            "satellites": pl.col("status.satellites_used"),
            **covariance_enu(pl.col("position_covariance_type") > 0),
        },
        whole=("status.status", "status.satellites_used", "position_covariance_type"),
        remark="the message does not say what its altitude refers to: it is taken as height over the ellipsoid",
    )


BY_SCHEMA: dict[str, tuple[Recipe, ...]] = {
    "septentrio_gnss_driver/msg/PVTGeodetic": (_pvt_geodetic(),),
    "septentrio_gnss_driver/msg/PosCovGeodetic": (_pos_cov_geodetic(),),
    "ublox_ubx_msgs/msg/UBXNavPVT": (_ubx_nav_pvt(),),
    "ublox_msgs/msg/NavPVT": (
        _nav_pvt("h_acc", "v_acc", ("vel_e", "vel_n", "vel_d"), "num_sv", "fix_type"),
        _nav_pvt("hAcc", "vAcc", ("velE", "velN", "velD"), "numSV", "fixType"),
    ),
    "ublox_ubx_msgs/msg/UBXNavSat": (
        _nav_sat({"t": "header.stamp"}, "sv_info", pl.col("flags.sv_used"), {"flags.sv_used": pl.Boolean()}),
    ),
    "ublox_msgs/msg/NavSAT": (_nav_sat({}, "sv", (pl.col("flags") & 8) == 8, {}),),
    "novatel_oem7_msgs/msg/BESTPOS": (_bestpos(),),
    "gps_msgs/msg/GPSFix": (_gps_fix(),),
    "gps_common/msg/GPSFix": (_gps_fix(),),  # its name in ROS 1
}
