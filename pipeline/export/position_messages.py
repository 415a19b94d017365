"""Positions as messages that viewers know: foxglove.LocationFix (protobuf) and sensor_msgs/NavSatFix (ROS 2)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import polars as pl

from pipeline.export.messages import Fields, Topic, cdr_messages, message_topic
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
    *((f"covariance {place}", "double") for place in range(9)), ("type", "uint8"),
)  # fmt: skip
_NAVSAT_STATUS: Mapping[str, int] = {
    Fix.NONE: -1, Fix.AUTONOMOUS: 0, Fix.SBAS: 1, Fix.DIFFERENTIAL: 2, Fix.RTK_FLOAT: 2, Fix.RTK_FIXED: 2,
    Fix.ESTIMATED: 0,
}  # fmt: skip


def location_fix_topic(topic: str, gnss: pl.DataFrame, frame_id: str) -> Topic:
    """One foxglove.LocationFix per row of `gnss`; rows need a position."""
    rows = (
        {
            "latitude": row["latitude_deg"],
            "longitude": row["longitude_deg"],
            "altitude": row["height_m"] or 0.0,
            "position_covariance": covariance,
            "position_covariance_type": kind,
            "timestamp": row["t"],
            "frame_id": frame_id,
        }
        for row, covariance, kind in _with_covariance(gnss)
    )
    return message_topic(topic, LOCATION_FIX, LOCATION_FIELDS, _times_ns(gnss), rows, "protobuf")


def navsatfix_topic(topic: str, gnss: pl.DataFrame, frame_id: str) -> Topic:
    """One sensor_msgs/NavSatFix per row of `gnss`; an unknown position or height is NaN."""
    rows = (
        row
        | {"frame_id": frame_id, "status": _NAVSAT_STATUS[row["fix"]], "service": 1, "type": kind}  # SERVICE_GPS
        | {f"covariance {place}": value for place, value in enumerate(covariance)}
        for row, covariance, kind in _with_covariance(gnss)
    )
    messages = cdr_messages(_NAVSATFIX_FIELDS, rows)
    return Topic(topic, "cdr", NAVSATFIX, "ros2msg", NAVSATFIX_DEFINITION.encode(), _times_ns(gnss), messages)


def _with_covariance(gnss: pl.DataFrame) -> Iterator[tuple[dict[str, Any], list[float], int]]:
    """Rows with their covariance, row by row of the matrix [m2], and its type; zeros where it is not known."""
    for row in gnss.with_columns(pl.col("t").to_physical()).iter_rows(named=True):
        values = [row[name] for name in _COVARIANCE]
        known = None not in values
        yield row, values if known else [0.0] * len(values), _KNOWN if known else _UNKNOWN


def _times_ns(gnss: pl.DataFrame) -> list[int]:
    return gnss["t"].to_physical().to_list()
