"""Whether content is still the same: versions that cost no reading, and digests that do."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pipeline.storage.address import Address, is_url, name_of
from pipeline.storage.fetching import folders_in
from pipeline.storage.object_store import on_store
from schemas.errors import InputError

_BLOCK_BYTES = 1 << 20


def versions(folder: Address, name: str) -> dict[str, str] | None:
    """What changes with the content of `folder/*/name`, by the folder between.

    None where a store gives its objects no version that could be relied on.
    """
    if not is_url(folder):
        return _local_versions(str(folder), name)
    infos = {
        place.split("/")[-2]: info for place, info in on_store(folder, _infos).items() if place.endswith(f"/{name}")
    }
    found = {part: version_of(info) for part, info in infos.items()}
    return None if None in found.values() else {part: str(version) for part, version in found.items()}


def version(address: Address) -> str | None:
    """What changes with the content of an object, or of the objects in a folder; none where that is not known."""
    infos = on_store(address, _infos, kind=InputError)
    found = {place: version_of(info) for place, info in infos.items()}
    if not found or None in found.values():
        return None
    return "\n".join(f"{name_of(place)} {text}" for place, text in sorted(found.items()))


def _infos(store: Any, path: str) -> dict[str, Any]:
    """What a store tells of an object, or of each object in a folder, by its path."""
    try:
        return dict(store.find(path, detail=True))
    except FileNotFoundError:
        return {}


def version_of(info: Mapping[str, Any]) -> str | None:
    """An object's entity tag, size and time; weak tags stand for other content too, and are none."""
    tag = info.get("ETag") or info.get("etag")
    if not tag or str(tag).startswith("W/"):
        return None
    return f"{tag} {info.get('size')} {info.get('LastModified')}"


def _local_versions(folder: str, name: str) -> dict[str, str]:
    found = {}
    for part in folders_in(folder):
        # Gone or not complete: no version.
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            stat = os.stat(f"{folder}/{part}/{name}")  # noqa: PTH116 - ten thousand of them
            found[part] = f"{stat.st_size} {stat.st_mtime_ns} {stat.st_ctime_ns} {stat.st_ino}"
    return found


class FileDigest(NamedTuple):
    """A file by its name and content."""

    name: str
    size_bytes: int
    sha256: str


def file_digests(path: Path, known: str = "") -> tuple[FileDigest, ...]:
    """A file, or the files directly in a folder, in order of their names.

    `known`: the SHA-256 of the file, if it has been read already; of no use for a folder.
    """
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if file.is_file()]
        return tuple(FileDigest(file.name, file.stat().st_size, _file_digest(file)) for file in files)
    return (FileDigest(path.name, path.stat().st_size, known or _file_digest(path)),)


def digest_of_files(files: Iterable[FileDigest]) -> str:
    """SHA-256 over names and contents."""
    return hashlib.sha256("".join(f"{file.name} {file.sha256}\n" for file in files).encode()).hexdigest()


def content_digest(path: Path, known: str = "") -> str:
    """SHA-256 over names and contents of a file, or of the files directly in a folder; `known` as above."""
    return digest_of_files(file_digests(path, known))


def _file_digest(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


class FileState(NamedTuple):
    """What changes when somebody writes to a file."""

    name: str
    size_bytes: int
    changed_ns: int
    inode: int


def signature(path: Path) -> tuple[FileState, ...]:
    """The state of a file, or of each file directly in a folder."""
    files = sorted(entry for entry in path.iterdir() if entry.is_file()) if path.is_dir() else [path]
    stats = [(file.name, file.stat()) for file in files]
    return tuple(FileState(name, stat.st_size, stat.st_mtime_ns, stat.st_ino) for name, stat in stats)
