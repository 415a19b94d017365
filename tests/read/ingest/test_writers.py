"""Habits of other programs that write MCAP: what the format allows is read, what nobody can mean is one error."""

from __future__ import annotations

import json
import struct
import zlib

import pytest

from pipeline.read.ingest import read_run
from pipeline.read.ingest.describe import describe_log
from pipeline.show.export.position_messages import navsatfix_topic
from schemas.config import Configuration, IngestConfig, settings_from
from schemas.errors import ConfigError, InputError
from schemas.inputs import STREAM_SCHEMAS
from schemas.run import Stream
from tests.read.ingest import samples
from tests.read.ingest.samples import (
    DEFINITIONS,
    MAGIC,
    START_NS,
    channel,
    chunk,
    data_end,
    definitions,
    footer,
    header,
    message,
    position,
    record,
    schema,
    some_messages,
    whole,
)

CONFIG = IngestConfig()
SECOND = 10**9


def read(tmp_path, content: bytes, config: IngestConfig = CONFIG):
    return read_run(samples.save(tmp_path, content), config)


def location(number: int, **fields: object) -> bytes:
    stamp = {"sec": START_NS // SECOND + number, "nsec": 0}
    place = {"timestamp": stamp, "latitude": 50.0, "longitude": 4.0, "altitude": 100.0}
    return json.dumps(place | fields).encode()


def locations(*payloads: bytes) -> bytes:
    found = [message(payload, START_NS + number * SECOND) for number, payload in enumerate(payloads)]
    return whole(schema(1, "foxglove.LocationFix"), channel(1, 1, "/fix"), *found)


def bare_chunks(covered: bool) -> tuple[bytes, bytes]:
    """Chunks without checksums under a checksum of the data section, with or without their contents; and that part."""
    parts = [definitions() + some_messages(2), message(position(2), START_NS + 2)]
    data, summed = MAGIC + header(), MAGIC + header()
    for records in parts:
        written = chunk(records, crc=0)
        data += written
        summed += written if covered else written[: -len(records)]
    return data + data_end(zlib.crc32(summed)) + footer() + MAGIC, parts[0]


@pytest.mark.parametrize("covered", [True, False])
def test_a_checksum_of_the_data_may_leave_out_chunks_without_their_own(tmp_path, covered):
    content, _ = bare_chunks(covered)
    run = read(tmp_path, content)
    assert run.gnss.height == 3
    assert run.notes.chunks_without_crc == (0 if covered else 2)


def test_it_still_finds_damage_in_what_it_covers(tmp_path):
    content, inside = bare_chunks(covered=True)
    at = content.index(inside) + inside.index(b"50.001")
    with pytest.raises(InputError, match="checksum of the data section"):
        read(tmp_path, content[:at] + b"50.002" + content[at + 6 :])
    content, _ = bare_chunks(covered=False)
    start_of_chunk = content.index(struct.pack("<QQ", START_NS, START_NS))
    with pytest.raises(InputError, match="checksum of the data section"):
        read(tmp_path, content[:start_of_chunk] + b"\1" + content[start_of_chunk + 1 :])


@pytest.mark.parametrize("stated_ns", [0, 1, 2])
def test_a_first_time_of_zero_is_taken_whether_or_not_the_log_says_so(tmp_path, stated_ns):
    data = MAGIC + header() + definitions() + b"".join(message(position(n), n) for n in range(3)) + data_end()
    counts = struct.pack("<IHQ", 10, 1, 3)
    statistics = record(0x0B, struct.pack("<QHIIIIQQ", 3, 1, 1, 0, 0, 0, stated_ns, 2) + counts)
    assert read(tmp_path, data + statistics + footer(len(data)) + MAGIC).gnss.height == 3


def test_another_time_than_the_first_is_damage(tmp_path):
    data = MAGIC + header() + definitions() + b"".join(message(position(n), 5 + n) for n in range(3)) + data_end()
    statistics = record(0x0B, struct.pack("<QHIIIIQQI", 3, 1, 1, 0, 0, 0, 6, 7, 0))
    with pytest.raises(InputError, match="the statistics record gives"):
        read(tmp_path, data + statistics + footer(len(data)) + MAGIC)


def test_stamps_that_were_never_set_are_no_times(tmp_path):
    zero = {"sec": 0, "nsec": 0}
    early = locations(*(location(n, timestamp=zero) for n in range(2)), *(location(n) for n in range(2, 5)))
    run = read(tmp_path, early)
    assert (run.gnss.height, run.gnss["t"].dt.year().to_list()) == (3, [2023] * 3)
    assert run.notes.skipped_topics == ("/fix: 2 messages with a stamp of 0",)
    never = locations(*(location(n, timestamp=zero) for n in range(3)))
    with pytest.raises(InputError, match=r'/fix: has no time of validity.*time stamp 0.*time = "log"'):
        read(tmp_path, never)
    mapped = settings_from({"ingest": {"gnss": {"topic": "/fix", "time": "log"}}}, Configuration, "x").ingest
    assert read(tmp_path, never, mapped).gnss["t"].dt.year().to_list() == [2023] * 3


def test_velocity_and_unknown_height_of_a_location_fix(tmp_path):
    velocity = {"velocity": {"x": 1.0, "y": 2.0, "z": 3.0}, "heading": 0.5}
    run = read(tmp_path, locations(location(0, **velocity), location(1, altitude=None), location(2)))
    assert run.gnss.select("vel_e_mps", "vel_n_mps", "vel_u_mps").rows() == [(1.0, 2.0, 3.0)] + [(None,) * 3] * 2
    assert run.gnss["height_m"].to_list() == [100.0, None, 100.0]


def test_a_variance_that_a_driver_does_not_know_is_null(tmp_path):
    payloads = []
    for payload in navsatfix_topic("/fix", samples.gnss(3), "gps").messages:
        # The last variance of nine stands before the type.
        payloads.append(payload[:-9] + struct.pack("<d", float("nan")) + payload[-1:])
    name = "sensor_msgs/msg/NavSatFix"
    log = [schema(1, name, "ros2msg", DEFINITIONS[name].encode()), channel(1, 1, "/fix", "cdr")]
    run = read(tmp_path, whole(*log, *(message(payload) for payload in payloads)))
    assert run.gnss["cov_uu_m2"].null_count() == 3
    assert run.gnss["cov_nn_m2"].to_list() == samples.gnss(3)["cov_nn_m2"].to_list()


def test_lines_of_a_definition_may_end_as_on_windows(tmp_path):
    name = "sensor_msgs/msg/NavSatFix"
    text = DEFINITIONS[name].replace("\n", "\r\n").encode()
    log = [schema(1, name, "ros2msg", text), channel(1, 1, "/fix", "cdr")]
    run = read(
        tmp_path,
        whole(*log, *(message(payload) for payload in navsatfix_topic("/fix", samples.gnss(3), "gps").messages)),
    )
    assert (run.gnss.height, run.notes.slow_path_messages) == (3, 0)


def mapped(**mapping: object) -> IngestConfig:
    fields = {"latitude_deg": "lat", "longitude_deg": "lon", "fix": "q"}
    return settings_from({"ingest": {"gnss": {"topic": "/x", "fields": fields} | mapping}}, Configuration, "x").ingest


def quality(*values: object) -> bytes:
    found = [message(json.dumps({"lat": 50.0, "lon": 4.0, "q": value}).encode()) for value in values]
    return whole(channel(1, 0, "/x"), *found)


def test_codes_of_the_fix_may_be_texts(tmp_path):
    config = mapped(fix_codes={"RTK": "rtk_fixed", "3D": "autonomous"})
    assert read(tmp_path, quality("3D", "RTK", "3D"), config).gnss["fix"].to_list() == [
        "autonomous", "rtk_fixed", "autonomous",
    ]  # fmt: skip
    digits = mapped(fix_codes={"4": "rtk_fixed"})
    assert read(tmp_path, quality("4"), digits).gnss["fix"].to_list() == ["rtk_fixed"]
    with pytest.raises(InputError, match=r"column fix.*'code 2D'"):
        read(tmp_path, quality("3D", "2D"), config)
    assert describe_log(tmp_path / "run.mcap", config).problems


def test_a_constant_that_its_column_cannot_hold_is_an_error_of_the_configuration(tmp_path):
    with pytest.raises(ConfigError, match=r"constants.height_m: .*found 'abc'"):
        read(tmp_path, quality("sbas"), mapped(constants={"height_m": "abc"}))
    with pytest.raises(ConfigError, match=r"constants.solution: .*found True"):
        read(tmp_path, quality("sbas"), mapped(constants={"solution": True}))


def implicit_protobuf(stream: Stream, rows: list[dict[str, object]], without: str = "") -> bytes:
    """This project's message by a writer whose fields are not `optional`: what it does not set has its default."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    from pipeline.show.export.messages import descriptor, fields_of

    name = f"balise.{stream.capitalize()}"
    files = FileDescriptorSet.FromString(descriptor(name, fields_of(STREAM_SCHEMAS[stream].create_empty())))
    message_type = files.file[-1].message_type[0]
    del message_type.oneof_decl[:]
    for field in [field for field in message_type.field if field.name == without]:
        message_type.field.remove(field)
    for field in message_type.field:
        field.ClearField("oneof_index")
        field.ClearField("proto3_optional")
    pool = DescriptorPool()
    for file in files.file:
        pool.Add(file)
    kind = GetMessageClass(pool.FindMessageTypeByName(name))
    records = b""
    for number, values in enumerate(rows):
        written = kind(**values)
        written.t.seconds = START_NS // SECOND + number
        records += message(written.SerializeToString(), channel_id=1 if stream == "gnss" else 2)
    own = 1 if stream == "gnss" else 2
    return (
        schema(own, name, "protobuf", files.SerializeToString()) + channel(own, own, f"/{stream}", "protobuf") + records
    )


def test_what_a_writer_without_presence_never_sets_is_not_known(tmp_path):
    fixes = [
        {"latitude_deg": 50.0, "longitude_deg": 4.0, "fix": "sbas", "vel_e_mps": v, "hpl_m": v} for v in (0.0, 2.0)
    ]
    wheels = [{"distance_m": 1.0}, {"distance_m": 2.0}]
    run = read(tmp_path, whole(implicit_protobuf("gnss", fixes), implicit_protobuf("odometer", wheels)))
    known = [name for name in run.gnss.columns if run.gnss[name].null_count() < 2]
    assert known == ["t", "solution", "latitude_deg", "longitude_deg", "vel_e_mps", "hpl_m", "fix"]
    assert run.gnss.select("solution", "vel_e_mps", "hpl_m").rows() == [("primary", 0.0, None), ("primary", 2.0, 2.0)]
    assert run.odometer.select("distance_m", "speed_mps").rows() == [(1.0, None), (2.0, None)]
    standing = whole(implicit_protobuf("gnss", fixes), implicit_protobuf("odometer", [{}, {}]))
    assert read(tmp_path, standing).odometer.select("distance_m", "speed_mps").rows() == [(None, 0.0)] * 2


@pytest.mark.parametrize("without", ["", "distance_m"])
def test_a_train_that_stands_all_the_time_has_a_speed(tmp_path, without):
    fixes = implicit_protobuf("gnss", [{"latitude_deg": 50.0, "longitude_deg": 4.0, "fix": "sbas"}] * 2)
    run = read(tmp_path, whole(fixes, implicit_protobuf("odometer", [{}, {}], without)))
    assert run.odometer.select("distance_m", "speed_mps").rows() == [(None, 0.0)] * 2
