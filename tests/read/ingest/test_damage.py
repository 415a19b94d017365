"""Damaged logs: one clear error, or a correct part of the log. Never a wrong number."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import lz4.frame
import polars as pl
import pytest
import zstandard
from polars.testing import assert_frame_equal

from pipeline.read.ingest import read_run
from schemas.config import IngestConfig, StreamMapping
from schemas.errors import InputError
from tests.read.ingest import samples
from tests.read.ingest.samples import (
    START_NS,
    channel,
    chunk,
    data_end,
    definitions,
    footer,
    header,
    message,
    message_index,
    position,
    record,
    schema,
    some_messages,
    text,
    whole,
)

CONFIG = IngestConfig()


def read(tmp_path, content: bytes, config: IngestConfig = CONFIG):
    return read_run(samples.save(tmp_path, content), config)


def refused(tmp_path, content: bytes, config: IngestConfig = CONFIG) -> str:
    with pytest.raises(InputError) as caught:
        read(tmp_path, content, config)
    assert "run.mcap" in str(caught.value)
    return str(caught.value)


def test_hand_made_file_reads(tmp_path):
    log = read(tmp_path, whole(definitions(), some_messages()))
    assert log.gnss["latitude_deg"].to_list() == [50.0, 50.001, 50.002]
    assert log.gnss["t"].to_physical().to_list() == [(1_700_000_000 + n) * 10**9 for n in range(3)]
    assert log.notes.partial_until_ns is None
    assert log.notes.chunks_without_crc == 1


def test_chunk_and_loose_messages_mix(tmp_path):
    inner = definitions() + some_messages(2)
    log = read(tmp_path, whole(chunk(inner), message(position(2)), chunk(message(position(3)))))
    assert log.gnss["latitude_deg"].to_list() == [50.0, 50.001, 50.002, 50.003]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "empty"),
        (b"not an mcap file at all", "does not start"),
        (samples.MAGIC, "cut off"),
        (samples.MAGIC[:5], "cut off"),
        (samples.MAGIC + header(), "cut off"),
        (samples.MAGIC + data_end() + footer() + samples.MAGIC, "not a Header"),
        (whole(), "no GNSS"),
        (whole(definitions(), some_messages()) + b"junk", "after the end of the file"),
        (whole(definitions(), some_messages()) * 2, "two files"),
        (whole(definitions(), record(0x00, b"ab")), "opcode 0"),
        (whole(definitions(), some_messages(), footer()), "FOOTER record is not allowed in the data"),
        (whole(schema(), channel(), record(0x05, b"\x01\x00")), "shorter than its header"),
        (whole(channel(), some_messages()), "schema 1 of topic /gnss is missing"),
        (whole(definitions(), message(position(), channel_id=7)), "unknown channel 7"),
        (whole(schema(), channel(topic=b"\xff\xfe"), some_messages()), "not UTF-8"),
        (whole(definitions(), channel(topic="/other"), some_messages()), "defined twice"),
        (whole(definitions(), schema(name="other"), some_messages()), "defined twice"),
        (whole(schema(schema_id=0), some_messages()), "id 0"),
        (whole(definitions(), message_index(1, [(0, 0)])), "does not follow a chunk"),
        (whole(definitions(), some_messages())[:-8] + b"\x89MCAP1\r\n", "magic bytes at the end"),
    ],
)
def test_structure(tmp_path, content, says):
    assert says in refused(tmp_path, content)


def test_lengths_past_their_parent(tmp_path):
    good = definitions() + some_messages()
    at = len(definitions()) + len(message(position(0)))
    longer = bytearray(good)
    longer[at + 1 : at + 9] = struct.pack("<Q", 10**6)
    assert "past the end of its chunk" in refused(tmp_path, whole(chunk(bytes(longer))))
    assert "cut off by the end of its chunk" in refused(tmp_path, whole(chunk(good + b"\x05\x01")))
    huge = record(0x03, struct.pack("<H", 1) + struct.pack("<I", 2**31) + b"abc")
    assert "past the end of its Schema" in refused(tmp_path, whole(huge))
    attachment = record(0x09, struct.pack("<QQ", 0, 0) + text("a") + text("b") + struct.pack("<Q", 2**62) + b"xyz1234")
    assert read(tmp_path, whole(definitions(), attachment, some_messages())).gnss.height == 3  # it is passed by
    terabyte = whole(definitions(), struct.pack("<BQ", 0x06, 2**40), some_messages())
    assert "past the end of the file" in refused(tmp_path, terabyte)


def test_chunk_checksum_and_size(tmp_path):
    good = definitions() + some_messages()
    assert "checksum" in refused(tmp_path, whole(chunk(good, crc=zlib.crc32(good) ^ 1)))
    assert "declares" in refused(tmp_path, whole(chunk(good, size=len(good) + 1)))
    assert "unknown compression" in refused(tmp_path, whole(chunk(good, compression="brotli")))
    assert read(tmp_path, whole(chunk(good, crc=0))).notes.chunks_without_crc == 1


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [100, 2**20, 2**27, 2**40, 2**63])
def test_decompression_bombs(tmp_path, compression, declared):
    bomb = zstandard.compress(bytes(2**27 + 1)) if compression == "zstd" else lz4.frame.compress(bytes(2**27 + 1))
    content = whole(definitions(), chunk(b"", compression=compression, packed=bomb, size=declared, crc=0))
    path = samples.save(tmp_path, content)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="chunk"):
            read_run(path, CONFIG)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # A chunk may declare up to the limit of 128 MiB, which is then its room and no more.
    assert peak < (2**27 + 30e6 if declared == 2**27 else 30e6)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_false_sizes_of_compressed_chunks(tmp_path, compression):
    good = definitions() + some_messages()
    packed = zstandard.compress(good) if compression == "zstd" else lz4.frame.compress(good, store_size=False)
    assert read(tmp_path, whole(chunk(good, compression, packed=packed))).gnss.height == 3
    for size in (0, 1, len(good) - 1, len(good) + 1, 2 * len(good)):
        for crc in (0, None):
            refused(tmp_path, whole(chunk(good, compression, crc=crc, size=size, packed=packed)))
    for broken in (packed[:-1], packed + b"x", packed + packed):
        refused(tmp_path, whole(chunk(good, compression, crc=0, packed=broken)))


def test_message_indexes(tmp_path):
    good = definitions() + some_messages()
    start = len(definitions())
    size = len(message(position(0)))
    offsets = [start]
    for number in range(2):
        offsets.append(offsets[-1] + len(message(position(number))))
    assert size > 0
    entries = [(START_NS + number, offset) for number, offset in enumerate(offsets)]
    expected = read(tmp_path, whole(chunk(good))).gnss
    for index in (entries, [], entries[::-1]):
        log = read(tmp_path, whole(chunk(good), message_index(1, index)))
        assert_frame_equal(log.gnss, expected, check_exact=True)
    assert "disagrees" in refused(tmp_path, whole(chunk(good), message_index(1, entries[:2])))
    assert "disagrees" in refused(tmp_path, whole(chunk(good), message_index(1, [*entries, entries[0]])))
    assert "disagrees" in refused(tmp_path, whole(chunk(good), message_index(1, [(5, offsets[0])])))
    assert "disagrees" in refused(tmp_path, whole(chunk(good), message_index(2, entries)))
    assert "disagrees" in refused(tmp_path, whole(chunk(good), message_index(1, [(START_NS, start + 1)])))
    for outside in (len(good), 2**40, 2**63, 2**64 - 1):
        assert "disagrees" in refused(tmp_path, whole(chunk(good), message_index(1, [(START_NS, outside)])))


def test_unknown_opcodes_are_skipped(tmp_path):
    log = read(
        tmp_path,
        whole(record(0x80, b"private"), definitions(), record(0x42, b""), chunk(record(0x90, b"z") + some_messages())),
    )
    assert log.gnss.height == 3


def test_one_topic_on_several_channels(tmp_path):
    content = whole(
        definitions(), channel(2), message(position(0)), message(position(1), channel_id=2), message(position(2))
    )
    log = read(tmp_path, content)
    assert log.gnss["latitude_deg"].to_list() == [50.0, 50.001, 50.002]
    assert log.gnss["solution"].unique().to_list() == ["primary"]


@pytest.mark.parametrize(
    "payload",
    [
        b'{"t":{"sec":1,"nsec":0},"latitude_deg":NaN,"longitude_deg":4,"fix":"sbas"}',
        b"",
        b" ",
        b"[]",
        b"{} {}",
        b'{"a":',
        b"\xff\xfe",
    ],
)
def test_bad_json(tmp_path, payload):
    content = whole(definitions(), some_messages(), message(payload), some_messages())
    assert "/gnss" in refused(tmp_path, content)


def test_json_with_line_breaks_and_missing_keys(tmp_path):
    pretty = position(1).replace(b", ", b",\n  ")
    log = read(tmp_path, whole(definitions(), message(position(0)), message(pretty), message(position(2, height_m=7))))
    assert log.gnss["latitude_deg"].to_list() == [50.0, 50.001, 50.002]
    assert log.gnss["height_m"].to_list() == [None, None, 7.0]
    assert "null in row 1" in refused(
        tmp_path, whole(definitions(), message(position(0)), message(position(1, fix=None)))
    )


def damaged_summary(content: bytes, opcode: int, change) -> bytes:
    """Every record of an opcode passed through `change`, the file's checksums taken off."""
    out, at = samples.MAGIC, 8
    while at < len(content) - 8:
        found, length = struct.unpack_from("<BQ", content, at)
        whole_record = content[at : at + 9 + length]
        if found == 0x02:
            whole_record = whole_record[:-4] + bytes(4)
        out += change(whole_record) if found == opcode else whole_record
        at += 9 + length
    return out + samples.MAGIC


@pytest.mark.parametrize(
    ("opcode", "change", "says"),
    [
        (0x0B, lambda r: r[:9] + struct.pack("<Q", 5) + r[17:], "statistics"),
        (0x08, lambda r: r + r, "chunk index"),
        (0x08, lambda r: r[:25] + struct.pack("<Q", 1) + r[33:], "chunk index"),
        (0x08, lambda r: r[:33] + struct.pack("<Q", 1) + r[41:], "chunk index"),
    ],
)
def test_wrong_summary(tmp_path, opcode, change, says):
    assert says in refused(tmp_path, damaged_summary(samples.log_bytes(), opcode, change))


def test_incomplete_chunk_index(tmp_path):
    dropped = []

    def drop_first(whole_record: bytes) -> bytes:
        dropped.append(1)
        return b"" if len(dropped) == 1 else whole_record

    assert "chunk index" in refused(tmp_path, damaged_summary(samples.log_bytes(), 0x08, drop_first))


def test_no_chunk_index_at_all_is_fine(tmp_path):
    content = damaged_summary(samples.log_bytes(), 0x08, lambda r: b"")
    assert read(tmp_path, content).gnss.height == 40


def test_lost_chunk_is_noticed(tmp_path):
    lost = []

    def drop_second(whole_record: bytes) -> bytes:
        lost.append(1)
        return record(0x70, whole_record) if len(lost) == 2 else whole_record

    refused(tmp_path, damaged_summary(samples.log_bytes(), 0x06, drop_second))


def test_data_section_checksum(tmp_path):
    import io

    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream, enable_data_crcs=True, use_chunking=False)
    writer.start()
    writer.register_schema("balise.Gnss", "jsonschema", b"{}")
    writer.register_channel("/gnss", "json", 1)
    for number in range(3):
        writer.add_message(1, START_NS + number, position(number), START_NS)
    writer.finish()
    content = bytearray(stream.getvalue())
    crc_at = content.index(struct.pack("<BQ", 0x0F, 4)) + 9
    if struct.unpack_from("<I", content, crc_at)[0] == 0:  # the writer counts what it has flushed only
        struct.pack_into("<I", content, crc_at, zlib.crc32(content[: crc_at - 9]))
    assert read(tmp_path, bytes(content)).gnss.height == 3
    at = content.index(b"50.001") + 5
    content[at] = ord("2")
    assert "checksum of the data section" in refused(tmp_path, bytes(content))


@pytest.mark.parametrize(
    ("encoding", "chunk_size"), [("cdr", 1500), ("protobuf", None), ("json", 1500), ("json", None)]
)
def test_cut_anywhere(tmp_path, encoding, chunk_size):
    """Cut at any byte: nothing readable, or the first rows exactly, said to be partial."""
    content = samples.log_bytes(samples.run(12), encoding=encoding, chunk_size=chunk_size)
    log = read(tmp_path, content)
    assert log.notes.partial_until_ns is None
    heights = set()
    for end in [*range(0, len(content), 97), *range(len(content) - 40, len(content), 3)]:
        path = samples.save(tmp_path, content[:end])
        try:
            part = read_run(path, CONFIG)
        except InputError:
            continue
        rows = part.gnss.height
        heights.add(rows)
        assert_frame_equal(part.gnss, log.gnss.head(rows), check_exact=True)
        if part.odometer is not None:
            assert_frame_equal(part.odometer, log.odometer.head(part.odometer.height), check_exact=True)
        assert part.notes.partial_until_ns == part.gnss["t"].to_physical()[-1]
        assert "cut off at byte" in part.notes.damage
    assert len(heights) > 2
    assert 12 in heights


def test_space_that_was_never_written(tmp_path):
    """File systems leave zeros where a recorder lost power."""
    content = samples.log_bytes(samples.run(12), chunk_size=None)
    part = read(tmp_path, content[: len(content) // 2] + bytes(10_000))
    assert 0 < part.gnss.height < 12
    assert part.notes.partial_until_ns is not None


@pytest.mark.parametrize("encoding", ["cdr", "protobuf", "json"])
def test_bit_flips_are_found(tmp_path, encoding):
    """With checksums every flipped bit is an error, or touches nothing that is read."""
    for compression in ("zstd", "none"):
        content = samples.log_bytes(samples.run(6), encoding=encoding, compression=compression)
        expected = read(tmp_path, content)
        for at in range(8, len(content), 53):
            flipped = bytearray(content)
            flipped[at] ^= 1 << (at % 8)
            path = samples.save(tmp_path, bytes(flipped))
            try:
                log = read_run(path, CONFIG)
            except InputError:
                continue
            if log.notes.partial_until_ns is None:
                assert_frame_equal(log.gnss, expected.gnss, check_exact=True)
                assert_frame_equal(log.odometer, expected.odometer, check_exact=True)


def test_big_endian_and_parameter_list_cdr(tmp_path):
    little = samples.log_bytes(compression="none", chunk_size=None, checksums=False)
    twist = IngestConfig(odometer=(StreamMapping(topic="/odometer"),))
    expected = read(tmp_path, little, twist)
    from tests.read.ingest.oracle import with_payloads

    big = with_payloads(little, "/odometer", big_endian_twist)
    assert_frame_equal(read(tmp_path, big, twist).odometer, expected.odometer, check_exact=True)
    listed = with_payloads(little, "/odometer", lambda payload: b"\x00\x03" + payload[2:])
    assert "0x0003" in refused(tmp_path, listed, twist)
    short = with_payloads(little, "/odometer", lambda payload: payload[:-9])
    assert "/odometer" in refused(tmp_path, short, twist)


def big_endian_twist(payload: bytes) -> bytes:
    sec, nsec, length = struct.unpack_from("<iII", payload, 4)
    rest = 16 + length
    rest += -(rest - 4) % 8
    values = struct.unpack_from("<6d", payload, rest)
    return b"\x00\x00\x00\x00" + struct.pack(">iII", sec, nsec, length) + payload[16:rest] + struct.pack(">6d", *values)


def test_no_gnss_names_what_there_is(tmp_path):
    content = whole(schema(name="sensor_msgs/msg/Imu"), channel(topic="/imu"), message(b"{}"))
    assert "/imu" in refused(tmp_path, content)


def test_frames_are_typed_even_when_cut(tmp_path):
    content = samples.log_bytes(samples.run(12))
    part = read(tmp_path, content[: int(len(content) * 0.6)])
    assert part.gnss.schema["t"] == pl.Datetime("ns", "UTC")
