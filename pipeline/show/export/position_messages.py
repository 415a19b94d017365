"""Positions as messages that viewers know: foxglove.LocationFix (protobuf) and sensor_msgs/NavSatFix (ROS 2)."""

from __future__ import annotations

from collections.abc import Mapping

import polars as pl

from pipeline.show.export.messages import Fields, Topic, cdr_messages, message_topic
from schemas.enums import Fix

LOCATION_FIX = "foxglove.LocationFix"
LOCATION_FIELDS: Fields = (
    ("latitude", "double"), ("longitude", "double"), ("altitude", "double"), ("position_covariance", "doubles"),
    ("position_covariance_type", "covariance type"), ("timestamp", "time"), ("frame_id", "string"),
)  # fmt: skip
"""foxglove.LocationFix: fields in the order of their numbers."""

_COVARIANCE = tuple(f"cov_{axes}_m2" for axes in ("ee", "en", "eu", "en", "nn", "nu", "eu", "nu", "uu"))
HELD = {"t", "solution", "latitude_deg", "longitude_deg", "height_m", "fix", *_COVARIANCE}
"""Columns of the stream `gnss` that both messages hold, or that a topic of its own tells."""
_PLACES = tuple(f"covariance {place}" for place in range(9))
_UNKNOWN, _KNOWN = 0, 3  # covariance types of both messages

NAVSATFIX = "sensor_msgs/msg/NavSatFix"
NAVSATFIX_DEFINITION = f"\n{'=' * 80}\n".join(
    (
        "uint8 COVARIANCE_TYPE_UNKNOWN=0\nuint8 COVARIANCE_TYPE_KNOWN=3\n"
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\n"
        "float64 latitude\nfloat64 longitude\nfloat64 altitude\n"
        "float64[9] position_covariance\nuint8 position_covariance_type",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
        "MSG: sensor_msgs/NavSatStatus\n"
        "int8 STATUS_NO_FIX=-1\nint8 STATUS_FIX=0\nint8 STATUS_SBAS_FIX=1\nint8 STATUS_GBAS_FIX=2\n"
        "int8 status\n"
        "uint16 SERVICE_GPS=1\nuint16 SERVICE_GLONASS=2\nuint16 SERVICE_COMPASS=4\nuint16 SERVICE_GALILEO=8\n"
        "uint16 service\n",
    )
)
# The same message, its parts one after the other.
_NAVSATFIX_FIELDS: Fields = (
    ("t", "time"), ("frame_id", "string"), ("status", "int8"), ("service", "uint16"),
    ("latitude_deg", "double"), ("longitude_deg", "double"), ("height_m", "double"),
    *((place, "double") for place in _PLACES), ("type", "uint8"),
)  # fmt: skip
_NAVSAT_STATUS: Mapping[str, int] = {
    Fix.NONE: -1, Fix.AUTONOMOUS: 0, Fix.SBAS: 1, Fix.DIFFERENTIAL: 2, Fix.RTK_FLOAT: 2, Fix.RTK_FIXED: 2,
    Fix.ESTIMATED: 0,
}  # fmt: skip


def location_fix_topic(topic: str, gnss: pl.DataFrame, frame_id: str) -> Topic:
    """One foxglove.LocationFix per row of `gnss`; rows need a position."""
    rows = _with_covariance(gnss, frame_id).select(
        pl.col("frame_id"),
        latitude="latitude_deg",
        longitude="longitude_deg",
        altitude=pl.col("height_m").fill_null(0.0),
        position_covariance=pl.concat_list(_PLACES),
        position_covariance_type="type",
        timestamp="t",
    )
    times = rows["timestamp"].to_list()
    return message_topic(topic, LOCATION_FIX, LOCATION_FIELDS, times, rows.iter_rows(named=True), "protobuf")


def navsatfix_topic(topic: str, gnss: pl.DataFrame, frame_id: str) -> Topic:
    """One sensor_msgs/NavSatFix per row of `gnss`; an unknown position or height is NaN."""
    status = pl.col("fix").cast(pl.String).replace_strict(_NAVSAT_STATUS, return_dtype=pl.Int8)
    rows = _with_covariance(gnss, frame_id).with_columns(status=status, service=pl.lit(1))  # SERVICE_GPS
    messages = cdr_messages(_NAVSATFIX_FIELDS, rows.iter_rows(named=True))
    return Topic(topic, "cdr", NAVSATFIX, "ros2msg", NAVSATFIX_DEFINITION.encode(), rows["t"].to_list(), messages)


def _with_covariance(gnss: pl.DataFrame, frame_id: str) -> pl.DataFrame:
    """Rows with the covariance, row by row of the matrix [m2], and its type; zeros where unknown. Times in ns."""
    known = pl.all_horizontal(pl.col(name).is_not_null() for name in _COVARIANCE)
    places = zip(_PLACES, _COVARIANCE, strict=True)
    return gnss.with_columns(
        pl.col("t").to_physical(),
        *(pl.when(known).then(pl.col(name)).otherwise(0.0).alias(place) for place, name in places),
        type=pl.when(known).then(_KNOWN).otherwise(_UNKNOWN),
        frame_id=pl.lit(frame_id),
    )
