"""Archives and bags that unpack to more than they should: one error, and nothing left behind."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import os
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from pipeline.make.receivers import convert
from schemas.config import IngestConfig
from schemas.errors import InputError
from tests.make.receivers.test_trial_logs import bestposa

MIB = 1024 * 1024
ZEROS = bytes(MIB)


def zipped(**files: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def zstd(content: bytes) -> bytes:
    return pa.compress(content, codec="zstd", asbytes=True)


PACKED = {
    ".gz": gzip.compress,
    ".bz2": bz2.compress,
    ".xz": lzma.compress,
    ".zst": zstd,
    ".zip": lambda content: zipped(log=content),
}


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where archives are unpacked."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def refused(path: Path, config: IngestConfig, key: str, scratch: Path) -> None:
    with pytest.raises(InputError, match=key) as caught:
        convert([path], "r", config)
    assert str(caught.value).startswith(f"{path}: ")
    assert list(scratch.iterdir()) == []


def test_what_is_no_log_is_named_in_its_archive(tmp_path: Path, scratch: Path) -> None:
    log = tmp_path / "a.zip"
    log.write_bytes(zipped(**{"day/notes.bin": b"nothing of a receiver"}))
    with pytest.raises(InputError, match="no message of a known receiver") as caught:
        convert([log], "r")
    assert str(caught.value).startswith(f"{log / 'notes.bin'}: ")
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize("suffix", PACKED)
def test_each_kind_of_archive_is_read_and_has_a_limit(tmp_path: Path, scratch: Path, suffix: str) -> None:
    log = tmp_path / f"a.gps{suffix}"
    log.write_bytes(PACKED[suffix](bestposa() + bestposa(506713.0)))
    assert convert([log], "r").run.gnss.height == 2
    bomb = tmp_path / f"b.gps{suffix}"
    bomb.write_bytes(PACKED[suffix](ZEROS * 3))
    refused(bomb, IngestConfig(unpacked_limit_mib=2.5), "unpacks to too much; expected at most 2.5 MiB", scratch)


def test_archives_in_archives_share_one_budget(tmp_path: Path, scratch: Path) -> None:
    inner = zipped(log=ZEROS)
    path = tmp_path / "outer.zip"
    path.write_bytes(zipped(**{f"{number}.zip": inner for number in range(4)}))
    refused(path, IngestConfig(unpacked_limit_mib=3.0), "`unpacked_limit_mib`", scratch)
    refused(path, IngestConfig(unpacked_files_limit=7), "holds too many files; expected at most 7", scratch)
    refused(path, IngestConfig(unpacked_limit_s=1e-9), "`unpacked_limit_s`", scratch)


def test_what_packs_too_well_is_a_bomb(tmp_path: Path, scratch: Path) -> None:
    path = tmp_path / "log.gz"
    path.write_bytes(gzip.compress(ZEROS * 65))
    refused(path, IngestConfig(), "to too many times its size; expected at most 300 times", scratch)


def test_an_archive_may_unpack_to_its_own_size(tmp_path: Path) -> None:
    path = tmp_path / "stored.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.gps", bestposa() + bestposa(506713.0))
    assert convert([path], "r", IngestConfig(unpacked_limit_mib=1e-6)).run.gnss.height == 2


def tarred(*members: tuple[str, bytes | None]) -> bytes:
    """A tar; a member without content is a link to /etc/passwd."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, content in members:
            entry = tarfile.TarInfo(name)
            entry.size = len(content or b"")
            entry.type = tarfile.REGTYPE if content is not None else tarfile.SYMTYPE
            entry.linkname = "" if content is not None else "/etc/passwd"
            archive.addfile(entry, io.BytesIO(content or b""))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.tar", tarred(("log", None)), "log is no regular file"),
        ("a.tar", tarred(("../log", b"x")), "'../log' is no path within the archive"),
        ("a.tgz", gzip.compress(tarred(("/log", b"x"))), "'/log' is no path within the archive"),
        ("a.zip", zipped(**{"../../log": b"x"}), "is no path within the archive"),
        ("a.zst", zstd(bestposa())[:-4], "cannot be unpacked"),
        ("a.tar", tarred(("log", b"x" * 2000))[:1000], "cannot be unpacked"),
    ],
    ids=["link", "above", "absolute", "above in a zip", "short zstd", "short tar"],
)
def test_members_that_are_no_plain_files(
    tmp_path: Path, scratch: Path, name: str, content: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(content)
    refused(tmp_path / name, IngestConfig(), message, scratch)


def test_a_packed_tar_is_read(tmp_path: Path) -> None:
    tar = tarred(("./day/a.gps", bestposa()), ("day/b.gps", bestposa(506713.0)))
    for name in ("logs.tar.gz", "logs.tgz"):
        (tmp_path / name).write_bytes(gzip.compress(tar))
        assert convert([tmp_path / name], "r").run.gnss.height == 2


def test_an_archive_is_a_regular_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.gz")
    with pytest.raises(InputError, match="is no regular file"):
        convert([tmp_path / "log.gz"], "r")


def bag_of_ros_1(path: Path, message: bytes, compression: Any) -> Path:
    from rosbags.rosbag1 import Writer

    writer = Writer(path)
    writer.set_compression(compression)
    with writer:
        definition = {"msgdef": "string data", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}
        topic = writer.add_connection("/text", "std_msgs/msg/String", **definition)
        writer.write(topic, 1, message)
    return path


def bag_of_ros_2(path: Path, message: bytes, mode: Any, storage: Any) -> Path:
    from rosbags.rosbag2 import CompressionFormat, Writer
    from rosbags.typesys import Stores, get_typestore

    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        types = get_typestore(Stores.ROS2_HUMBLE)
        writer.write(writer.add_connection("/text", "std_msgs/msg/String", typestore=types), 1, message)
    return path


def test_what_a_bag_unpacks_to_has_a_limit(tmp_path: Path, scratch: Path) -> None:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionMode, StoragePlugin

    chunk = IngestConfig(chunk_limit_mib=2.0)
    for kind in (Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4):
        bag = bag_of_ros_1(tmp_path / f"{kind.name}.bag", ZEROS * 3, kind)
        refused(bag, chunk, "unpacks to too much; expected at most 2 MiB", scratch)
    packed = bag_of_ros_2(tmp_path / "packed", ZEROS * 3, CompressionMode.MESSAGE, StoragePlugin.SQLITE3)
    refused(packed, chunk, "unpacks to too much; expected at most 2 MiB", scratch)
    of_files = bag_of_ros_2(tmp_path / "files", ZEROS * 3, CompressionMode.FILE, StoragePlugin.SQLITE3)
    with pytest.raises(InputError, match="unpacks to too much; expected at most 2 MiB"):
        convert([of_files], "r", IngestConfig(unpacked_limit_mib=2.0))
    of_chunks = bag_of_ros_2(tmp_path / "chunks", ZEROS * 3, CompressionMode.STORAGE, StoragePlugin.MCAP)
    with pytest.raises(InputError, match="chunk_limit_mib"):
        convert([of_chunks], "r", chunk)
    assert list(scratch.iterdir()) == []
