"""Small runs and hand-made MCAP files for the tests of ingest."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import polars as pl

from datasets import mcap_messages
from datasets.mcap_log import write_mcap
from pipeline.read.ingest.conform import conform
from pipeline.show.export.position_messages import NAVSATFIX, NAVSATFIX_DEFINITION
from schemas.run import RunLog, Stream

DEFINITIONS = mcap_messages.DEFINITIONS | {NAVSATFIX: NAVSATFIX_DEFINITION}

START_NS = 1_700_000_000_000_000_000
MAGIC = b"\x89MCAP0\r\n"


def times(count: int, step_ns: int = 100_000_000, start_ns: int = START_NS) -> pl.Series:
    return pl.Series(start_ns + np.arange(count, dtype=np.int64) * step_ns).cast(pl.Datetime("ns", "UTC"))


def conformed(frame: pl.DataFrame, stream: Stream) -> pl.DataFrame:
    breaches: list = []
    result = conform(frame, stream, "sample", breaches)
    assert not breaches
    return result


def gnss(count: int = 40, seed: int = 1) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    frame = pl.DataFrame(
        {
            "t": times(count),
            "latitude_deg": 50.0 + rng.uniform(0, 1, count),
            "longitude_deg": 4.0 + rng.uniform(0, 1, count),
            "height_m": rng.uniform(50, 100, count),
            "fix": ["autonomous"] * count,
            **{f"cov_{axes}_m2": rng.uniform(0.1, 2.0, count) for axes in ("ee", "en", "eu", "nn", "nu", "uu")},
        }
    )
    return conformed(frame, "gnss")


def odometer(count: int = 80, seed: int = 2) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    frame = pl.DataFrame({"t": times(count, 50_000_000), "speed_mps": rng.normal(20, 1, count)})
    return conformed(frame, "odometer")


def run(count: int = 40) -> RunLog:
    return RunLog("sample", gnss(count), odometer(2 * count))


def log_bytes(sample: RunLog | None = None, encoding="cdr", compression="zstd", chunk_size=1500, **kwargs) -> bytes:
    stream = io.BytesIO()
    write_mcap(sample or run(), stream, encoding, compression, chunk_size, **kwargs)
    return stream.getvalue()


def save(folder: Path, content: bytes, name: str = "run.mcap") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


# MCAP records by hand, so that the tests do not depend on what they test.


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str | bytes) -> bytes:
    content = value if isinstance(value, bytes) else value.encode()
    return struct.pack("<I", len(content)) + content


def header() -> bytes:
    return record(0x01, text("") + text("test"))


def schema(schema_id: int = 1, name: str = "balise.Gnss", encoding: str = "jsonschema", data: bytes = b"{}") -> bytes:
    return record(
        0x03, struct.pack("<H", schema_id) + text(name) + text(encoding) + struct.pack("<I", len(data)) + data
    )


def channel(channel_id: int = 1, schema_id: int = 1, topic: str | bytes = "/gnss", encoding: str = "json") -> bytes:
    return record(0x04, struct.pack("<HH", channel_id, schema_id) + text(topic) + text(encoding) + struct.pack("<I", 0))


def message(payload: bytes, t_ns: int = START_NS, channel_id: int = 1, sequence: int = 0) -> bytes:
    return record(0x05, struct.pack("<HIQQ", channel_id, sequence, t_ns, t_ns) + payload)


def position(number: int = 0, **fields: object) -> bytes:
    """A JSON payload of this project's GNSS message."""
    import json

    values = {
        "t": {"sec": 1_700_000_000 + number, "nsec": 0},
        "latitude_deg": 50.0 + number / 1000,
        "longitude_deg": 4.0,
        "fix": "sbas",
    }
    return json.dumps({key: value for key, value in (values | fields).items() if value is not None}).encode()


def chunk(
    records: bytes, compression: str = "", crc: int | None = None, size: int | None = None, packed: bytes | None = None
) -> bytes:
    data = packed if packed is not None else records
    body = struct.pack(
        "<QQQI", START_NS, START_NS, len(records) if size is None else size, zlib.crc32(records) if crc is None else crc
    )
    return record(0x06, body + text(compression) + struct.pack("<Q", len(data)) + data)


def message_index(channel_id: int, entries: list[tuple[int, int]]) -> bytes:
    packed = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return record(0x07, struct.pack("<HI", channel_id, len(packed)) + packed)


def data_end(crc: int = 0) -> bytes:
    return record(0x0F, struct.pack("<I", crc))


def footer(summary_start: int = 0, crc: int = 0) -> bytes:
    return record(0x02, struct.pack("<QQI", summary_start, 0, crc))


def whole(*records: bytes) -> bytes:
    """A file without summary."""
    return MAGIC + header() + b"".join(records) + data_end() + footer() + MAGIC


def definitions() -> bytes:
    return schema() + channel()


def some_messages(count: int = 3) -> bytes:
    return b"".join(message(position(number), START_NS + number) for number in range(count))
