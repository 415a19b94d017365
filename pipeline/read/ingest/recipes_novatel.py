"""Recipes for NovAtel's receivers in ROS bags, of both drivers: `novatel_oem7_msgs`, `novatel_gps_msgs`.

Heights are over mean sea level, so the undulation is added.
"""

from __future__ import annotations

import polars as pl

from pipeline.read.ingest import novatel
from pipeline.read.ingest.recipe import Recipe, deviations, fix_from, unless

# Of the messages of one receiver, as for its own files: the position of the receiver before that of the inertial unit.
_RECEIVER = 2
_INERTIAL = 1
_VELOCITY = {"vel_e_mps": "east_velocity", "vel_n_mps": "north_velocity", "vel_u_mps": "up_velocity"}
# WGS 84 [m]: semi-major axis, flattening.
_A_M = 6_378_137.0
_F = 1 / 298.257223563
_TEXT = pl.String()


def _bestpos() -> Recipe:
    """novatel_oem7_msgs/msg/BESTPOS."""
    return Recipe(
        stream="gnss",
        columns={
            "latitude_deg": pl.col("lat"),
            "longitude_deg": pl.col("lon"),
            "height_m": pl.col("hgt") + pl.col("undulation"),
            **deviations("lon_stdev", "lat_stdev", "hgt_stdev"),
            "fix": fix_from(pl.col("pos_type.type"), novatel.FIX_BY_CODE, known=pl.col("sol_status.status") == 0),
            "satellites": pl.col("num_sol_svs"),
        },
        whole=("sol_status.status", "pos_type.type", "num_sol_svs"),
        rank=_RECEIVER,
    )


def _inspvax() -> Recipe:
    """novatel_oem7_msgs/msg/INSPVAX."""
    solved = pl.col("ins_status.status").is_in(list(novatel.SOLVED))
    return Recipe(
        stream="gnss",
        columns={
            "latitude_deg": pl.col("latitude"),
            "longitude_deg": pl.col("longitude"),
            "height_m": pl.col("height") + pl.col("undulation"),
            **{column: pl.col(path) for column, path in _VELOCITY.items()},
            **deviations("longitude_stdev", "latitude_stdev", "height_stdev"),
            "fix": fix_from(pl.col("pos_type.type"), novatel.FIX_BY_CODE, known=solved),
        },
        whole=("ins_status.status", "pos_type.type"),
        rank=_INERTIAL,
    )


def _inspvax_of_texts() -> Recipe:
    """novatel_gps_msgs/msg/Inspvax: states and types as the ASCII logs name them."""
    solved = pl.col("ins_status").is_in(list(novatel.SOLVED_WORDS))
    return Recipe(
        stream="gnss",
        columns={
            "latitude_deg": pl.col("latitude"),
            "longitude_deg": pl.col("longitude"),
            "height_m": pl.col("altitude") + pl.col("undulation"),
            **{column: pl.col(path) for column, path in _VELOCITY.items()},
            **deviations("longitude_std", "latitude_std", "altitude_std"),
            "fix": fix_from(pl.col("position_type"), novatel.FIX_BY_WORD, known=solved),
        },
        types={"ins_status": _TEXT, "position_type": _TEXT},
        rank=_INERTIAL,
    )


def _position_xyz() -> Recipe:
    """novatel_gps_msgs/msg/NovatelXYZ (BESTXYZ): earth-centred, as it is without a solution of zeros."""
    known = pl.col("solution_status") == "SOL_COMPUTED"
    latitude, longitude, height_m = _geodetic(pl.col("x"), pl.col("y"), pl.col("z"))
    east = (-longitude.sin(), longitude.cos(), pl.lit(0.0))
    north = (-latitude.sin() * longitude.cos(), -latitude.sin() * longitude.sin(), latitude.cos())
    up = (latitude.cos() * longitude.cos(), latitude.cos() * longitude.sin(), latitude.sin())
    axes = {"e": east, "n": north, "u": up}
    variance_m2 = [pl.col(f"{name}_sigma") ** 2 for name in "xyz"]
    velocity_mps = [pl.col(f"{name}_vel") for name in "xyz"]
    moves = pl.col("velocity_solution_status") == "SOL_COMPUTED"
    return Recipe(
        stream="gnss",
        columns={
            "latitude_deg": unless(~known, latitude.degrees()),
            "longitude_deg": unless(~known, longitude.degrees()),
            "height_m": unless(~known, height_m),
            **{f"vel_{axis}_mps": unless(~moves, _sum(axes[axis], velocity_mps)) for axis in "enu"},
            **{
                f"cov_{one}{other}_m2": unless(
                    ~known, _sum([a * b for a, b in zip(axes[one], axes[other], strict=True)], variance_m2)
                )
                for one, other in ("ee", "en", "eu", "nn", "nu", "uu")
            },
            "fix": fix_from(pl.col("position_type"), novatel.FIX_BY_WORD, known=known),
            "satellites": pl.col("num_satellites_used_in_solution"),
        },
        types=dict.fromkeys(("solution_status", "position_type", "velocity_solution_status"), _TEXT),
        whole=("num_satellites_used_in_solution",),
        rank=_RECEIVER,
    )


def _sum(factors: list[pl.Expr] | tuple[pl.Expr, ...], values: list[pl.Expr]) -> pl.Expr:
    return pl.sum_horizontal(factor * value for factor, value in zip(factors, values, strict=True))


def _geodetic(x: pl.Expr, y: pl.Expr, z: pl.Expr) -> tuple[pl.Expr, pl.Expr, pl.Expr]:
    """Latitude and longitude [rad] and height [m] by Bowring's formula, exact to a micrometre near the ground."""
    b_m = _A_M * (1 - _F)
    e2 = _F * (2 - _F)
    axis_m = (x**2 + y**2).sqrt()
    reduced = pl.arctan2(z * _A_M, axis_m * b_m)
    latitude = pl.arctan2(
        z + e2 / (1 - e2) * b_m * reduced.sin() ** 3,
        axis_m - e2 * _A_M * reduced.cos() ** 3,
    )
    height_m = axis_m * latitude.cos() + z * latitude.sin() - _A_M * (1 - e2 * latitude.sin() ** 2).sqrt()
    return latitude, pl.arctan2(y, x), height_m


BY_SCHEMA: dict[str, tuple[Recipe, ...]] = {
    "novatel_oem7_msgs/msg/BESTPOS": (_bestpos(),),
    "novatel_oem7_msgs/msg/INSPVAX": (_inspvax(),),
    "novatel_gps_msgs/msg/Inspvax": (_inspvax_of_texts(),),
    "novatel_gps_msgs/msg/NovatelXYZ": (_position_xyz(),),
}
