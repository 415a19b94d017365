"""How messages of known schemas become rows: stream columns as expressions over recorded fields.

A field of a message is named by its path (`header.stamp`, `position_covariance[4]`); the decoders
deliver one column per path, and a recipe turns these into the columns of a stream.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import dataframely as dy
import polars as pl

from pipeline.ingest.stamps import TimeSource
from schemas.enums import Fix
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import STREAMS, Stream

FIX_TYPE = pl.Enum([kind.value for kind in Fix])
OWN_PREFIX = "balise."


@dataclass(frozen=True)
class Recipe:
    """Columns of one stream from the fields of one message.

    `stamps` names the fields that hold times (absent: the log time), `types` the types of fields that
    are not floats. `key` names the fields by which a `supplement` (a message that holds
    further columns of the same epochs, such as a covariance) finds its epoch. `time` is set where the time is computed.
    """

    stream: Stream
    columns: Mapping[str, pl.Expr]
    stamps: Mapping[str, str]
    types: Mapping[str, pl.DataType] = field(default_factory=dict)
    key: tuple[str, ...] = ()
    supplement: bool = False
    own: bool = False
    remark: str = ""
    time: TimeSource | None = None

    def fields_of(self, column: str) -> list[str]:
        """The recorded fields that a column is made of."""
        return list(dict.fromkeys(self.columns[column].meta.root_names()))

    def type_of(self, path: str) -> pl.DataType:
        return self.types.get(path, pl.Float64())


def fix_from(codes: pl.Expr, kinds: Mapping[int, Fix]) -> pl.Expr:
    """The kind of fix from a receiver's code; a code that is not listed makes no fix."""
    names = {code: kind.value for code, kind in kinds.items()}
    return codes.replace_strict(names, default=Fix.NONE.value, return_dtype=FIX_TYPE)


def unless(condition: pl.Expr, value: pl.Expr) -> pl.Expr:
    """The value, or null where the condition says that it is not known."""
    return pl.when(~condition).then(value)


def covariance_enu(known: pl.Expr, path: str = "position_covariance") -> dict[str, pl.Expr]:
    """Upper triangle of a row-major east-north-up covariance [m2]."""
    places = {"ee": 0, "en": 1, "eu": 2, "nn": 4, "nu": 5, "uu": 8}
    return {
        f"cov_{axes}_m2": pl.when(known).then(pl.col(f"{path}[{place}]")) for axes, place in places.items()
    }


# sensor_msgs/NavSatStatus: GBAS is differential correction from the ground.
_NAVSAT_FIX = {-1: Fix.NONE, 0: Fix.AUTONOMOUS, 1: Fix.SBAS, 2: Fix.DIFFERENTIAL}


def _navsatfix() -> Recipe:
    """sensor_msgs/msg/NavSatFix: altitude over the ellipsoid, NaN where there is none."""
    status = pl.col("status.status")

    def position(path: str) -> pl.Expr:
        return unless((status < 0) & pl.col(path).is_nan(), pl.col(path))

    return Recipe(
        stream="gnss",
        stamps={"t": "header.stamp"},
        columns={
            "latitude_deg": position("latitude"),
            "longitude_deg": position("longitude"),
            "height_m": pl.col("altitude").fill_nan(None),
            "fix": fix_from(status, _NAVSAT_FIX),
            **covariance_enu(pl.col("position_covariance_type") > 0),
        },
        types={"status.status": pl.Int64(), "position_covariance_type": pl.Int64()},
    )


def _location_fix() -> Recipe:
    """foxglove.LocationFix: it has no status, so every position counts as an autonomous fix."""
    return Recipe(
        stream="gnss",
        stamps={"t": "timestamp"},
        columns={
            "latitude_deg": pl.col("latitude"),
            "longitude_deg": pl.col("longitude"),
            "height_m": pl.col("altitude"),
            "fix": pl.lit(Fix.AUTONOMOUS.value, dtype=FIX_TYPE),
            **covariance_enu(pl.col("position_covariance_type") > 0),
        },
        types={"position_covariance_type": pl.Int64()},
        remark="the schema has no status: every position counts as an autonomous fix",
    )


def _twist(path: str) -> Recipe:
    return Recipe(stream="odometer", stamps={"t": "header.stamp"}, columns={"speed_mps": pl.col(path)})


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


BY_SCHEMA: dict[str, Recipe] = {
    "foxglove.LocationFix": _location_fix(),
    "sensor_msgs/msg/NavSatFix": _navsatfix(),
    "nav_msgs/msg/Odometry": _twist("twist.twist.linear.x"),
    "geometry_msgs/msg/TwistStamped": _twist("twist.linear.x"),
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist("twist.twist.linear.x"),
}
OWN_SCHEMAS: dict[Stream, str] = {
    stream: OWN_PREFIX + "".join(part.capitalize() for part in stream.split("_")) for stream in STREAMS
}
OWN_BY_SCHEMA: dict[str, Recipe] = {OWN_SCHEMAS[stream]: own_recipe(stream) for stream in STREAMS}
OWN_TOPICS: dict[str, Stream] = {f"/{stream}": stream for stream in STREAMS}


def recipe_for(schema_name: str, topic: str) -> Recipe | None:
    """The recipe by schema name, or by topic for this project's own topics; none if unknown."""
    name = _canonical(schema_name)
    known = BY_SCHEMA.get(name) or OWN_BY_SCHEMA.get(name)
    if known is None and topic in OWN_TOPICS:
        return own_recipe(OWN_TOPICS[topic])
    return known


def _canonical(schema_name: str) -> str:
    """ROS 2 names with their `/msg/`, which some recorders leave out."""
    parts = schema_name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else schema_name
