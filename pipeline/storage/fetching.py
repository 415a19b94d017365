"""What is there, and its content: lists of folders and globs, many objects at once, whole logs to this machine."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.storage.address import Address, is_url, name_of
from pipeline.storage.object_store import arrivals, on_store, opened
from schemas.errors import InputError


def reach(address: Address) -> None:
    """Raises `InputError` where the store of an address does not answer; local paths answer always."""
    if is_url(address):
        on_store(address, lambda store, path: store.isdir(path), kind=InputError)


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


def content_of(address: Address) -> bytes | None:
    """The content of a file; none where it does not exist."""
    if is_url(address):
        return read_many([str(address)]).get(str(address))
    try:
        return Path(address).read_bytes()
    except FileNotFoundError:
        return None


@contextlib.contextmanager
def local_copy(address: Address) -> Iterator[Path]:
    """A local path with the content of the address; downloads are removed afterwards."""
    if not is_url(address):
        yield Path(address)
        return
    with tempfile.TemporaryDirectory(prefix="balise-") as folder:
        target = Path(folder) / name_of(address)

        def fetch(store: Any, path: str) -> None:
            if store.isdir(path):
                store.get(path, str(target), recursive=True, callback=arrivals(store))
            else:
                store.get_file(path, str(target), callback=arrivals(store))

        on_store(address, fetch, kind=InputError)
        yield target
