"""Small logs that ask for much: work and memory in proportion to the file, one error, never another instant."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import zstandard
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp
from pydantic import ValidationError

from pipeline.make.receivers import gather
from pipeline.read.ingest import mcap_block, read_run
from pipeline.read.ingest.correct import correct_run
from pipeline.read.ingest.describe import describe_log
from pipeline.read.ingest.layout import UndecodableError, constant, fixed, layout_of
from pipeline.read.ingest.layout_decoder import LayoutDecoder
from pipeline.read.ingest.mcap_records import Channel
from pipeline.read.ingest.protobuf import layout_by
from pipeline.read.ingest.ros_message import DefinitionError, Member, RosWalk, parse_definitions
from pipeline.stages.clean.clean import clean, without_undated_streams
from pipeline.storage.parquet import parquet_bytes
from schemas.config import IngestConfig, StreamCorrection
from schemas.errors import InputError
from tests.read.ingest import samples
from tests.read.ingest.samples import (
    START_NS,
    channel,
    chunk,
    definitions,
    message,
    position,
    record,
    schema,
    some_messages,
    whole,
)

SECOND_NS = 1_000_000_000


def packed(records: bytes) -> bytes:
    return chunk(records, "zstd", packed=zstandard.compress(records))


def numbered(count: int, kind: bytes) -> bytes:
    """A channel and a message for every number."""
    channels = (channel(number, topic=f"/{number}") for number in range(1, count))
    messages = (message(position(number), channel_id=number) for number in range(1, count))
    return whole(kind, *channels, packed(b"".join(messages)))


def bombs() -> dict[str, bytes]:
    """Logs of up to some 100 KB that would cost seconds or hundreds of megabytes."""
    empty = struct.pack("<BQ", 0x80, 0)
    return {
        "repeated definitions": whole(*[packed(definitions() * 100_000)] * 8),
        "records of no kind": whole(definitions(), *[packed(empty * 800_000)] * 8),
        "messages of nothing": whole(schema(name="x.Y"), channel(topic="/x"), *[packed(message(b"") * 250_000)] * 8),
        "a position of 100 MB": whole(definitions(), packed(message(b" " * 100_000_000))),
        "positions of 100 MB": whole(definitions(), packed(message(position(0) + b" " * 1_000_000) * 100)),
        "empty chunks": whole(definitions(), chunk(b"") * 20_000, some_messages()),
        "chunks without index": whole(definitions(), chunk(message(position(0))) * 10_000),
        "messages apart": whole(definitions(), (message(position(0)) + record(0x90, b"")) * 20_000),
        "channels": numbered(30_000, schema(name="x.Y")),
        "topics of positions": numbered(2000, schema()),
        "solutions": whole(
            definitions(), packed(b"".join(message(position(0, solution=f"{n}"), n) for n in range(60_000)))
        ),
    }


_SCRIPT = """
import resource, sys, time
from pathlib import Path
from pipeline.read.ingest import read_run
from pipeline.read.ingest.describe import describe_log
from schemas.config import IngestConfig, StreamCorrection
from schemas.errors import InputError

read_run(Path(sys.argv[1]), IngestConfig())
for name in sys.argv[2:]:
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from what is resident now
    rss = lambda word: int(Path("/proc/self/status").read_text().split(word + ":")[1].split()[0]) / 1024
    before, begin = rss("VmRSS"), time.process_time()
    try:
        read_run(Path(name), IngestConfig())
        outcome = "whole"
    except InputError as error:
        outcome = str(error).splitlines()[0][-400:]
    print(f"{time.process_time() - begin:.2f}|{rss('VmHWM') - before:.0f}|{Path(name).stem}|{outcome}")
"""


def test_small_logs_cost_neither_seconds_nor_hundreds_of_megabytes(tmp_path: Path) -> None:
    """Far above what they take (0.1 to 1 s, 10 to 200 MB); before, each took more than 5 s or 600 MB."""
    good = samples.save(tmp_path, whole(definitions(), some_messages()), "good.mcap")
    logs = [samples.save(tmp_path, content, f"{name}.mcap") for name, content in bombs().items()]
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT, good, *logs], check=True, capture_output=True, text=True, timeout=600
    )
    measured = [line.split("|") for line in done.stdout.splitlines()]
    assert len(measured) == len(logs)
    assert [row for row in measured if float(row[0]) > 4.0 or float(row[1]) > 300.0] == []
    outcomes = {row[2]: row[3] for row in measured}
    for name in ("repeated definitions", "records of no kind", "messages of nothing"):
        assert "a chunk unpacks to more records than the file has bytes" in outcomes[name]
    assert outcomes["empty chunks"] == "whole"
    assert outcomes["messages apart"] == "whole"
    assert outcomes["chunks without index"] == "whole"
    assert "more than 256 topics" in outcomes["topics of positions"]
    assert "found 60000; expected at most 256" in outcomes["solutions"]


def test_the_allowance_of_records_is_one_per_byte_of_the_file() -> None:
    spent = mcap_block.Allowance(3)
    records = definitions() + some_messages(1)
    (part,) = mcap_block.piece_of_chunk(records, 0, lambda *_: None, spent).parts.values()
    assert part.starts.tolist() == [len(definitions())]
    assert spent.left == 0
    with pytest.raises(mcap_block.DamageError, match="more records"):
        mcap_block.piece_of_chunk(records, 0, lambda *_: None, spent)


def test_chunks_unpack_to_so_many_times_the_size_of_their_log(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    other = struct.pack("<BQ", 0x90, 1_000_000) + bytes(1_000_000)
    path.write_bytes(whole(definitions(), *[packed(other * 30)] * 3, some_messages()))
    with pytest.raises(InputError, match=r"unpack to too many times.*unpacked_ratio_limit"):
        read_run(path, with_digest=False)
    assert read_run(path, IngestConfig(unpacked_ratio_limit=1e6), with_digest=False).gnss.height == 3


def test_more_rows_than_the_limit_are_not_read(tmp_path: Path) -> None:
    gnss = pl.DataFrame({"t": pl.Series([0], dtype=pl.Datetime("ns", "UTC")), "latitude_deg": [1.0]})
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "gnss.parquet").write_bytes(parquet_bytes(pl.concat([gnss] * 1000)))
    with pytest.raises(
        InputError, match=r"gnss\.parquet: has too many rows; found 1000; expected at most 999.*rows_limit"
    ):
        read_run(folder, IngestConfig(rows_limit=999))
    log = tmp_path / "run.mcap"
    log.write_bytes(whole(definitions(), some_messages()))
    with pytest.raises(InputError, match=r"gnss: has too many rows; found 3; expected at most 2"):
        read_run(log, IngestConfig(rows_limit=2))


def test_messages_found_by_indexes_are_those_that_a_walk_finds() -> None:
    """An index is only believed where all records from its first message to the end are as it tells."""
    records = definitions() + some_messages(3)
    allowance = mcap_block.Allowance(1000)

    def piece(entries: bytes) -> mcap_block.Piece:
        return mcap_block.piece_of_chunk(records, 0, lambda *_: None, allowance, [(1, memoryview(entries))])

    walked = mcap_block.piece_of_chunk(records, 0, lambda *_: None, allowance).parts[1]
    right = np.column_stack([walked.log_times, walked.starts]).tobytes()
    pairs = np.frombuffer(right, dtype="<i8").reshape(-1, 2)
    shifted, beyond, late = (pairs + np.array(change) for change in ([0, 1], [0, 1 << 40], [1, 0]))
    for entries in (right, b"", pairs[::-1].tobytes()):
        found = piece(entries).parts[1]
        for name in ("starts", "lengths", "log_times"):
            assert getattr(found, name).tolist() == getattr(walked, name).tolist()
    for entries in (right[16:], right[:-16], right + right[:16], *(a.tobytes() for a in (shifted, beyond, late))):
        with pytest.raises(mcap_block.DamageError, match="disagrees"):
            piece(entries)


def test_a_message_without_bytes_at_the_end_of_a_block_is_decoded() -> None:
    """A protobuf message is empty where all its fields have their defaults."""
    start, length, log_time = (np.array([number]) for number in (3, 0, 0))
    records = mcap_block.Records([np.frombuffer(b"abc", dtype=np.uint8)])
    message = mcap_block.Messages(records, start, length, log_time)
    fields = {"x": [constant(0.0, pl.Float64())]}
    channel = Channel(1, "/x", "protobuf", None, "x.mcap")
    decoder = LayoutDecoder(channel, lambda payload: layout_of(payload, bytearray(payload), fields))
    decoder.add(message)
    ((_, columns),) = decoder.decoded()
    assert list(columns["x"]) == [0.0]


def test_pieces_of_a_block_are_one_after_the_other() -> None:
    """Two chunks with a message each, and one without."""
    chunks = [definitions() + some_messages(1), definitions(), message(position(1), START_NS + 1)]
    pieces = [mcap_block.piece_of_chunk(chunk, 0, lambda *_: None, mcap_block.Allowance(9)) for chunk in chunks]
    ((channel_id, messages),) = mcap_block.block_of(pieces, before=100).items()
    assert channel_id == 1
    assert [messages.payload(row) for row in range(2)] == [position(0), position(1)]
    assert messages.stretches(0, 2).tobytes() == position(0)[:2] * 2
    assert messages.chosen(np.array([False, True])).log_time.tolist() == [START_NS + 1]
    second = len(chunks[0]) + len(chunks[1]) + 31
    assert messages.heads().ordinal.tolist() == [100 + len(definitions()) + 31, 100 + second]


def test_a_number_that_64_bits_with_a_sign_do_not_hold_is_refused() -> None:
    rows = np.array([1, 2**63], dtype="<u8").view(np.uint8).reshape(2, 8)
    whole, real = (fixed(0, "<u8").as_type(dtype) for dtype in (pl.Int64(), pl.Float64()))
    assert list(whole.values([rows[:1]])) == [1]
    assert list(real.values([rows])) == [1.0, 2.0**63]
    with pytest.raises(UndecodableError, match="larger"):
        whole.values([rows])
    written = np.array([9.0, 9.5]).view(np.uint8).reshape(2, 8)
    count = fixed(0, "<f8").as_type(pl.Int64())
    assert list(count.values([written[:1]])) == [9]
    with pytest.raises(UndecodableError, match="is not a 64-bit integer"):
        count.values([written])


LETTERS = "A" * 26


def test_definitions_are_read_in_linear_time() -> None:
    """A wrong letter in a constant took the stock parser 24 s, with 26 capitals more than 100 s."""
    assert parse_definitions("a/msg/B", f"int32 {LETTERS}a=3\nfloat64 x 1.5 # m")["a/B"] == (
        Member("x", "float64", None),
    )
    for line in (f"string {LETTERS}!", f"uint8 {LETTERS * 4000}! x", "x" + " " * 100_000 + "!", "=" * 100_000 + "x"):
        with pytest.raises(DefinitionError, match="is not understood"):
            parse_definitions("a/msg/B", line)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("C c\n===\nMSG: a/C\nfloat64 x\n===\nMSG: a/msg/C\nfloat32 x\n", "a/msg/C is defined twice"),
        ("float64 x\nfloat32 y\nfloat64 x\n", "a/msg/B names a field twice"),
    ],
)
def test_definitions_that_contradict_themselves_are_refused(text: str, reason: str) -> None:
    """Of two definitions of a header the last one counted: a latitude was read as 3e-319."""
    with pytest.raises(DefinitionError, match=reason):
        parse_definitions("a/msg/B", text)
    repeated = parse_definitions("a/msg/B", "C c" + "\n===\nMSG: a/C\nfloat64 x" * 2)
    assert repeated["a/C"] == (Member("x", "float64", None),)


@pytest.mark.parametrize("tag", [b"\x88\x80\x80\x80\x80\x00", b"\x88\x80\x80\x80\x10"], ids=["6 bytes", "bit 32"])
def test_a_protobuf_tag_has_32_bits(tag: bytes) -> None:
    layout = layout_by(Timestamp.DESCRIPTOR, {"seconds": pl.Int64()})
    assert layout(b"\x08\x05").fields["seconds"][0].start == 1
    with pytest.raises(DecodeError):
        Timestamp.FromString(tag + b"\x05")
    with pytest.raises(UndecodableError):
        layout(tag + b"\x05")


def test_a_pipe_is_refused_before_it_blocks(tmp_path: Path) -> None:
    for name in ("run.mcap", "run.ubx", "run.csv"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(InputError, match="is no regular file"):
            read_run(tmp_path / name) if name.endswith(".mcap") else gather([tmp_path / name])


def test_a_shift_that_64_bits_do_not_hold_is_refused() -> None:
    shift = StreamCorrection(stream="gnss", shift_s=8e9)
    with pytest.raises(InputError, match=r"after \[\[ingest.correct\]\]: column t: has missing values"):
        correct_run(samples.run(), [shift])
    with pytest.raises(ValidationError, match="less than or equal to 9000000000"):
        StreamCorrection(stream="gnss", shift_s=1e300)


def test_a_message_does_not_make_more_than_it_holds() -> None:
    definitions = parse_definitions("a/msg/B", "C[] c\nuint8[100000000] d\n===\nMSG: a/C\nC c\n")
    for payload in (b"\0\1\0\0" + b"\xff" * 4, b"\0\1\0\0" + bytes(4)):
        with pytest.raises(UndecodableError, match=r"too early|no definition"):
            RosWalk(payload, definitions, "a/B")


def log_of(tmp_path: Path, stamps: list[object], name: str = "t") -> Path:
    payloads = [position(number, **{name: stamp}) for number, stamp in enumerate(stamps)]
    messages = (message(payload, samples.START_NS + number) for number, payload in enumerate(payloads))
    return samples.save(tmp_path, whole(definitions(), *messages))


DATES = [
    {"sec": 20_166_000_000, "nsec": 0},  # 2609, which was read as 2025
    {"sec": 16_725_225_600, "nsec": 0},  # 2500, which was read as 1915
    {"sec": -1, "nsec": 0},
    {"sec": 2**63 - 1, "nsec": 0},
    "2609-01-01T00:00:00Z",
    "1600-01-01T00:00:00Z",
    1e300,
    -5.0,
    2**63 - 1,
]


@pytest.mark.parametrize("stamp", DATES, ids=range(len(DATES)))
def test_a_date_that_no_trial_can_have_is_left_out_and_counted(tmp_path: Path, stamp: object) -> None:
    good: list[object] = [{"sec": 1_700_000_000 + number, "nsec": 5} for number in range(20)]
    if isinstance(stamp, str):
        good = [f"2023-11-14T22:13:{number:02}Z" for number in range(20)]
    elif not isinstance(stamp, dict):
        good = [type(stamp)(1_700_000_000 + number) for number in range(20)]
    log = read_run(log_of(tmp_path, [*good[:7], stamp, *good[7:]]), IngestConfig())
    assert log.gnss.height == 20
    assert log.notes.skipped_topics == ("/gnss: 1 messages with a date before 1970 or after 2200",)
    with pytest.raises(InputError, match="impossible time stamps; found 3 of 4, the first in message 1"):
        read_run(log_of(tmp_path, [good[0], stamp, stamp, stamp]), IngestConfig())


@pytest.mark.parametrize("nanoseconds", [SECOND_NS, 2**32 - 1, -1])
def test_nanoseconds_that_make_seconds_contradict_themselves(tmp_path: Path, nanoseconds: int) -> None:
    stamps = [{"sec": 5, "nsec": 0}, {"sec": 6, "nsec": nanoseconds}]
    with pytest.raises(InputError, match=f"{nanoseconds} nanoseconds beside whole seconds in message 1"):
        read_run(log_of(tmp_path, stamps), IngestConfig())


@pytest.mark.parametrize("number", [2**64, 2**63, 10**400, -(2**63) - 1], ids=["64", "63", "400 digits", "-63"])
def test_integers_beyond_64_bits_are_refused(tmp_path: Path, number: int) -> None:
    for fields in ({"t": {"sec": number, "nsec": 0}}, {"satellites": number}):
        path = samples.save(tmp_path, whole(definitions(), message(position(0)), message(position(1, **fields))))
        with pytest.raises(InputError, match=r"/gnss: the message recorded at log time .* integer"):
            read_run(path, IngestConfig())


@pytest.mark.parametrize(
    "content",
    [
        b'{"a":' * 50_000,
        b"[" * 100_000,
        b'{"t":' + b"1" * 5000 + b"}",
        b'{"latitude_deg":1e999}',
        b"{" + b'"a":1,' * 9 + b'"b":2}',
    ],
    ids=["nested objects", "nested lists", "5000 digits", "1e999", "a name twice"],
)
def test_json_that_python_stumbles_over(tmp_path: Path, content: bytes) -> None:
    path = samples.save(tmp_path, whole(definitions(), message(position(0)), message(content)))
    with pytest.raises(InputError):
        read_run(path, IngestConfig())
    assert describe_log(path, IngestConfig()).problems


@pytest.mark.parametrize("value", [1e308, -1e16, 10**400])
def test_numbers_whose_squares_overflow_are_out_of_range(tmp_path: Path, value: float) -> None:
    content = json.dumps(json.loads(position(0)) | {"height_m": 0.0}).replace('"height_m": 0.0', f'"height_m": {value}')
    path = samples.save(tmp_path, whole(definitions(), message(position(0)), message(content.encode())))
    with pytest.raises(InputError, match=r"out of range|not finite numbers"):
        read_run(path, IngestConfig())


@pytest.mark.parametrize("t_ns", [-(2**63) + 1, -9_000_000_000 * SECOND_NS, 2**63 - 1, -1])
def test_rows_at_the_ends_of_64_bits_are_left_out_of_every_stream(t_ns: int) -> None:
    run = samples.run()

    def with_row(frame: pl.DataFrame) -> pl.DataFrame:
        stamp = pl.Series("t", [t_ns]).cast(pl.Datetime("ns", "UTC"))
        return pl.concat([frame, frame.head(1).with_columns(stamp)])

    found, counts = clean(run.with_streams(gnss=with_row(run.gnss), odometer=with_row(run.odometer)))
    without, _ = clean(run)
    assert found.gnss.equals(without.gnss)
    assert found.odometer.equals(without.odometer)
    assert (counts.solutions["primary"].far_off, counts.streams["odometer"].far_off) == (1, 1)
    others = "their time is more than a day from the others or the positions"
    assert found.notes.skipped_topics == (f"odometer: 1 rows left out: {others}",)


@pytest.mark.parametrize("t_ns", [1, 2**63 - 1, samples.START_NS - 40 * 86_400 * SECOND_NS])
def test_reads_of_another_day_than_the_positions_are_left_out(t_ns: int) -> None:
    """One of two reads in 1970 asked for 13 GB: the train was looked for in every second since."""
    run = samples.run()
    reads = pl.DataFrame({"t": [samples.START_NS + 5, t_ns], "balise_id": ["P1", "P1"]})
    reads = reads.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))
    found, counts = clean(run.with_streams(balise_reads=reads))
    assert found.balise_reads is not None
    assert found.balise_reads.equals(reads.head(1))
    assert counts.streams["balise_reads"].far_off == 1


def test_a_stream_all_of_another_day_is_seen_by_the_fit_only() -> None:
    """The fit tells its clock; the evidence of the same run asked for 54 GB."""
    run = samples.run()
    reads = pl.DataFrame({"t": [2**62, 2**62 + 10**9], "balise_id": ["P1", "P2"]})
    reads = reads.with_columns(pl.col("t").cast(pl.Datetime("ns", "UTC")))
    found, _ = clean(run.with_streams(balise_reads=reads))
    assert found.balise_reads is not None
    assert found.balise_reads.height == 2
    judged = without_undated_streams(found)
    assert judged.balise_reads is None
    assert "more than a day from the positions" in judged.notes.skipped_topics[-1]
    assert without_undated_streams(run) is run


def test_parquet_without_checksums_is_said_and_with_them_is_proved(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    samples.gnss().write_parquet(folder / "gnss.parquet")
    assert read_run(folder, IngestConfig()).notes.files_without_crc == ("gnss.parquet",)
    content = parquet_bytes(samples.gnss())
    (folder / "gnss.parquet").write_bytes(content)
    run = read_run(folder, IngestConfig())
    assert run.notes.files_without_crc == ()
    assert run.gnss.equals(samples.gnss())
    (folder / "gnss.parquet").write_bytes(content[:200] + bytes([content[200] ^ 1]) + content[201:])
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        read_run(folder, IngestConfig())


def test_a_receivers_calendar_of_the_year_65000_is_no_time(tmp_path: Path) -> None:
    from tests.read.ingest.test_mapping import ros_log

    lines = "uint16 year\nuint8 month\nuint8 day\nuint8 hour\nuint8 min\nuint8 sec\nuint8 valid\nint32 nano\n"
    lines += (
        "uint8 fix_type\nuint8 flags\nuint8 num_sv\nint32 lon\nint32 lat\nint32 height\nuint32 h_acc\nuint32 v_acc\n"
    )
    lines += "int32 vel_n\nint32 vel_e\nint32 vel_d\n"
    good = {"year": 2023, "month": 11, "day": 14, "valid": 7, "fix_type": 3, "flags": 1, "lat": 505_000_000}
    wrong = [good | {"year": 65000}, good | {"valid": 0, "month": 0, "day": 0, "hour": 99}]
    path = ros_log(tmp_path, ("/navpvt", "ublox_msgs/msg/NavPVT", lines, [good, *wrong, good]))
    log = read_run(path, IngestConfig())
    assert log.gnss.height == 2
    assert log.notes.skipped_topics == ("/navpvt: 2 messages without a valid time",)
