"""Stream rows as message payloads: this project's JSON and protobuf, and the common ROS 2 and Foxglove ones."""

from __future__ import annotations

import json
from collections.abc import Iterator

import dataframely as dy
import numpy as np
import polars as pl

from pipeline.ingest.proto_schemas import LOCATION_FIX, message_class
from schemas.enums import Fix
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import Stream

SECOND_NS = 1_000_000_000

Row = dict[str, object]

_COVARIANCE = ("ee", "en", "eu", "en", "nn", "nu", "eu", "nu", "uu")
_NAVSAT_STATUS = {
    Fix.NONE: -1, Fix.AUTONOMOUS: 0, Fix.SBAS: 1, Fix.DIFFERENTIAL: 2, Fix.RTK_FLOAT: 2, Fix.RTK_FIXED: 2,
    Fix.ESTIMATED: 0,
}  # fmt: skip
GNSS_IN_STANDARD = {
    "t", "solution", "latitude_deg", "longitude_deg", "height_m", "fix",
    *(f"cov_{axes}_m2" for axes in set(_COVARIANCE)),
}  # fmt: skip
_UNKNOWN, _KNOWN = 0, 3  # covariance types of both NavSatFix and LocationFix


def json_schema(stream: Stream) -> bytes:
    """The jsonschema of this project's own message: one property per column."""
    properties = {name: _json_property(column) for name, column in STREAM_SCHEMAS[stream].columns().items()}
    document = {"title": stream, "type": "object", "properties": properties}
    return json.dumps(document, sort_keys=True).encode()


def _json_property(column: dy.Column) -> dict[str, object]:
    named: dict[str, object] = {"description": column.description or ""}
    if isinstance(column, dy.Datetime):
        parts = {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}
        return named | {"type": "object", "title": "time", "properties": parts}
    if isinstance(column, dy.Enum):
        return named | {"type": "string", "enum": list(column.categories)}
    kinds = {dy.Float64: "number", dy.Int64: "integer", dy.Bool: "boolean", dy.String: "string"}
    return named | {"type": kinds[type(column)]}


def json_payloads(frame: pl.DataFrame) -> Iterator[bytes]:
    """One object per row; a null is left out."""
    times = [name for name, dtype in frame.schema.items() if isinstance(dtype, pl.Datetime)]
    for row in frame.with_columns(pl.col(times).to_physical()).iter_rows(named=True):
        known = {name: value for name, value in row.items() if value is not None}
        for name in times:
            if name in known:
                seconds, rest = divmod(known[name], SECOND_NS)
                known[name] = {"sec": seconds, "nsec": rest}
        yield json.dumps(known, separators=(",", ":"), ensure_ascii=False).encode()


def own_protobuf_payloads(frame: pl.DataFrame, name: str) -> Iterator[bytes]:
    """This project's own protobuf message per row; a null is not set."""
    kind = message_class(name)
    times = [column for column, dtype in frame.schema.items() if isinstance(dtype, pl.Datetime)]
    for row in frame.with_columns(pl.col(times).to_physical()).iter_rows(named=True):
        message = kind()
        for column, value in row.items():
            if value is None:
                continue
            if column in times:
                stamp = getattr(message, column)
                stamp.SetInParent()
                stamp.seconds, stamp.nanos = divmod(value, SECOND_NS)
            else:
                setattr(message, column, value)
        yield message.SerializeToString(deterministic=True)


def location_fix_payloads(frame: pl.DataFrame, frame_id: str) -> Iterator[bytes]:
    """foxglove.LocationFix per row; rows need a position."""
    kind = message_class(LOCATION_FIX)
    for row in frame.with_columns(pl.col("t").to_physical()).iter_rows(named=True):
        covariance = _covariance(row)
        message = kind(
            latitude=row["latitude_deg"],
            longitude=row["longitude_deg"],
            altitude=row["height_m"] or 0.0,
            position_covariance=covariance or [0.0] * 9,
            position_covariance_type=_KNOWN if covariance else _UNKNOWN,
            frame_id=frame_id,
        )
        message.timestamp.SetInParent()
        message.timestamp.seconds, message.timestamp.nanos = divmod(row["t"], SECOND_NS)
        yield message.SerializeToString(deterministic=True)


def _covariance(row: Row) -> list[float] | None:
    values = [row[f"cov_{axes}_m2"] for axes in _COVARIANCE]
    return None if any(value is None for value in values) else [float(value) for value in values]  # type: ignore[arg-type]


def navsatfix_payloads(frame: pl.DataFrame, frame_id: str) -> Iterator[bytes]:
    """sensor_msgs/NavSatFix in little-endian CDR; unknown position or height is NaN."""
    covariance = frame.select(f"cov_{axes}_m2" for axes in dict.fromkeys(_COVARIANCE))
    known = ~covariance.select(pl.any_horizontal(pl.all().is_null())).to_series().to_numpy()
    status = (
        frame["fix"]
        .cast(pl.String)
        .replace_strict({kind.value: code for kind, code in _NAVSAT_STATUS.items()}, return_dtype=pl.Int8)
    )
    fields: dict[str, tuple[str, np.ndarray]] = {
        "status": ("i1", status.to_numpy()),
        "service": ("<u2", np.ones(frame.height)),
        **{name: ("<f8", _floats(frame[name])) for name in ("latitude_deg", "longitude_deg", "height_m")},
        **{
            f"covariance {place}": ("<f8", np.where(known, _floats(frame[f"cov_{axes}_m2"]), 0.0))
            for place, axes in enumerate(_COVARIANCE)
        },
        "type": ("u1", np.where(known, _KNOWN, _UNKNOWN)),
    }
    return _cdr(frame["t"], frame_id, (), fields)


def twist_payloads(frame: pl.DataFrame, frame_id: str) -> Iterator[bytes]:
    """geometry_msgs/TwistStamped in little-endian CDR: speed as linear x."""
    zeros = np.zeros(frame.height)
    fields = {"x": ("<f8", _floats(frame["speed_mps"]))}
    fields |= dict.fromkeys(("y", "z", "roll", "pitch", "yaw"), ("<f8", zeros))
    return _cdr(frame["t"], frame_id, (), fields)


def odometry_payloads(frame: pl.DataFrame, frame_id: str) -> Iterator[bytes]:
    """nav_msgs/Odometry in little-endian CDR: speed as linear x, variance where the stream has it."""
    count = frame.height
    variance = frame["sigma_speed_mps"].fill_null(0.0).to_numpy() ** 2
    pose = {f"pose {index}": ("<f8", np.full(count, float(index == 6))) for index in range(7)}
    pose |= {f"pose covariance {index}": ("<f8", np.zeros(count)) for index in range(36)}
    twist = {f"twist {index}": ("<f8", np.zeros(count)) for index in range(6)}
    twist["twist 0"] = ("<f8", _floats(frame["speed_mps"]))
    twist |= {f"twist covariance {index}": ("<f8", np.zeros(count)) for index in range(36)}
    twist["twist covariance 0"] = ("<f8", variance)
    return _cdr(frame["t"], frame_id, ("base_link",), pose | twist)


def _floats(series: pl.Series) -> np.ndarray:
    return series.cast(pl.Float64).fill_null(float("nan")).to_numpy()


def _cdr(
    t: pl.Series, frame_id: str, strings: tuple[str, ...], fields: dict[str, tuple[str, np.ndarray]]
) -> Iterator[bytes]:
    """Messages that start with a header and go on with fixed fields, laid out by CDR's alignment rules."""
    head = b"\x00\x01\x00\x00" + bytes(8)
    for text in (frame_id, *strings):
        head += bytes(-(len(head) - 4) % 4) + (len(text.encode()) + 1).to_bytes(4, "little") + text.encode() + b"\0"
    offset, offsets = len(head), []
    for kind, _ in fields.values():
        size = np.dtype(kind).itemsize
        offset += -(offset - 4) % size
        offsets.append(offset)
        offset += size
    layout = np.dtype(
        {
            "names": ["head", "sec", "nsec", *fields],
            "formats": [f"V{len(head)}", "<i4", "<u4", *(kind for kind, _ in fields.values())],
            "offsets": [0, 4, 8, *offsets],
            "itemsize": offset,
        }
    )
    rows = np.zeros(len(t), dtype=layout)
    rows["head"] = np.void(head)
    rows["sec"], rows["nsec"] = np.divmod(t.to_physical().to_numpy(), SECOND_NS)
    for name, (_, values) in fields.items():
        rows[name] = values
    content = rows.tobytes()
    return (content[start : start + offset] for start in range(0, len(content), offset))
