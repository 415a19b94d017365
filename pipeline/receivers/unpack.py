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

_BAG_FOLDER = "metadata.yaml"


@contextmanager
def unpacked(log: Path) -> Iterator[list[Path]]:
    """The logs that a file holds: itself, or what it is the archive of; gone after the block.

    A folder is one log (a bag of ROS 2), in an archive as well. Errors name the archive, not where it was unpacked.
    """
    if log.suffix.lower() not in (".gz", ".zip"):
        yield [log]
        return
    with TemporaryDirectory() as folder:
        place = Path(folder)
        try:
            _unpack(log, place)
            yield [inner for found in sorted(place.iterdir()) for inner in _logs(found)]
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
            archive.extractall(place)
        return
    with gzip.open(log) as packed, (place / log.stem).open("wb") as plain:
        shutil.copyfileobj(packed, plain)


def _logs(path: Path) -> Iterator[Path]:
    """The logs at a place of an archive; what the makers of archives leave in them is none."""
    if path.name.startswith((".", "__MACOSX")):
        return
    if path.is_dir() and not (path / _BAG_FOLDER).exists():
        for inner in sorted(path.iterdir()):
            yield from _logs(inner)
        return
    with unpacked(path) as inner_logs:
        yield from inner_logs
