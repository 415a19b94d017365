"""A log as odometry nodes write it: every field of `nav_msgs/Odometry` filled, not the speed alone.

`balise`'s own writer knows a speed and leaves pose and covariances at zero, which compresses to almost nothing: such a
log is read and decompressed several times faster than a recorded one, and is a bound that no recording sets.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from schemas.arrays import Floats

_ODOMETRY = "nav_msgs/msg/Odometry"
# Position 3, orientation 4, covariance 36, linear 3, angular 3, covariance 36: the message ends with them.
_DOUBLES = 85
_POSE, _TWIST = slice(0, 7), slice(43, 49)
_POSE_VARIANCES, _TWIST_VARIANCES = slice(7, 43, 7), slice(49, 85, 7)
_BEND_M, _SWING_RAD = 3000.0, 0.4
_GYRO_RADPS = 1e-3


def filled(log: Path, seed: int = 1) -> Path:
    """The log again, beside it, with the pose and covariances of a node that integrates wheels and a gyroscope."""
    target = log.with_name(f"{log.stem}-filled.mcap")
    with log.open("rb") as source, target.open("wb") as sink:
        messages = list(make_reader(source).iter_messages(log_time_order=False))
        odometry = [message for schema, _, message in messages if schema and schema.name == _ODOMETRY]
        seconds = np.array([message.log_time for message in odometry]) * 1e-9
        speeds_mps = np.array([np.frombuffer(message.data[-8 * _DOUBLES :])[_TWIST][0] for message in odometry])
        tails = iter(_fields(seconds, speeds_mps, np.random.default_rng(seed)))
        writer = Writer(sink, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="benchmark")
        channels: dict[int, int] = {}
        for schema, channel, message in messages:
            if schema is None:
                raise ValueError(f"channel {channel.topic} has no schema")
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            data = message.data
            if schema.name == _ODOMETRY:
                data = data[: -8 * _DOUBLES] + next(tails).tobytes()
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]
    return target


def _fields(seconds: Floats, speed_mps: Floats, rng: np.random.Generator) -> Floats:
    """The doubles of each message, shape (messages, 85)."""
    dt = np.diff(seconds, prepend=seconds[:1])
    travelled_m = np.cumsum(speed_mps * dt)
    yaw = _SWING_RAD * np.sin(travelled_m / _BEND_M) + np.cumsum(rng.normal(0.0, _GYRO_RADPS, dt.size) * dt)
    found = np.zeros((seconds.size, _DOUBLES))
    nothing = np.zeros(seconds.size)
    east, north = np.cumsum(speed_mps * dt * np.cos(yaw)), np.cumsum(speed_mps * dt * np.sin(yaw))
    found[:, _POSE] = np.column_stack([east, north, nothing, nothing, nothing, np.sin(yaw / 2.0), np.cos(yaw / 2.0)])
    turn = np.gradient(yaw, seconds) + rng.normal(0.0, _GYRO_RADPS, dt.size)
    found[:, _TWIST] = np.column_stack([speed_mps, nothing, nothing, nothing, nothing, turn])
    grown = 1e-4 * travelled_m
    found[:, _POSE_VARIANCES] = np.column_stack(
        [grown, grown, nothing + 1e6, nothing + 1e6, nothing + 1e6, 1e-6 * travelled_m]
    )
    found[:, _TWIST_VARIANCES] = (2.5e-3, 1e-6, 1e6, 1e6, 1e6, 1e-6)
    return found
