"""Logs of known size for the ingest benchmark: 10 Hz GNSS and 50 Hz odometer."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import polars as pl

from datasets.mcap_log import Encoding, OdometerMessage, write_mcap
from pipeline.read.ingest.conform import conform
from schemas.config import IngestConfig, StreamMapping
from schemas.enums import Origin
from schemas.run import RunLog, Stream

Case = Literal["cdr Odometry", "cdr TwistStamped", "protobuf", "json"]
CASES: dict[Case, tuple[Encoding, OdometerMessage]] = {
    "cdr Odometry": ("cdr", "nav_msgs/msg/Odometry"),
    "cdr TwistStamped": ("cdr", "geometry_msgs/msg/TwistStamped"),
    "protobuf": ("protobuf", "geometry_msgs/msg/TwistStamped"),
    "json": ("json", "geometry_msgs/msg/TwistStamped"),
}
START_NS = 1_700_000_000_000_000_000


def run_of(hours: float, seed: int = 1) -> RunLog:
    """A smooth journey with noise in every field, as a receiver would log it."""
    rng = np.random.default_rng(seed)
    gnss_count, odometer_count = round(hours * 36_000), round(hours * 180_000)
    seconds = np.arange(gnss_count) / 10.0
    gnss = pl.DataFrame(
        {
            "t": _times(gnss_count, 100_000_000),
            "latitude_deg": 50.0 + seconds * 2e-4 + rng.normal(0, 5e-6, gnss_count),
            "longitude_deg": 4.0 + seconds * 1e-4 + rng.normal(0, 5e-6, gnss_count),
            "height_m": 120.0 + rng.normal(0, 1, gnss_count),
            "fix": ["autonomous"] * gnss_count,
            **{f"cov_{axes}_m2": rng.uniform(0.2, 2.0, gnss_count) for axes in ("ee", "nn", "uu")},
            **{f"cov_{axes}_m2": rng.normal(0, 0.1, gnss_count) for axes in ("en", "eu", "nu")},
        }
    )
    speed = 30.0 + 5.0 * np.sin(np.arange(odometer_count) / 9_000.0) + rng.normal(0, 0.05, odometer_count)
    odometer = pl.DataFrame({"t": _times(odometer_count, 20_000_000), "speed_mps": speed})
    return RunLog("bench", _conformed(gnss, "gnss"), _conformed(odometer, "odometer"))


def _times(count: int, step_ns: int) -> pl.Series:
    return pl.Series(START_NS + np.arange(count, dtype=np.int64) * step_ns).cast(pl.Datetime("ns", "UTC"))


def _conformed(frame: pl.DataFrame, stream: Stream) -> pl.DataFrame:
    return conform(frame, stream, "benchmark", [])


def write_case(run: RunLog, case: Case, folder: Path, chunk_crc: bool = True) -> Path:
    """The run as one log; without chunk checksums the file is what `--no-crc` recorders write."""
    encoding, message = CASES[case]
    path = folder / f"{case.replace(' ', '_')}_{'crc' if chunk_crc else 'nocrc'}.mcap"
    write_mcap(run, path, encoding, odometer_message=message, checksums=chunk_crc)
    return path


def config_of(log: Path) -> IngestConfig:
    """What reads both streams of a case: a twist of ROS is an odometer only where a mapping names it."""
    wheel = StreamMapping(topic="/odometer", origin=Origin.WHEEL)
    return IngestConfig(odometer=(wheel,)) if log.name.startswith("cdr") else IngestConfig()
