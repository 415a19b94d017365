"""What trials record beside plain receiver logs: NovAtel, bags, archives, and several receivers in one run."""

from __future__ import annotations

import gzip
import math
import zipfile
from binascii import crc32
from datetime import date
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pipeline.make.receivers import Purpose, as_run, convert, extended, gather
from schemas.config import FixSigma
from schemas.errors import InputError, UsageError
from tests.make.receivers.test_convert import SAMPLES, needs_samples
from tests.make.receivers.test_rtklib import END, HEAD, LLH, PLANE

HERE = Path("run")


def bestposa(seconds: float = 506712.0, status: str = "SOL_COMPUTED", kind: str = "NARROW_INT") -> bytes:
    place = '51.15043,-114.03068,1094.10,-17.0,WGS84,0.0200,0.0100,0.0300,"",0.000,0.000,16,15,15,0,00,00,00,11'
    return novatel("BESTPOSA", seconds, f"{status},{kind},{place}")


def bestvela(seconds: float, latency_s: float, speed_mps: float) -> bytes:
    """Eastwards."""
    return novatel("BESTVELA", seconds, f"SOL_COMPUTED,DOPPLER_VELOCITY,{latency_s},0.0,{speed_mps},90.0,-0.1,0.0")


def novatel(name: str, seconds: float, content: str) -> bytes:
    body = f"{name},COM1,0,90.0,FINESTEERING,2134,{seconds:.3f},02000020,cdba,16248;{content}".encode()
    crc = crc32(body, 0xFFFFFFFF) ^ 0xFFFFFFFF
    return b"#" + body + f"*{crc:08x}\r\n".encode()


def test_novatel_ascii(tmp_path):
    log = tmp_path / "a.gps"
    log.write_bytes(bestposa() + bestposa(506713.0)[:-8] + b"0000\r\n" + bestposa(506714.0, "INSUFFICIENT_OBS", "NONE"))
    found = convert([log], "r")
    first, second = found.run.gnss.rows(named=True)
    # Week 2134 begins on 2020-11-29; 506,712 s are Friday 20:45:12 GPS time.
    assert first["t"].isoformat() == "2020-12-04T20:44:54+00:00"
    assert (first["latitude_deg"], first["longitude_deg"], first["fix"]) == (51.15043, -114.03068, "rtk_fixed")
    assert first["height_m"] == pytest.approx(1077.1)
    assert [first[f"cov_{a}_m2"] for a in ("nn", "ee", "uu")] == pytest.approx([4e-4, 1e-4, 9e-4])
    assert (second["fix"], second["latitude_deg"]) == ("none", None)
    assert found.dropped == {"damaged message": 1}


def test_a_velocity_of_novatel_is_as_old_as_it_says(tmp_path):
    log = tmp_path / "a.gps"
    speeds = {506712.0: 10.0, 506713.0: 11.0, 506714.0: 12.0, 506716.0: 14.0}
    log.write_bytes(b"".join(bestposa(at) + bestvela(at, 0.25, speed) for at, speed in speeds.items()))
    # A quarter of a second later than stated, at 1 m/s2; nothing is known where the next velocity is missing.
    assert convert([log], "r").run.gnss["vel_e_mps"].to_list() == pytest.approx([10.25, 11.25, None, None])
    log.write_bytes(b"".join(bestvela(at, 0.0, speed) + bestposa(at) for at, speed in speeds.items()))
    assert convert([log], "r").run.gnss["vel_e_mps"].to_list() == pytest.approx([10.0, 11.0, 12.0, 14.0])


@needs_samples
def test_novatel_binary_and_a_bag_of_the_same_driver():
    found = convert([SAMPLES / "novatel_bestpos.gps"], "r")
    assert found.run.gnss.height == 5
    row = found.run.gnss.row(0, named=True)
    raw = (SAMPLES / "novatel_bestpos.gps").read_bytes()
    at = next(i for i in range(len(raw)) if raw[i : i + 3] == b"\xaaD\x12" and raw[i + 4 : i + 6] == b"\x2a\x00")
    latitude, longitude, height = np.frombuffer(raw[at + 36 : at + 60], "<f8")  # behind header, status and type
    assert (row["latitude_deg"], row["longitude_deg"]) == (latitude, longitude)
    assert row["height_m"] == pytest.approx(height - 17.0)
    bag = convert([SAMPLES / "novatel_bestpos.bag"], "r")
    counts = dict(bag.run.gnss.group_by("solution").len().iter_rows())
    assert counts == {"gps_fix": 12, "gps_gps": 12, "novatel_oem7_bestpos": 5}
    fix = bag.run.gnss.filter(pl.col("solution") == "gps_gps").row(1, named=True)
    assert (fix["latitude_deg"], fix["cov_ee_m2"], fix["satellites"]) == (51.15043782363468, 2.8443395919580894, 16)
    assert fix["vel_n_mps"] == pytest.approx(0.007631993453452976 * math.cos(math.radians(16.69849344695877)))
    assert bag.run.gnss["latitude_deg"].to_numpy() == pytest.approx(latitude, abs=1e-4)


def test_a_bag_of_ros_2_as_folder_file_and_archive(tmp_path):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    t = types.types
    stamp = t["builtin_interfaces/msg/Time"](sec=1_748_779_200, nanosec=250_000_000)
    fix = t["sensor_msgs/msg/NavSatFix"](
        header=t["std_msgs/msg/Header"](stamp=stamp, frame_id="gps"),
        status=t["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=50.5, longitude=4.5, altitude=100.0, position_covariance=np.eye(3).ravel(), position_covariance_type=2,
    )  # fmt: skip
    folder = tmp_path / "ride"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection("/fix", "sensor_msgs/msg/NavSatFix", typestore=types)
        writer.write(topic, 1_748_779_201_000_000_000, types.serialize_cdr(fix, "sensor_msgs/msg/NavSatFix"))
    with zipfile.ZipFile(tmp_path / "ride.zip", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, f"ride/{file.name}")
    for log in (folder, next(folder.glob("*.db3")), tmp_path / "ride.zip"):
        row = convert([log], "r").run.gnss.row(0, named=True)
        assert row["t"].isoformat() == "2025-06-01T12:00:00.250000+00:00"
        assert (row["latitude_deg"], row["longitude_deg"], row["cov_nn_m2"]) == (50.5, 4.5, 1.0)
    (tmp_path / "broken.bag").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError, match=r"broken\.bag: is not a whole bag"):
        convert([tmp_path / "broken.bag"], "r")


def test_packed_logs_and_damaged_archives(tmp_path):
    (tmp_path / "a.gps.gz").write_bytes(gzip.compress(bestposa()))
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        archive.writestr("day/b.gps", bestposa(506713.0))
        archive.writestr("__MACOSX/._b.gps", b"no log")
    assert convert([tmp_path / "a.gps.gz", tmp_path / "b.zip"], "r").run.gnss.height == 2
    with zipfile.ZipFile(tmp_path / "outer.zip", "w") as archive:
        archive.write(tmp_path / "b.zip", "b.zip")
        archive.writestr("README.txt", "Monday")
    found = convert([tmp_path / "outer.zip"], "r")
    assert (found.run.gnss.height, found.dropped) == (1, {"file of an archive that is no log": 1})
    (tmp_path / "c.gz").write_bytes(gzip.compress(bestposa())[:40])
    with pytest.raises(InputError, match=r"c\.gz: cannot be unpacked"):
        convert([tmp_path / "c.gz"], "r")
    with zipfile.ZipFile(tmp_path / "d.zip", "w") as archive:
        archive.writestr("d.gps", bestposa())
        with pytest.warns(UserWarning, match="Duplicate name"):
            archive.writestr("d.gps", bestposa(506713.0))
    with pytest.raises(InputError, match="two of its files have the same name"):
        convert([tmp_path / "d.zip"], "r")


def sentence(body: str) -> bytes:
    check = 0
    for byte in body.encode():
        check ^= byte
    return f"${body}*{check:02X}\r\n".encode()


def test_sentences_without_a_date_need_one(tmp_path):
    log = tmp_path / "night.nmea"
    place = "5030.000,N,00430.000,E,1,08,1.0,100.0,M,45.0,M,,"
    log.write_bytes(sentence(f"GPGGA,235959.50,{place}") + sentence(f"GPGGA,000000.50,{place}"))
    with pytest.raises(InputError, match=r"found NMEA GPGGA \(2\).*--date"):
        gather([log])
    log.write_bytes(b"$GPGGA,235959.50," + place.encode() + b"\r\n")
    with pytest.raises(InputError, match="NMEA without checksums cannot be checked"):
        gather([log])
    log.write_bytes(sentence(f"GPGGA,235959.50,{place}") + sentence(f"GPGGA,000000.50,{place}"))
    times = gather([log], date=date(2025, 5, 31)).streams["gnss"]["t"].dt.to_string("%FT%T%.3f").to_list()
    assert times == ["2025-05-31T23:59:59.500", "2025-06-01T00:00:00.500"]


def solution(tmp_path: Path, name: str, day: int = 4) -> Path:
    path = tmp_path / name
    rows = "".join(f"2020/12/0{day} 20:45:{second}.000 51.15 -114.03 120.5 {END}" for second in (10, 12, 14))
    path.write_text(f"{HEAD}% {LLH}\n%  GPST {PLANE}\n{rows}")
    return path


def test_several_receivers_make_one_run(tmp_path):
    log = tmp_path / "a.gps"
    log.write_bytes(bestposa() + bestposa(506714.0))
    run = as_run(gather([log]), "r").run
    rover = gather([solution(tmp_path, "rover.pos")])
    with pytest.raises(UsageError, match=r"has the solution primary already.*--solution"):
        extended(run, HERE, rover, Purpose(), FixSigma(), force=False)
    both = extended(run, HERE, rover, Purpose("second"), FixSigma(), force=False).run
    assert dict(both.gnss.group_by("solution").len().iter_rows()) == {"primary": 2, "second": 3}
    replaced = extended(both, HERE, rover, Purpose(), FixSigma(), force=True).run
    assert dict(replaced.gnss.group_by("solution").len().iter_rows()) == {"primary": 3, "second": 3}
    truth = extended(run, HERE, rover, Purpose(stream="reference"), FixSigma(), force=False).run
    assert truth.gnss.equals(run.gnss)
    assert truth.reference is not None
    covariance = rover.streams["gnss"].row(0, named=True)
    ellipse = [[covariance["cov_ee_m2"], covariance["cov_en_m2"]], [covariance["cov_en_m2"], covariance["cov_nn_m2"]]]
    assert truth.reference["sigma_m"].to_list() == pytest.approx([np.linalg.eigvalsh(ellipse)[1] ** 0.5] * 3)
    with pytest.raises(UsageError, match=r"--solution: is empty"):
        extended(run, HERE, rover, Purpose(" "), FixSigma(), force=False)
    with pytest.raises(UsageError, match=r"has a stream reference already.*--force"):
        extended(truth, HERE, rover, Purpose(stream="reference"), FixSigma(), force=False)
    with pytest.raises(InputError, match="is of another time"):
        extended(run, HERE, gather([solution(tmp_path, "b.pos", 5)]), Purpose("x"), FixSigma(), force=False)


def test_a_reference_without_stated_accuracy_is_not_exact(tmp_path):
    log = tmp_path / "a.gps"
    log.write_bytes(bestposa())
    fixes = gather([log]).streams["gnss"].with_columns(pl.lit(None, pl.Float64).alias("cov_ee_m2"))
    found = as_run(gather([log]), "r").gathered()
    found.streams["gnss"] = fixes
    run = extended(as_run(gather([log]), "r").run, HERE, found, Purpose(stream="reference"), FixSigma(), False).run
    assert run.reference is not None
    assert run.reference["sigma_m"].to_list() == [FixSigma().rtk_fixed_m]
