"""Ids are names: 7, 007 and "007" as they are written, in whatever a log holds them."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import polars as pl
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from pipeline.make.receivers import convert
from pipeline.read.ingest import read_run
from pipeline.read.site.read import read_site
from schemas.config import Configuration, IngestConfig, settings_from
from tests.read.ingest import samples
from tests.read.ingest.samples import START_NS, channel, message, position, schema, whole

FIELDS = {"balise_id": "id"}


def config(**streams: object) -> IngestConfig:
    return settings_from({"ingest": streams}, Configuration, "mapping").ingest


def log_of(tmp_path: Path, name: str, encoding: tuple[str, str, bytes], *payloads: bytes) -> Path:
    """A log of two positions and messages of another topic, a nanosecond apart."""
    message_encoding, schema_encoding, definition = encoding
    read = [message(payload, START_NS + number, 2) for number, payload in enumerate(payloads)]
    definitions = schema(1) + channel(1, 1, "/gnss") + schema(2, name, schema_encoding, definition)
    content = whole(
        definitions,
        channel(2, 2, "/rfid", message_encoding),
        message(position(0)),
        message(position(1), START_NS + 1),
        *read,
    )
    return samples.save(tmp_path, content)


def ids_of(path: Path, mapping: IngestConfig) -> list[str]:
    reads = read_run(path, mapping).balise_reads
    assert reads is not None
    return reads["balise_id"].to_list()


def test_a_table(tmp_path: Path) -> None:
    positions, reads = tmp_path / "pos.csv", tmp_path / "reads.csv"
    positions.write_text("t,lat,lon\n2025-03-03T08:00:00Z,50.1,14.1\n2025-03-03T08:00:01Z,50.1,14.1\n")
    reads.write_text("t,id,sensor\n2025-03-03T08:00:00Z,007,1\n2025-03-03T08:00:01Z,,2\n2025-03-03T08:00:01Z,12,3\n")
    mapping = config(
        gnss={"topic": "pos.csv", "time": "field:t", "fields": {"latitude_deg": "lat", "longitude_deg": "lon"}},
        balise_reads={"topic": "reads.csv", "time": "field:t", "fields": FIELDS},
    )
    run = convert([positions, reads], "r", mapping).run
    assert run.balise_reads is not None
    assert run.balise_reads["balise_id"].to_list() == ["007", "12"]


@pytest.mark.parametrize("dtype", [pl.Int64, pl.UInt32, pl.UInt64, pl.Categorical, pl.String])
def test_a_run(tmp_path: Path, dtype: pl.DataType) -> None:
    samples.gnss(10).write_parquet(tmp_path / "gnss.parquet")
    reads = pl.DataFrame({"t": samples.times(2), "balise_id": pl.Series(["7", "12"]).cast(dtype)})
    reads.write_parquet(tmp_path / "balise_reads.parquet")
    assert ids_of(tmp_path, IngestConfig()) == ["7", "12"]


def test_json(tmp_path: Path) -> None:
    texts = [json.dumps({"t": {"sec": 1_700_000_000, "nsec": 0}, "balise_id": name}) for name in (7, "012", 2**63)]
    own = log_of(tmp_path, "balise.BaliseReads", ("json", "jsonschema", b"{}"), *map(str.encode, texts))
    assert ids_of(own, IngestConfig()) == ["7", "012", "9223372036854775808"]
    mapping = config(balise_reads={"topic": "/rfid", "time": "log", "fields": {"balise_id": "balise_id"}})
    other = log_of(tmp_path, "x.Y", ("json", "jsonschema", b"{}"), *map(str.encode, texts))
    assert ids_of(other, mapping) == ["7", "012", "9223372036854775808"]


def test_ros(tmp_path: Path) -> None:
    definition = ("cdr", "ros2msg", b"uint32 id\nuint64 stamp_ns\n")
    payloads = [b"\0\1\0\0" + struct.pack("<IxxxxQ", name, START_NS + name) for name in (7, 2**32 - 1)]
    log = log_of(tmp_path, "x/msg/Rfid", definition, *payloads)
    mapping = config(balise_reads={"topic": "/rfid", "time": "field:stamp_ns", "fields": FIELDS})
    assert ids_of(log, mapping) == ["7", "4294967295"]
    reads = read_run(log, mapping).balise_reads
    assert reads is not None
    assert reads["t"].to_physical().to_list() == [START_NS + 7, START_NS + 2**32 - 1]


def test_protobuf(tmp_path: Path) -> None:
    file = descriptor_pb2.FileDescriptorProto(name="r.proto", package="x", syntax="proto3")
    fields = file.message_type.add(name="Rfid").field
    fields.add(name="id", number=1, type=13, label=1)
    fields.add(name="stamp_ns", number=2, type=4, label=1)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("x.Rfid"))
    definition = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    payloads = [kind(id=name, stamp_ns=START_NS + name).SerializeToString() for name in (7, 300)]
    log = log_of(tmp_path, "x.Rfid", ("protobuf", "protobuf", definition), *payloads)
    mapping = config(balise_reads={"topic": "/rfid", "time": "field:stamp_ns", "fields": FIELDS})
    assert ids_of(log, mapping) == ["7", "300"]


def test_a_site(tmp_path: Path) -> None:
    text = tmp_path / "text"
    text.mkdir()
    (text / "track.csv").write_text(
        "netelement_id,measure_m,latitude_deg,longitude_deg\n007,0,50,14\n007,100,50.0009,14\n"
    )
    (text / "balises.csv").write_text("balise_id,netelement_id,measure_m,kind\n001,007,50,virtual\n")
    site = read_site(str(text))
    assert site.balises is not None
    assert (site.track["netelement_id"].to_list(), site.balises["balise_id"].to_list()) == (["007", "007"], ["001"])
    numbers = tmp_path / "numbers"
    numbers.mkdir()
    track = {"netelement_id": [7, 7], "measure_m": [0.0, 100.0], "latitude_deg": [50.0, 50.0009]}
    pl.DataFrame({**track, "longitude_deg": [14.0, 14.0]}).write_parquet(numbers / "track.parquet")
    balises = {"balise_id": [1], "netelement_id": [7], "measure_m": [50.0], "kind": ["virtual"]}
    pl.DataFrame(balises).write_parquet(numbers / "balises.parquet")
    site = read_site(str(numbers))
    assert site.balises is not None
    assert (site.track["netelement_id"].to_list(), site.balises["netelement_id"].to_list()) == (["7", "7"], ["7"])
