"""Logs of known size for the ingest benchmark: 10 Hz GNSS and 50 Hz odometer."""

from __future__ import annotations

import argparse
import io
import json
import struct
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np
import polars as pl
import pyarrow as pa

from benchmarks.results import Figure, stopwatch
from datasets.mcap_log import Encoding, OdometerMessage, write_mcap
from pipeline.read.ingest import read_run
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


# Largest ratio to reading and decompressing, and smallest to `mcap` with its decoder package. Of JSON the parser alone
# takes 2.1 (orjson, which makes no columns, 4.2), its columns 2.3, its texts side by side 1.
TARGETS: dict[Case, tuple[float, float]] = {
    "cdr Odometry": (2.5, 70.0),
    "cdr TwistStamped": (2.2, 50.0),
    "protobuf": (3.5, 14.0),
    "json": (9.0, 5.0),
}
_CRC_NS_PER_BYTE = 0.25
_LONG_HOURS = 10.0
_LONG_TOLERANCE = 1.25
_MEMORY_FACTOR = 3.0
_CHUNK = 0x06
_HEAD = struct.Struct("<BQ")


def read_and_decompress(path: Path) -> int:
    """The bound: the file's bytes and what its zstd chunks hold; returns the uncompressed size."""
    content = memoryview(path.read_bytes())
    at, total = 8, 0
    while at < len(content) - 8:
        opcode, length = _HEAD.unpack_from(content, at)
        if opcode == _CHUNK:
            body = content[at + 9 : at + 9 + length]
            size = struct.unpack_from("<Q", body, 16)[0]
            records = 32 + struct.unpack_from("<I", body, 28)[0] + 8
            total += len(pa.decompress(body[records:], size, codec="zstd"))
        at += 9 + length
    return total


def stock_columns(path: Path) -> dict[str, list[Any]]:
    """What one would write with `mcap` and its decoders: the fields of every message in lists."""
    import orjson
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
    from mcap_ros2.decoder import DecoderFactory as Ros2Factory

    columns: dict[str, list[Any]] = {"/gnss": [], "/odometer": []}
    reader = make_reader(io.BytesIO(path.read_bytes()), decoder_factories=[ProtobufFactory(), Ros2Factory()])
    if path.name.startswith("json"):
        for _, channel, message in reader.iter_messages(log_time_order=False):
            columns[channel.topic].append(_fields(channel.topic, orjson.loads(message.data).get))
        return columns
    for _, channel, _, decoded in reader.iter_decoded_messages(log_time_order=False):
        columns[channel.topic].append(_fields(channel.topic, partial(_attribute, decoded)))
    return columns


def _fields(topic: str, get: Callable[[str], Any]) -> tuple[Any, ...]:
    if topic == "/gnss":
        position = get("latitude_deg") or get("latitude"), get("longitude_deg") or get("longitude")
        return (*position, get("position_covariance"), get("t") or get("timestamp") or get("header"))
    return get("speed_mps"), get("twist"), get("t") or get("header")


def _attribute(message: Any, name: str) -> Any:
    return getattr(message, name, None)


def measure(folder: Path, hours: float = 1.0, repeats: int = 5, long: bool = False) -> list[Figure]:
    """Figures of all encodings."""
    folder.mkdir(parents=True, exist_ok=True)
    run = run_of(hours)
    figures = [figure for case in CASES for figure in _case(run, case, folder, repeats)]
    return figures + (_long(folder, repeats, figures) if long else [])


def _case(run: RunLog, case: Case, folder: Path, repeats: int) -> list[Figure]:
    plain = write_case(run, case, folder, chunk_crc=False)
    checked = write_case(run, case, folder, chunk_crc=True)
    bound, ours, with_crc, with_digest = _in_turn(
        repeats,
        lambda: read_and_decompress(plain),
        lambda: read_run(plain, config_of(plain), with_digest=False),
        lambda: read_run(checked, config_of(checked), with_digest=False),
        lambda: read_run(plain, config_of(plain)),
    )
    with stopwatch() as stock:
        stock_columns(plain)
    size = read_and_decompress(plain)
    crc_ns = (median(with_crc) - median(ours)) * 1e9 / size
    most, least = TARGETS[case]
    plain.unlink()
    checked.unlink()
    return [
        Figure(f"{case}: read and decompress", median(bound) * 1e3, "ms"),
        Figure(f"{case}: log to frames", median(ours) * 1e3, "ms"),
        Figure(f"{case}: against read and decompress", median(ours) / median(bound), "times", most),
        Figure(f"{case}: the same, with SHA-256 of the log", median(with_digest) / median(bound), "times"),
        Figure(f"{case}: against mcap and its decoder", stock.seconds / median(ours), "times", least, "above"),
        Figure(f"{case}: chunk checksums", crc_ns, "ns/byte", _CRC_NS_PER_BYTE),
        Figure(f"{case}: noise of the bound, (max - min) / median", (max(bound) - min(bound)) / median(bound), "1"),
    ]


def _in_turn(repeats: int, *works: Callable[[], object]) -> list[list[float]]:
    """Seconds of each work, measured one after the other so that noise hits all alike."""
    taken: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for seconds, work in zip(taken, works, strict=True):
            with stopwatch() as watch:
                work()
            seconds.append(watch.seconds)
    return taken


def _long(folder: Path, repeats: int, short: list[Figure]) -> list[Figure]:
    run = run_of(_LONG_HOURS)
    figures = []
    for case in CASES:
        path = write_case(run, case, folder, chunk_crc=False)
        name = f"{case}: against read and decompress"
        before = next(figure.value for figure in short if figure.name == name)
        bound, ours = _in_turn(
            repeats, partial(read_and_decompress, path), partial(read_run, path, config_of(path), with_digest=False)
        )
        ratio = median(ours) / median(bound)
        figures += [
            Figure(f"{case}, ten hours: ratio against that of one hour", ratio / before, "times", _LONG_TOLERANCE),
            Figure(f"{case}, ten hours: memory over size of frames", memory_factor(path), "times", _MEMORY_FACTOR),
        ]
        path.unlink()
    return figures


_MEMORY_SCRIPT = """
import re, sys
from pathlib import Path
from benchmarks.speed.ingest import config_of
from pipeline.read.ingest import read_run

def status(name):
    return 1024 * int(re.search(name + r":\\s+(\\d+)", Path("/proc/self/status").read_text()).group(1))

read_run(Path(sys.argv[1]), config_of(Path(sys.argv[1])))
Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from what is resident now
before = status("VmRSS")
run = read_run(Path(sys.argv[2]), config_of(Path(sys.argv[2])))
print((status("VmHWM") - before) / sum(frame.estimated_size() for frame in (run.gnss, run.odometer)))
"""


def memory_factor(path: Path) -> float:
    """Growth of a fresh process over the size of the frames that it reads, after a short log warmed it."""
    warm_up = path.parent / "warm-up"
    warm_up.mkdir(exist_ok=True)
    small = write_case(run_of(0.02), "json", warm_up, chunk_crc=False)
    script = [sys.executable, "-c", _MEMORY_SCRIPT, str(small), str(path)]
    done = subprocess.run(script, check=True, capture_output=True, text=True)
    return float(done.stdout)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="benchmarks.speed.ingest", description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--long", action="store_true", help="also ten hours of log")
    parser.add_argument("--out", type=Path, default=Path("bench-out/ingest"))
    given = parser.parse_args()
    figures = measure(given.out, given.hours, given.repeats, given.long)
    for figure in figures:
        target = "" if figure.target is None else f"{figure.better} {figure.target:g}: {figure.met}"
        print(f"{figure.name:60s} {figure.value:10.3f} {figure.unit:8s} {target}")
    rows = [{"name": f.name, "value": f.value, "unit": f.unit, "target": f.target, "met": f.met} for f in figures]
    (given.out / "ingest.json").write_text(json.dumps(rows, indent=2) + "\n")
    return 0 if all(figure.met is not False for figure in figures) else 1


if __name__ == "__main__":
    sys.exit(main())
