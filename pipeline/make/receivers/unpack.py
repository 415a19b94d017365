"""Logs out of `.gz` and `.zip`."""

from __future__ import annotations

import gzip
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from schemas.errors import InputError

BAG_FOLDER = "metadata.yaml"
_PACKED = (".gz", ".zip")
_DEEPEST = 3  # archives in archives; one that holds itself has no end


@contextmanager
def unpacked(log: Path) -> Iterator[list[Path]]:
    """The logs that a file holds: itself, or what it is the archive of; gone after the block.

    A folder is one log (a bag of ROS 2), in an archive as well. Errors name the archive, not where it was unpacked.
    """
    if log.suffix.lower() not in _PACKED:
        yield [log]
        return
    with TemporaryDirectory() as folder:
        place = Path(folder)
        try:
            _unpack(log, place)
            yield [inner for entry in sorted(place.iterdir()) for inner in _logs(entry, _DEEPEST)]
        except (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError, NotImplementedError) as error:
            raise InputError(
                f"cannot be unpacked: {error}",
                place=str(log),
                expected="a whole .gz or .zip without a password",
                remedy="Copy the file again, or unpack it by hand.",
            ) from None
        except InputError as error:
            error.place = str(error.place).replace(folder, str(log))
            raise


def _unpack(log: Path, place: Path) -> None:
    if log.suffix.lower() == ".zip":
        with zipfile.ZipFile(log) as archive:
            names = archive.namelist()
            if len(set(names)) < len(names):
                raise OSError("two of its files have the same name")
            archive.extractall(place)
        return
    with gzip.open(log) as packed, (place / log.stem).open("wb") as plain:
        shutil.copyfileobj(packed, plain)


def _logs(path: Path, deeper: int) -> Iterator[Path]:
    """The logs at a place of an archive; what the makers of archives leave in them is none."""
    if path.name.startswith((".", "__MACOSX")):
        return
    if path.suffix.lower() in _PACKED and path.is_file():
        if not deeper:
            raise OSError(f"{path.name} is packed too often")
        inner = path.with_name(path.name + ".unpacked")
        inner.mkdir()
        _unpack(path, inner)
        path = inner
        deeper -= 1
    if path.is_dir() and not (path / BAG_FOLDER).exists():
        for inner in sorted(path.iterdir()):
            yield from _logs(inner, deeper)
        return
    yield path
