"""Records that a log declares against those that it holds: fewer is read, `partial` and said; more contradicts it."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import NamedTuple

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from datasets.mcap_log import write_mcap
from datasets.recordings import convert_logs
from datasets.trial import write_run_as
from pipeline.make.receivers import Purpose, convert
from pipeline.read.ingest import read_run
from schemas.config import Configuration, IngestConfig, settings_from
from schemas.errors import InputError
from schemas.run import RunLog
from tests.read.ingest import samples
from tests.read.ingest.samples import (
    MAGIC,
    START_NS,
    chunk,
    data_end,
    definitions,
    footer,
    header,
    message,
    position,
    record,
)

SECOND = 10**9


def declared_log(counts: dict[int, int], chunks: int = 0, total: int | None = None) -> bytes:
    """Three positions on channel 1 of topic /gnss, with statistics that declare so many messages of each channel."""
    data = (
        MAGIC + header() + definitions() + b"".join(message(position(n), START_NS + n) for n in range(3)) + data_end()
    )
    by_channel = b"".join(struct.pack("<HQ", *pair) for pair in counts.items())
    total = sum(counts.values()) if total is None else total
    head = struct.pack("<QHIIIIQQI", total, 1, 1, 0, 0, chunks, START_NS, START_NS + 2, len(by_channel))
    return data + record(0x0B, head + by_channel) + footer(len(data)) + MAGIC


@pytest.mark.parametrize(
    ("log", "says"),
    [
        (declared_log({1: 5}), "holds 3 of 5 messages of /gnss that are declared"),
        (declared_log({1: 3, 7: 2}), "holds 0 of 2 messages of channel 7 that are declared"),
        (declared_log({}, total=4), "holds 3 of 4 messages that are declared"),
        (declared_log({1: 5}, chunks=2), "holds 0 of 2 chunks that are declared"),
    ],
)
def test_fewer_messages_than_the_statistics_declare_are_read_and_said(tmp_path: Path, log: bytes, says: str) -> None:
    run = read_run(samples.save(tmp_path, log), IngestConfig())
    assert run.gnss.height == 3
    assert run.notes.damage is not None
    assert says in run.notes.damage


@pytest.mark.parametrize("counts", [{1: 2}, {2: 5}])
def test_more_messages_than_the_statistics_declare_contradict_them(tmp_path: Path, counts: dict[int, int]) -> None:
    with pytest.raises(InputError, match="the statistics record gives"):
        read_run(samples.save(tmp_path, declared_log(counts)), IngestConfig())


def test_as_many_as_declared_are_whole(tmp_path: Path) -> None:
    assert read_run(samples.save(tmp_path, declared_log({1: 3})), IngestConfig()).notes.damage is None


def test_rows_that_a_parquet_file_declares_and_lacks(tmp_path: Path) -> None:
    """The footer's count of all rows made larger by hand: 40 in one row group, 41 declared (Thrift: 80 and 82)."""
    write_run_as(samples.run(), tmp_path / "run")
    file = tmp_path / "run" / "gnss.parquet"
    whole = file.read_bytes()
    length = int.from_bytes(whole[-8:-4], "little")
    at = len(whole) - 8 - length
    # FileMetaData: version (field 1, i32), schema (2, list), num_rows (3, i64: header 0x16).
    places = [at + n for n in range(length) if whole[at + n : at + n + 2] == b"\x16\x50"]
    changed = [whole[: place + 1] + b"\x52" + whole[place + 2 :] for place in places]
    more = [c for c in changed if _rows(c) == (41, 40)]
    assert more
    file.write_bytes(more[0])
    run = read_run(tmp_path / "run", IngestConfig())
    assert run.gnss.height == 40
    assert run.notes.damage == "gnss.parquet holds 40 of 41 rows that are declared"


def _rows(content: bytes) -> tuple[int, int] | None:
    """Rows of the whole file and of its row groups, as it declares them."""
    try:
        found = pq.read_metadata(pa.BufferReader(content))
        return found.num_rows, sum(found.row_group(n).num_rows for n in range(found.num_row_groups))
    except (OSError, pa.ArrowException):
        return None


def bag_of(folder: Path, parts: list[bytes], topics: dict[str, int], names: list[str] | None = None) -> Path:
    """A bag folder as `ros2 bag record` splits it."""
    folder.mkdir()
    files = [f"bag_{number}.mcap" for number in range(len(parts))]
    for name, content in zip(files, parts, strict=True):
        (folder / name).write_bytes(content)
    listed = "".join(
        f"    - topic_metadata: {{name: {name}, type: x/msg/X, serialization_format: cdr}}\n"
        f"      message_count: {count}\n"
        for name, count in topics.items()
    )
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n"
        f"  message_count: {sum(topics.values())}\n  topics_with_message_count:\n{listed}"
        f"  relative_file_paths: [{', '.join(names or files)}]\n"
    )
    return folder


def part(first: int, last: int, odometer: bool = False) -> bytes:
    """Rows of the sample as one file of a bag, on topics of ROS; `odometer`: nothing else."""
    whole = samples.run(40)
    assert whole.odometer is not None
    rows = {"odometer": whole.odometer[2 * first : 2 * last]}
    stream = io.BytesIO()
    kept = RunLog("x", whole.gnss[first:last] if not odometer else whole.gnss.clear(), **rows)
    write_mcap(kept, stream, "cdr")
    return stream.getvalue()


MAPPED = settings_from(
    {"ingest": {"odometer": {"topic": "/odometer", "origin": "wheel"}}}, Configuration, "mapping"
).ingest


def test_files_of_a_bag_are_one_log_in_which_no_topic_need_be_everywhere(tmp_path: Path) -> None:
    """The receiver had no fix yet while the first file was written, and the wheel sent nothing during the last."""
    alone = RunLog("x", samples.run().gnss[30:])
    last = io.BytesIO()
    write_mcap(alone, last, "cdr")
    parts = [part(0, 10, odometer=True), part(10, 30), last.getvalue()]
    bag = bag_of(tmp_path / "bag", parts, {"/gnss": 30, "/odometer": 60})
    found = convert([bag], "r", MAPPED)
    assert found.run.notes.damage is None
    assert found.run.gnss["t"].to_list() == samples.run().gnss["t"][10:].to_list()
    assert found.run.odometer is not None
    assert found.run.odometer["speed_mps"].to_list() == samples.odometer()["speed_mps"][:60].to_list()
    assert found.run.odometer["origin"].unique().to_list() == ["wheel"]


@pytest.mark.parametrize(
    ("topics", "names", "says"),
    [
        ({"/gnss": 41, "/odometer": 80}, None, "holds 40 of 41 messages of /gnss that are declared"),
        ({"/gnss": 40, "/odometer": 80, "/diag": 7}, None, "holds 0 of 7 messages of /diag that are declared"),
        ({"/gnss": 40, "/odometer": 80}, ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap"], "bag_2.mcap is declared and not"),
        ({"/gnss": 20, "/odometer": 40}, ["bag_0.mcap"], "bag_1.mcap is not declared, and not read"),
    ],
)
def test_what_a_bag_declares_and_lacks(
    tmp_path: Path, topics: dict[str, int], names: list[str] | None, says: str
) -> None:
    bag = bag_of(tmp_path / "bag", [part(0, 20), part(20, 40)], topics, names)
    found = convert([bag], "r", MAPPED)
    assert says in " ".join(found.dropped)
    assert says in (found.run.notes.damage or "")


def test_files_of_a_bag_that_were_cut_or_never_written(tmp_path: Path) -> None:
    """What the second file still holds is read; a third that is empty is said."""
    whole_log = part(20, 40)
    bag = bag_of(tmp_path / "bag", [part(0, 20), whole_log[: len(whole_log) * 2 // 3], b""], {"/gnss": 60})
    run = convert([bag], "r", MAPPED).run
    assert run.gnss["t"].to_list() == samples.run().gnss["t"][: run.gnss.height].to_list()
    damage = run.notes.damage or ""
    assert "bag_1.mcap: cut off at byte" in damage
    assert "bag_2.mcap is declared and empty" in damage
    assert f"holds {run.gnss.height} of 60 messages of /gnss" in damage


def test_older_writers_name_the_folder_too(tmp_path: Path) -> None:
    parts = [part(0, 20), part(20, 40)]
    bag = bag_of(tmp_path / "bag", parts, {"/gnss": 40}, ["bag/bag_0.mcap", "bag/bag_1.mcap"])
    found = convert([bag], "r", MAPPED)
    assert (found.run.gnss.height, found.run.notes.damage) == (40, None)


def test_the_run_of_a_log_that_lacks_something_stays_partial(tmp_path: Path) -> None:
    """Also when a stream is added, and in either form."""
    lacking = {"/gnss": 41, "/odometer": 80}
    bag = bag_of(tmp_path / "bag", [part(0, 20), part(20, 40)], lacking)
    for name in ("run", "run.mcap"):
        to = tmp_path / name
        convert_logs([bag], to, Configuration(ingest=MAPPED), Purpose(), None, False)
        assert "holds 40 of 41" in (read_run(to).notes.damage or "")
        table = tmp_path / "reads.csv"
        pl.DataFrame({"t": [START_NS + SECOND], "balise_id": ["PB1"]}).write_csv(table)
        mapping = {"ingest": {"balise_reads": {"topic": "*", "time": "field:t", "fields": {"balise_id": "balise_id"}}}}
        settings = settings_from(mapping, Configuration, "mapping")
        convert_logs([table], to, settings, Purpose(), None, False)
        again = read_run(to)
        assert again.balise_reads is not None
        assert "holds 40 of 41" in (again.notes.damage or "")


def test_a_lost_chunk_that_statistics_and_index_declare(tmp_path: Path) -> None:
    """The second of two chunks was replaced by a record that nobody knows, of the same length."""
    first = chunk(definitions() + message(position(0), START_NS))
    second = chunk(message(position(1), START_NS + SECOND))
    lost = record(0x70, second[9:])
    data = MAGIC + header()
    at = len(data)
    data += first + lost + data_end()
    indexes = b""
    for offset, content, t_ns in ((at, first, START_NS), (at + len(first), second, START_NS + SECOND)):
        size = len(content) - 9 - 40
        body = struct.pack("<QQQQIQ", t_ns, t_ns, offset, len(content), 0, 0)
        indexes += record(0x08, body + struct.pack("<I", 0) + struct.pack("<QQ", size, size))
    statistics = struct.pack("<QHIIIIQQI", 2, 1, 1, 0, 0, 2, START_NS, START_NS + SECOND, 10)
    statistics = record(0x0B, statistics + struct.pack("<HQ", 1, 2))
    end = footer(len(data)) + MAGIC
    run = read_run(samples.save(tmp_path, data + statistics + indexes + end), IngestConfig())
    assert run.gnss.height == 1
    assert run.notes.damage == (
        "holds 1 of 2 messages of /gnss that are declared; holds 1 of 2 chunks that are declared"
    )
    run = read_run(samples.save(tmp_path, data + indexes + end), IngestConfig())
    assert run.notes.damage == "holds 1 of 2 chunks that are declared"
    other = indexes.replace(struct.pack("<Q", START_NS), struct.pack("<Q", START_NS - 1))
    with pytest.raises(InputError, match="chunk index"):
        read_run(samples.save(tmp_path, data + other + end), IngestConfig())


class CutLog(NamedTuple):
    """A log of seven chunks by the `mcap` package: where each begins and ends, and its indexes end; fixes of each."""

    content: bytes
    chunks: list[tuple[int, int, int]]
    fixes: list[int]


def log_of_seven(checksum: bool) -> CutLog:
    """100 fixes; `checksum`: over the data too."""
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=2000, enable_data_crcs=checksum)
    writer.start()
    channel = writer.register_channel(
        "/gnss", "json", writer.register_schema("foxglove.LocationFix", "jsonschema", b"{}")
    )
    for number in range(100):
        t_ns = START_NS + number * SECOND
        stamp = {"sec": t_ns // SECOND, "nsec": 0}
        fix = {"timestamp": stamp, "latitude": 50.0 + number * 1e-5, "longitude": 14.0, "altitude": 200.0}
        writer.add_message(channel, t_ns, json.dumps(fix).encode(), t_ns)
    writer.finish()
    content = stream.getvalue()
    summary = make_reader(io.BytesIO(content)).get_summary()
    assert summary is not None
    indexes = sorted(summary.chunk_indexes, key=lambda index: index.chunk_start_offset)
    starts = [index.chunk_start_offset for index in indexes]
    ends = [start + index.chunk_length for start, index in zip(starts, indexes, strict=True)]
    behind = [end + index.message_index_length for end, index in zip(ends, indexes, strict=True)]
    counts = [round((index.message_end_time - index.message_start_time) / SECOND) + 1 for index in indexes]
    return CutLog(content, list(zip(starts, ends, behind, strict=True)), counts)


@pytest.mark.parametrize("checksum", [False, True])
@pytest.mark.parametrize("keeps_indexes", [False, True])
@pytest.mark.parametrize("cut", [(0,), (3,), (6,), (2, 3), (1, 5)])
def test_chunks_cut_out_of_a_log_are_said_and_the_others_read(
    tmp_path: Path, cut: tuple[int, ...], keeps_indexes: bool, checksum: bool
) -> None:
    log = log_of_seven(checksum)
    assert len(log.chunks) == 7
    content = log.content
    for number in reversed(cut):
        start, end, behind = log.chunks[number]
        content = content[:start] + content[end if keeps_indexes else behind :]
    run = read_run(samples.save(tmp_path, content), IngestConfig())
    chunk_of = [number for number, count in enumerate(log.fixes) for _ in range(count)]
    kept = [fix for fix, number in enumerate(chunk_of) if number not in cut]
    assert run.gnss["latitude_deg"].to_list() == pytest.approx([50.0 + fix * 1e-5 for fix in kept], abs=1e-9)
    assert f"holds {len(kept)} of 100 messages of /gnss that are declared" in (run.notes.damage or "")
    assert f"holds {7 - len(cut)} of 7 chunks that are declared" in (run.notes.damage or "")


def test_what_no_lost_chunk_explains_stays_damage(tmp_path: Path) -> None:
    """A chunk moved behind another, written twice, or cut in the middle; indexes exchanged."""
    log = log_of_seven(checksum=True)
    (a, a_end, b), (_, b_end, c) = log.chunks[2:4]
    content = log.content
    for changed in (
        content[:a] + content[b:c] + content[a:b] + content[c:],
        content[:c] + content[a:],
        content[: a + 40] + content[a_end:],
        content[:a_end] + content[b_end:c] + content[b:b_end] + content[a_end:b] + content[c:],
    ):
        with pytest.raises(InputError, match="damaged"):
            read_run(samples.save(tmp_path, changed), IngestConfig())
