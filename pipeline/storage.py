"""Where results go: local folders and object stores behind the same few operations.

Local files appear under their final name by one rename. Object stores have no rename, but an object
appears there whole or not at all, so that writing the marker last serves both.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pipeline.ingest.files import Address, is_url, name_of
from pipeline.remote import arrivals, on_store, opened, redacted
from schemas.errors import BaliseError, InputError, OutputError

_BLOCK_BYTES = 1 << 20


def absolute(address: Address) -> str:
    """The address as a worker with another working directory understands it."""
    return str(address) if is_url(address) else str(Path(address).absolute())


def write_bytes(address: Address, content: bytes) -> None:
    """Write a file that is there whole or not at all."""
    commit([stage(address, content)])


def stage(address: Address, content: bytes) -> tuple[Address, Address]:
    """Put the content beside its final place (object stores: at it); `commit` gives it its name."""
    if is_url(address):
        on_store(address, lambda store, path: store.pipe_file(path, content))
        return address, address
    final = Path(address)
    temporary = final.with_name(f".{final.name}.{secrets.token_hex(6)}.tmp")
    with as_output_error(address):
        final.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    return temporary, final


class SweptError(OutputError):
    """Staged files are gone: another campaign took them for those of one that had ended."""


def commit(staged: list[tuple[Address, Address]]) -> None:
    """Give staged files their names, in order. Raises `SweptError` where somebody removed one."""
    for temporary, final in staged:
        if temporary != final:
            with as_output_error(final):
                try:
                    Path(temporary).replace(final)
                except FileNotFoundError:
                    raise SweptError("was removed while it was written", place=str(final)) from None


def discard(staged: list[tuple[Address, Address]]) -> None:
    """Drop staged files that will not be committed."""
    for temporary, final in staged:
        if temporary != final:
            Path(temporary).unlink(missing_ok=True)


def remove(address: Address) -> None:
    """Remove a file; its absence is no error."""
    if not is_url(address):
        with as_output_error(address):
            Path(address).unlink(missing_ok=True)
        return

    def delete(store: Any, path: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            store.rm_file(path)

    on_store(address, delete)


def remove_folder(address: Address) -> None:
    """Remove a folder with all that is in it; its absence is no error."""
    if not is_url(address):
        shutil.rmtree(address, ignore_errors=True)
        return

    def delete(store: Any, path: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            store.rm(path, recursive=True)

    on_store(address, delete)


def reach(address: Address, kind: type[BaliseError] = InputError) -> None:
    """Raises where the store of an address does not answer; local paths answer always.

    For reading through `ingest.files`, whose patience is that of the store's own library: many minutes.
    """
    if is_url(address):
        on_store(address, lambda store, path: store.isdir(path), kind=kind)


def folders_in(address: Address) -> list[str]:
    """Names of the folders in a folder, sorted; none where it does not exist."""
    if not is_url(address):
        try:
            return sorted(entry.name for entry in os.scandir(address) if entry.is_dir())
        except (FileNotFoundError, NotADirectoryError):
            return []

    def names(store: Any, path: str) -> list[str]:
        try:
            entries = store.ls(path, detail=True)
        except FileNotFoundError:
            return []
        return sorted(name_of(entry["name"]) for entry in entries if entry["type"] == "directory")

    return on_store(address, names)


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


def glob_remote(pattern: str) -> list[Address]:
    """Addresses that match a glob in an object store, sorted."""
    return [
        str(found)
        for found in on_store(
            pattern, lambda store, path: sorted(store.unstrip_protocol(p) for p in store.glob(path)), kind=InputError
        )
    ]


def read_many(addresses: list[str]) -> dict[str, bytes]:
    """Contents of those of the remote objects that exist."""
    if not addresses:
        return {}
    by_path = {opened(address)[1]: address for address in addresses}

    def fetch(store: Any, _: str) -> dict[str, bytes]:
        found: dict[str, bytes | Exception] = store.cat(list(by_path), on_error="return")
        for content in found.values():
            if isinstance(content, Exception) and not isinstance(content, FileNotFoundError):
                raise content
        return {by_path[path]: data for path, data in found.items() if isinstance(data, bytes)}

    # With a single path fsspec would return bare bytes where it is not asked for a list.
    return on_store(addresses[0], fetch)


@contextlib.contextmanager
def local_copy(address: Address) -> Iterator[Path]:
    """A local path with the content of the address; downloads are removed afterwards."""
    if not is_url(address):
        yield Path(address)
        return
    with tempfile.TemporaryDirectory(prefix="balise-") as folder:
        target = Path(folder) / name_of(address)

        def fetch(store: Any, path: str) -> None:
            store.get(path, str(target), recursive=store.isdir(path), callback=arrivals(store))

        on_store(address, fetch, kind=InputError)
        yield target


def content_digest(path: Path, known: str = "") -> str:
    """SHA-256 over names and contents of a file, or of the files directly in a folder.

    `known`: the SHA-256 of the file, if it has been read already; of no use for a folder.
    """
    if path.is_dir():
        digests = {file.name: _file_digest(file) for file in sorted(path.iterdir()) if file.is_file()}
    else:
        digests = {path.name: known or _file_digest(path)}
    return hashlib.sha256("".join(f"{name} {digest}\n" for name, digest in digests.items()).encode()).hexdigest()


def _file_digest(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        while block := stream.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def signature(path: Path) -> tuple[tuple[str, int, int, int], ...]:
    """What changes when somebody writes to a file while it is read: size, time of change, identity."""
    files = sorted(entry for entry in path.iterdir() if entry.is_file()) if path.is_dir() else [path]
    stats = [(file.name, file.stat()) for file in files]
    return tuple((name, stat.st_size, stat.st_mtime_ns, stat.st_ino) for name, stat in stats)


@contextlib.contextmanager
def as_output_error(address: Address) -> Iterator[None]:
    """Turn what an operating system or a store raises into one message that names the place."""
    try:
        yield
    except OSError as error:
        reason = redacted(error.strerror or str(error) or type(error).__name__)
        raise OutputError(
            f"cannot be written: {reason}",
            place=redacted(str(address)),
            remedy="Free space or choose another --out; complete runs stay and are skipped next time.",
        ) from None
