"""What is there, and its content: lists of folders and globs, many objects at once, whole logs to this machine."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import tempfile
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from pipeline.storage.address import Address, check_public, is_url, name_of, redacted
from pipeline.storage.noted import note, scratch_folder
from pipeline.storage.object_store import arrivals, on_store, open_store
from pipeline.storage.objects import AlteredError, Listing, check_copy, entries_of, kind_of, objects_at, version_in
from schemas.errors import InputError, OutputError, UsageError


def reach(address: Address) -> None:
    """Ask whether the store of an address answers.

    Args:
        address: path, or address in an object store.

    Raises:
        InputError: the store does not answer; local paths answer always.
    """
    if is_url(address):
        on_store(address, kind_of, kind=InputError)


def folders_in(address: Address) -> list[str]:
    """Names of the folders in a folder, sorted; none where it does not exist.

    Args:
        address: path, or address in an object store.

    Returns:
        Names, without what lies above.
    """
    if not is_url(address):
        try:
            return sorted(entry.name for entry in os.scandir(address) if entry.is_dir())
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise OutputError(f"cannot be listed: {error.strerror}", place=str(address)) from None
    entries = on_store(address, entries_of)
    return sorted(name_of(entry["name"]) for entry in entries if entry["type"] == "directory")


def sizes(folder: Address, name: str) -> dict[str, int]:
    """The size of `folder/*/name`.

    Args:
        folder: path or address.
        name: name of the file in each folder.

    Returns:
        Sizes [bytes] by the name of the folder between.
    """
    if is_url(folder):
        listed = on_store(folder, lambda store, path: store.find(path, detail=True))
        return {place.split("/")[-2]: info["size"] for place, info in listed.items() if place.endswith(f"/{name}")}
    places = ((part, Path(folder, part, name)) for part in folders_in(folder))
    return {part: place.stat().st_size for part, place in places if place.exists()}


def files_below(address: Address) -> list[str]:
    """Every file in a folder and in those below, from that folder on, with slashes; sorted.

    Args:
        address: path, or address in an object store.

    Returns:
        Names relative to the folder.
    """
    if not is_url(address):
        walked = os.walk(address, onerror=_raise_listing)
        paths = (Path(folder, name) for folder, _, names in walked for name in names)
        return sorted(file.relative_to(address).as_posix() for file in paths)
    return on_store(address, lambda store, path: sorted(_names_below(store, path.rstrip("/"), "")))


def _raise_listing(error: OSError) -> None:
    """Raise `OutputError` for a folder that cannot be listed, unless it does not exist."""
    if not isinstance(error, FileNotFoundError):
        raise OutputError(f"cannot be listed: {error.strerror}", place=str(error.filename)) from None


def _names_below(store: Any, place: str, before: str) -> Iterator[str]:
    """Paths of all files below a place in a store, folders within it included, each behind `before`."""
    for entry in entries_of(store, place):
        name = f"{before}{name_of(entry['name'])}"
        if entry["type"] == "directory":
            yield from _names_below(store, entry["name"].rstrip("/"), f"{name}/")
        else:
            yield name


def require_match(name: str) -> list[Address]:
    """What a run, a folder or a pattern names; an address as it is.

    Args:
        name: path, folder, pattern or address.

    Returns:
        The addresses, at least one.

    Raises:
        UsageError: nothing matches.
    """
    if matches := _matches(name):
        return matches
    expected = "RUN.mcap, a run folder, a folder of runs or a glob"
    raise UsageError("no such run", place=redacted(name), expected=expected)


def _matches(name: str) -> list[Address]:
    """The runs, folders or addresses that a name or pattern matches; none where nothing does."""
    if is_url(name):
        check_public(name)
        # A question mark in a web address begins its query.
        return [*glob_remote(name)] if glob.has_magic(name) and not name.startswith("http") else [name]
    if Path(name).exists():
        return [Path(name)]
    return [*sorted(Path(match) for match in glob.glob(name, recursive=True))]


def glob_remote(pattern: str) -> list[Address]:
    """Addresses that match a glob in an object store, sorted.

    Args:
        pattern: address with `*`, `?` or `[...]`.

    Returns:
        The addresses.
    """
    return on_store(
        pattern,
        lambda store, path: sorted(store.unstrip_protocol(match) for match in _globbed(store, path)),
        kind=InputError,
    )


def _globbed(store: Any, pattern: str) -> list[str]:
    """Folder by folder: the glob of fsspec leaves out those that the store failed to list."""
    root, *parts = pattern.split("/")
    places = [root]
    for part in parts:
        if part == "**":
            places = [folder for place in places for folder in _folders_below(store, place)]
        elif glob.has_magic(part):
            inside = [entry["name"].rstrip("/") for place in places for entry in entries_of(store, place)]
            places = [name for name in inside if fnmatchcase(name.rpartition("/")[2], part)]
        else:
            places = [f"{place}/{part}" for place in places]
    return [place for place in places if glob.has_magic(parts[-1]) or kind_of(store, place)]


def _folders_below(store: Any, place: str) -> Iterator[str]:
    """A folder in a store, and all folders below it."""
    yield place
    for entry in entries_of(store, place):
        if entry["type"] == "directory":
            yield from _folders_below(store, entry["name"].rstrip("/"))


def read_many(addresses: list[str]) -> dict[str, bytes]:
    """Contents of those of these files that exist, in one go where they lie in a store.

    Args:
        addresses: files, local or in object stores.

    Returns:
        Bytes by address, without those that do not exist.
    """
    if not addresses or not is_url(addresses[0]):
        contents = {address: content_of(address) for address in addresses}
        return {address: content for address, content in contents.items() if content is not None}
    by_path = {open_store(address)[1]: address for address in addresses}

    def fetch(store: Any, _: str) -> dict[str, bytes]:
        """Contents of those files that exist, asked for together; any other error is raised."""
        answers: dict[str, bytes | Exception] = store.cat(list(by_path), on_error="return")
        for content in answers.values():
            if isinstance(content, Exception) and not isinstance(content, FileNotFoundError):
                raise content
        return {by_path[path]: data for path, data in answers.items() if isinstance(data, bytes)}

    # With a single path fsspec would return bare bytes where it is not asked for a list.
    return on_store(addresses[0], fetch)


def content_of(address: Address) -> bytes | None:
    """The content of a file; none where it does not exist.

    Args:
        address: path, or address in an object store.

    Returns:
        The bytes, or None.
    """
    if is_url(address):
        return read_many([str(address)]).get(str(address))
    try:
        return Path(address).read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise OutputError(f"cannot be read: {error.strerror}", place=str(address)) from None


@contextlib.contextmanager
def local_copy(address: Address, version: str | None = None) -> Iterator[Path]:
    """A local path with the content of the address, of a folder the files directly in it; removed afterwards.

    What came is held against names, sizes and digests that the store lists, and the list against `version`, if given.

    Args:
        address: a file or folder, local or in an object store.
        version: what `version` gave when the content was listed; None: not held against it.

    Returns:
        A context with the path.

    Raises:
        InputError: the content is not what the store lists, or no longer that version.
    """
    note(address)
    if not is_url(address):
        yield Path(address)
        return
    with scratch_folder() as folder:
        yield on_store(address, lambda store, path: _fetched(store, path, folder, version), kind=InputError)


def _fetched(store: Any, path: str, folder: Path, version: str | None) -> Path:
    """One attempt, in a folder of its own: what an attempt that failed has left must not pass for content."""
    for left in folder.iterdir():
        shutil.rmtree(left, ignore_errors=True)
    listing = objects_at(store, path)
    if not listing:
        raise FileNotFoundError(path)
    if version is not None and version_in(listing) != version:
        raise AlteredError("changed while it was read")
    target = Path(tempfile.mkdtemp(dir=folder)) / name_of(path)
    copies = _copies(listing, path, target)
    try:
        store.get(list(copies), [str(copy) for copy in copies.values()], callback=arrivals(store))
        for place, copy in copies.items():
            check_copy(store, place, listing[place], copy)
    except FileNotFoundError as error:
        raise AlteredError(f"is listed but cannot be fetched: {error}") from None
    return target


def _copies(listing: Listing, path: str, target: Path) -> dict[str, Path]:
    """Places that the object goes to, or each of those in the folder."""
    if path in listing:
        return {path: target}
    target.mkdir()
    return {place: target / name_of(f"x://{place}") for place in listing}
