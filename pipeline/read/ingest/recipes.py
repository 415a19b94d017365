"""Recipes by schema: the common messages, this project's own, and those of receiver drivers."""

from __future__ import annotations

from collections.abc import Sequence

import dataframely as dy
import polars as pl

from pipeline.read.ingest import recipes_drivers
from pipeline.read.ingest.recipe import FIX_TYPE, Recipe, covariance_enu, fix_from, position_columns
from schemas.enums import Fix
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, Stream

OWN_PREFIX = "balise."

# sensor_msgs/NavSatStatus: GBAS is differential correction from the ground.
_NAVSAT_FIX = {-1: Fix.NONE, 0: Fix.AUTONOMOUS, 1: Fix.SBAS, 2: Fix.DIFFERENTIAL}


def _navsatfix() -> Recipe:
    """sensor_msgs/msg/NavSatFix: altitude over the ellipsoid, NaN where there is none."""
    status = pl.col("status.status")
    return Recipe(
        stream="gnss",
        columns={
            **position_columns(status),
            "fix": fix_from(status, _NAVSAT_FIX),
            **covariance_enu(pl.col("position_covariance_type") > 0),
        },
        whole=("status.status", "position_covariance_type"),
    )


def _location_fix() -> Recipe:
    """foxglove.LocationFix: it has no status, so every position counts as an autonomous fix.

    Later versions have a velocity, east, north and up.
    """
    return Recipe(
        stream="gnss",
        stamps={"t": "timestamp"},
        columns={
            "latitude_deg": pl.col("latitude"),
            "longitude_deg": pl.col("longitude"),
            "height_m": pl.col("altitude").fill_nan(None),
            **{f"vel_{axis}_mps": pl.col(f"velocity.{name}") for axis, name in zip("enu", "xyz", strict=True)},
            "fix": pl.lit(Fix.AUTONOMOUS.value, dtype=FIX_TYPE),
            **covariance_enu(pl.col("position_covariance_type") > 0),
        },
        whole=("position_covariance_type",),
        remark="the message has no fix status: every position is taken as an autonomous fix",
    )


def _twist(path: str) -> Recipe:
    """A speed of nobody knows what, a filter of positions as often as a wheel: read where a mapping names the topic."""
    return Recipe(stream="odometer", columns={"speed_mps": pl.col(path)}, only_mapped=True)


def own_recipe(stream: Stream) -> Recipe:
    """This project's own schema: one message per row, fields named as the columns, absent = not known."""
    columns = STREAM_SCHEMAS[stream].columns()
    times = {name: name for name, column in columns.items() if isinstance(column, dy.Datetime)}
    values = {name: column for name, column in columns.items() if name not in times}
    return Recipe(
        stream=stream,
        stamps=times,
        columns={name: pl.col(name) for name in values},
        types={name: recorded_type(column) for name, column in values.items()},
        own=True,
    )


def recorded_type(column: dy.Column) -> pl.DataType:
    """The type in which a column of the contract stands in a message."""
    return pl.String() if isinstance(column, dy.Enum) else column.dtype


_COMMON: dict[str, tuple[Recipe, ...]] = {
    "foxglove.LocationFix": (_location_fix(),),
    "foxglove_msgs/msg/LocationFix": (_location_fix(),),
    "sensor_msgs/msg/NavSatFix": (_navsatfix(),),
    "nav_msgs/msg/Odometry": (_twist("twist.twist.linear.x"),),
    "geometry_msgs/msg/TwistStamped": (_twist("twist.linear.x"),),
    "geometry_msgs/msg/TwistWithCovarianceStamped": (_twist("twist.twist.linear.x"),),
}
OWN_SCHEMAS: dict[Stream, str] = {
    stream: OWN_PREFIX + "".join(part.capitalize() for part in stream.split("_")) for stream in STREAMS
}
BY_SCHEMA: dict[str, tuple[Recipe, ...]] = (
    _COMMON | recipes_drivers.BY_SCHEMA | {OWN_SCHEMAS[stream]: (own_recipe(stream),) for stream in STREAMS}
)
OWN_TOPICS: dict[str, Stream] = {f"/{stream}": stream for stream in STREAMS}


def recipes_for(schema_name: str, topic: str) -> Sequence[Recipe]:
    """Recipes by schema name, or by topic for this project's own topics; none if unknown."""
    known = BY_SCHEMA.get(_canonical(schema_name), ())
    if not known and topic in OWN_TOPICS:
        return (own_recipe(OWN_TOPICS[topic]),)
    return known


def _canonical(schema_name: str) -> str:
    """ROS 2 names with their `/msg/`, which some recorders leave out."""
    parts = schema_name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else schema_name
