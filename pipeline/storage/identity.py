"""Whether content is still the same: versions that cost no reading, and digests that do."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from pipeline.storage.address import Address, is_url
from pipeline.storage.object_store import on_store
from pipeline.storage.objects import objects_at, version_in
from schemas.errors import InputError


def version(address: Address) -> str | None:
    """What changes with the content of a file, or of the files in a folder; none where that is not known.

    Args:
        address: path, or address in an object store.

    Returns:
        A text that changes with the content, or None.
    """
    if not is_url(address):
        return repr(signature(Path(address))) if Path(address).exists() else None
    return version_in(on_store(address, objects_at, kind=InputError))


class FileDigest(NamedTuple):
    """Name, size and SHA-256 of a file."""

    name: str
    size_bytes: int
    sha256: str


def file_digests(path: Path, known: str = "") -> tuple[FileDigest, ...]:
    """Digests of a file, or of the files directly in a folder, in order of their names.

    Args:
        path: a file or a folder.
        known: the SHA-256 of the file, if it has been read already; of no use for a folder.

    Returns:
        Name, size and SHA-256 of each.
    """
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.is_file()]
        return tuple(FileDigest(file.name, file.stat().st_size, file_digest(file)) for file in files)
    return (FileDigest(path.name, path.stat().st_size, known or file_digest(path)),)


def digest_of_files(files: Iterable[FileDigest]) -> str:
    """SHA-256 over names and contents.

    Args:
        files: names and digests.

    Returns:
        64 hexadecimal digits.
    """
    return hashlib.sha256("".join(f"{file.name} {file.sha256}\n" for file in files).encode()).hexdigest()


def file_digest(file: Path) -> str:
    """SHA-256 of what a file holds."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


class FileState(NamedTuple):
    """What changes when somebody writes to a file."""

    name: str
    size_bytes: int
    written_ns: int
    changed_ns: int
    inode: int


def signature(path: Path) -> tuple[FileState, ...]:
    """The state of a file, or of each file directly in a folder.

    Args:
        path: a local file or folder.

    Returns:
        Size and times of each file, in order of their names.
    """
    if path.is_dir():
        with os.scandir(path) as entries:
            stats = sorted((entry.name, entry.stat()) for entry in entries if entry.is_file())
    else:
        stats = [(path.name, path.stat())]
    return tuple(FileState(name, s.st_size, s.st_mtime_ns, s.st_ctime_ns, s.st_ino) for name, s in stats)
