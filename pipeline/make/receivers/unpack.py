"""Logs out of archives: `.zip`, `.tar`, `.gz`, `.bz2`, `.xz`, `.zst`, and archives in them."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import pyarrow as pa

from pipeline.storage.budget import UNPACKING, Budget
from pipeline.storage.noted import note_all_below, scratch_folder
from schemas.config import IngestConfig
from schemas.errors import InputError

BAG_FOLDER = "metadata.yaml"
_DEEPEST = 3  # archives in archives; one that holds itself has no end


@contextmanager
def unpacked_logs(log: Path, config: IngestConfig) -> Iterator[list[Path]]:
    """The logs that a file holds: itself, or what it is the archive of; gone after the block.

    A folder is one log (a bag of ROS 2), in an archive as well. Errors name the archive, not where it was unpacked.
    """
    note_all_below(log)
    if not is_packed(log):
        yield [log]
        return
    with scratch_folder() as folder:
        try:
            yield _unpack_all(log, folder, Budget(str(log), log.stat().st_size, config))
        except InputError as error:
            error.place = str(error.place).replace(str(folder), str(log))
            raise


def _unpack_all(log: Path, place: Path, budget: Budget) -> list[Path]:
    """All logs within an archive, archives within it included."""
    try:
        _unpack(log, place, budget)
        return [inner for entry in sorted(place.iterdir()) for inner in _logs_at(entry, _DEEPEST, budget)]
    except UNPACKING as error:
        raise InputError(
            f"cannot be unpacked: {error}",
            place=str(log),
            expected=f"a whole archive ({', '.join(_UNPACKERS)}) without a password",
            remedy="Copy the file again, or unpack it by hand.",
        ) from None


def is_packed(path: Path) -> bool:
    """Whether a file is an archive, by its suffix."""
    return path.suffix.lower() in _UNPACKERS


def _unpack(archive: Path, place: Path, budget: Budget) -> None:
    """Unpack an archive by its suffix."""
    _UNPACKERS[archive.suffix.lower()](archive, place, budget)


def _unpack_zip(archive: Path, place: Path, budget: Budget) -> None:
    """Unpack a zip archive, within the budget."""
    with zipfile.ZipFile(archive) as opened:
        for entry in opened.infolist():
            if not entry.is_dir():
                with opened.open(entry) as packed:
                    _write_unpacked(packed, entry.filename, place, budget)


def _unpack_tar(archive: Path, place: Path, budget: Budget) -> None:
    """Unpack a tar archive, within the budget."""
    with tarfile.open(archive, "r:") as opened:
        for entry in opened:
            packed = opened.extractfile(entry) if entry.isreg() else None
            if packed is not None:
                _write_unpacked(packed, entry.name, place, budget)
            elif not entry.isdir():
                raise OSError(f"{entry.name} is no regular file")


def _single_file_unpacker(opener: Callable[[Path], Any]) -> Callable[[Path, Path, Budget], None]:
    """Unpack a format of one single file, which is called as the archive without its last suffix."""

    def unpack(archive: Path, place: Path, budget: Budget) -> None:
        """Unpack the file of an archive, without the archive's last suffix."""
        name = archive.stem + (".tar" if archive.suffix.lower() == ".tgz" else "")
        with opener(archive) as packed:
            _write_unpacked(packed, name, place, budget)

    return unpack


def open_zstd(packed: Any) -> Any:
    """The unpacked content of a path, or of something that can be read."""
    source = pa.OSFile(str(packed)) if isinstance(packed, Path) else packed
    return pa.CompressedInputStream(source, "zstd")


def _write_unpacked(packed: IO[bytes], name: str, place: Path, budget: Budget) -> None:
    """Unpack one file to where its name says, which must lie within the archive and be no other's."""
    parts = re.split(r"[/\\]", name.removeprefix("./"))
    if {"", ".", ".."} & set(parts) or ":" in name:
        raise OSError(f"{name!r} is no path within the archive")
    target = place.joinpath(*parts)
    if target.exists():
        raise OSError(f"two of its files have the same name {name!r}")
    target.parent.mkdir(parents=True, exist_ok=True)
    with target.open("wb") as plain:
        budget.copy(packed, plain)


_UNPACKERS: dict[str, Callable[[Path, Path, Budget], None]] = {
    ".zip": _unpack_zip,
    ".tar": _unpack_tar,
    ".gz": _single_file_unpacker(gzip.open),
    ".tgz": _single_file_unpacker(gzip.open),
    ".bz2": _single_file_unpacker(bz2.open),
    ".xz": _single_file_unpacker(lzma.open),
    ".zst": _single_file_unpacker(open_zstd),
}


def _logs_at(path: Path, deeper: int, budget: Budget) -> Iterator[Path]:
    """The logs at a place of an archive; what the makers of archives leave in them is none."""
    if path.name.startswith((".", "__MACOSX")):
        return
    if is_packed(path) and path.is_file():
        if not deeper:
            raise OSError(f"{path.name} is packed too often")
        inner = path.with_name(path.name + ".unpacked")
        inner.mkdir()
        _unpack(path, inner, budget)
        path.unlink()  # or archives in archives would take their room twice
        path = inner
        deeper -= 1
    if path.is_dir() and not (path / BAG_FOLDER).exists():
        for inner in sorted(path.iterdir()):
            yield from _logs_at(inner, deeper, budget)
        return
    yield path
