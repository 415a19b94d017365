"""What a log consists of is listed, all of it: used as what, or not used, with the lines that would read a topic."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import polars as pl
import pytest

import cli
from datasets.recordings import convert_logs
from pipeline.make.receivers import Gatherings, Purpose, gather
from pipeline.project.raw import inspect_raw
from pipeline.read.ingest.parts import drafts_of, lines_of_parts
from pipeline.show.inspection import NOT_USED
from pipeline.show.kinds import Kind, kind_at
from schemas.config import Configuration, IngestConfig, settings_from, toml_of
from schemas.errors import UsageError
from tests.read.ingest.test_declared import MAPPED, bag_of, part

SECONDS = "2025-03-03T08:00:0{}Z"


def nmea(body: str) -> str:
    check = 0
    for sign in body.encode():
        check ^= sign
    return f"${body}*{check:02X}\r\n"


def parts(found: Gatherings) -> dict[str, str]:
    return {part.name: part.used_as for part in found.parts}


def test_columns_of_a_table(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t,lat,lon,km,alt\n" + "".join(f"{SECONDS.format(n)},50.1,14.2,{n},9\n" for n in range(3)))
    mapping = {
        "gnss": {"topic": "log.csv", "time": "field:t", "fields": {"latitude_deg": "lat", "longitude_deg": "lon"}},
        "odometer": {"topic": "log.csv", "time": "field:t", "fields": {"distance_m": "km"}},
    }
    found = gather([log], settings_from(mapping, IngestConfig, "mapping"))
    assert parts(found) == {
        "t": "gnss t, odometer t",
        "lat": "gnss latitude_deg",
        "lon": "gnss longitude_deg",
        "km": "odometer distance_m",
        "alt": "",
    }
    assert lines_of_parts(found.parts)[1] == "log.csv: columns not used: alt"


def test_messages_of_a_receiver(tmp_path: Path) -> None:
    log = tmp_path / "log.nmea"
    place = "5001.2,N,01424.6,E"
    sentences = [
        *(f"GPGGA,08000{n}.00,{place},1,11,0.8,205.0,M,45.0,M,," for n in range(3)),
        *(f"GPRMC,08000{n}.00,A,{place},30.0,90.0,030325,,,A" for n in range(3)),
        *("GPGSV,1,1,01,08,45,090,40" for _ in range(2)),
    ]
    log.write_text("".join(map(nmea, sentences)))
    found = gather([log])
    assert {(part.name, part.count, bool(part.used_as)) for part in found.parts} == {
        ("NMEA GPGGA", 3, True),
        ("NMEA GPRMC", 3, True),
        ("NMEA GPGSV", 2, False),
    }
    table = inspect_raw(log, Configuration())["Parts"]
    assert table.filter(pl.col("used_as") == NOT_USED)["name"].to_list() == ["NMEA GPGSV"]


def test_columns_of_a_solution(tmp_path: Path) -> None:
    log = tmp_path / "log.pos"
    head = "% program : RTKLIB\n%  UTC latitude(deg) longitude(deg) height(m) Q ns sdn(m) ratio\n"
    log.write_text(head + "2025/03/03 08:00:00.000 50.1 14.2 250.0 5 11 1.0 0.0\n")
    found = parts(gather([log]))
    assert found["latitude"] == "gnss position"
    assert [name for name, used in found.items() if not used] == ["ratio"]


def test_topics_of_a_bag_and_the_lines_that_would_read_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = bag_of(tmp_path / "bag", [part(0, 20), part(20, 40)], {"/gnss": 40, "/odometer": 80})
    found = gather([bag])
    listed = {part.name: part for part in found.parts}
    odometer = listed["/odometer (geometry_msgs/msg/TwistStamped)"]
    assert (odometer.count, odometer.used_as) == (80, "")
    assert listed["/gnss (sensor_msgs/msg/NavSatFix)"].used_as.startswith("gnss: ")
    # The draft without its signs of a comment is what reads the topic.
    lines = drafts_of(found.parts)
    assert all(line.startswith("#") for line in lines)
    text = "\n".join(line.removeprefix("# ") for line in lines if " = " in line or "[[" in line)
    mapping = settings_from(toml_of(text.encode(), "draft")["ingest"], IngestConfig, "draft")  # type: ignore[arg-type]
    read = gather([bag], mapping)
    assert read.streams["odometer"].height == 80
    assert all(part.used_as for part in read.parts)
    convert_logs([bag], tmp_path / "run", None, Purpose(), None, False)
    shown = "\n".join(convert_logs([bag], tmp_path / "again", None, Purpose(), None, False).lines())
    assert "bag: topics not used: /odometer (geometry_msgs/msg/TwistStamped) (80)" in shown
    assert '# topic = "/odometer"' in shown
    assert capsys.readouterr().out == ""


def test_a_bag_is_inspected_as_what_it_holds(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / "bag", [part(0, 20), part(20, 40)], {"/gnss": 41, "/odometer": 80})
    assert kind_at(str(bag)) is Kind.RAW
    tables = inspect_raw(bag, Configuration())
    topics = dict(tables["Topics"].select("topic", "messages").iter_rows())
    assert topics == {"/gnss": 40, "/odometer": 80}
    log = dict(tables["Log"].iter_rows())
    assert "40 of 41" in log["damage"]
    mapped = inspect_raw(bag, Configuration(ingest=MAPPED))
    assert mapped["Streams"]["stream"].to_list() == ["gnss", "odometer"]
    bare = bag_of(tmp_path / "bare", [part(0, 20, odometer=True)], {"/odometer": 40})
    tables = inspect_raw(bare, Configuration())
    assert "holds no GNSS stream" in tables["Problems"]["problem"][0]
    assert tables["Topics"]["topic"].to_list() == ["/odometer"]


def test_a_bag_of_one_database_file(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection("/fix", "sensor_msgs/msg/NavSatFix", typestore=store)
        _write_fixes(writer, topic, store)
    (file,) = (tmp_path / "bag").glob("*.db3")
    for path in (tmp_path / "bag", file):
        tables = inspect_raw(path, Configuration())
        assert dict(tables["Topics"].select("topic", "messages").iter_rows()) == {"/fix": 5}
        assert tables["Streams"]["rows"].to_list() == [5]
    metadata = tmp_path / "bag" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("message_count: 5", "message_count: 6"))
    lacking = gather([tmp_path / "bag"])
    assert lacking.damage is not None
    assert "holds 5 of 6 messages of /fix" in lacking.damage


def _write_fixes(writer: object, topic: object, store: object) -> None:
    import numpy as np

    types = store.types  # type: ignore[attr-defined]
    kinds = {name.rpartition("/")[2]: types[name] for name in types if "/msg/NavSat" in name}
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    for number in range(5):
        fix = kinds["NavSatFix"](
            header=header(stamp=time(sec=1_700_000_000 + number, nanosec=0), frame_id="gps"),
            status=kinds["NavSatStatus"](status=1, service=1),
            latitude=50.0,
            longitude=4.0 + number / 1e4,
            altitude=100.0,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )
        raw = store.serialize_cdr(fix, "sensor_msgs/msg/NavSatFix")  # type: ignore[attr-defined]
        writer.write(topic, (1_700_000_000 + number) * 10**9, raw)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["thing.foo", "thing.docx"])
def test_what_is_no_log_by_its_name_is_refused_at_once(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x")
    with pytest.raises(UsageError, match="is neither a log"):
        kind_at(str(tmp_path / name))


def test_a_table_is_printed_as_a_mapping_that_can_be_saved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.csv"
    log.write_text("t,lat,lon\n" + "".join(f"{SECONDS.format(n)},50.1,14.2\n" for n in range(3)))
    with _exit():
        cli.app(["inspect", str(log)], standalone_mode=True)
    assert "gnss" in toml_of(capsys.readouterr().out.encode(), "printed")["ingest"]  # type: ignore[operator]


@contextmanager
def _exit() -> Iterator[None]:
    with pytest.raises(SystemExit) as caught:
        yield
    assert not caught.value.code
