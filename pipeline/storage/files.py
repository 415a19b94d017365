"""Reading by path or address: local paths, and `s3://`-style addresses with the patience of `object_store`.

All that ingest reads goes through here, so that both kinds behave alike. Raises `InputError` that names the place.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, TypeVar

from pipeline.storage.address import Address, is_url, name_of
from pipeline.storage.fetching import local_copy
from pipeline.storage.noted import note
from pipeline.storage.object_store import on_store
from pipeline.storage.objects import kind_of
from schemas.errors import InputError

T = TypeVar("T")

# Fetched of an object at once [bytes].
_LEAST_PART = 262_144


def exists(path: Address) -> bool:
    """Whether something lies at an address."""
    return _run_local_or_remote(path, Path.exists, lambda store, inner: bool(kind_of(store, inner)))


def is_dir(path: Address) -> bool:
    """Whether a folder lies at an address."""
    return _run_local_or_remote(path, Path.is_dir, lambda store, inner: kind_of(store, inner) == "directory")


def list_dir(path: Address) -> list[str]:
    """Names in a folder, sorted."""
    return _run_local_or_remote(
        path,
        lambda folder: sorted(entry.name for entry in folder.iterdir()),
        lambda store, inner: sorted(name_of(f"x://{entry}") for entry in store.ls(inner, detail=False)),
    )


def open_binary(path: Address) -> IO[bytes]:
    """A seekable binary file; of an address a copy on this machine, whose room is free again once it is closed."""
    with local_copy(path) as file:
        return _local(file, lambda present: _regular(present).open("rb", buffering=0))


def read_bytes(path: Address) -> bytes:
    """The content of a file, local or in a store."""
    with local_copy(path) as file:
        return _local(file, lambda present: _regular(present).read_bytes())


def in_parts(path: Address) -> Path | io.BufferedReader:
    """What a reader takes that asks for parts of a file; of an address those parts alone are fetched."""
    note(path)
    return io.BufferedReader(_Parts(str(path)), _LEAST_PART) if is_url(path) else Path(path)


class _Parts(io.RawIOBase):
    """An object that never changes, fetched in parts."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._size = size_of(address)
        self._at = 0

    def readable(self) -> bool:
        """Whether it can be read, as every file that is read."""
        return True

    def seekable(self) -> bool:
        """Any part can be read first."""
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Go to a place; the new place."""
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """The place."""
        return self._at

    def readinto(self, buffer: Any) -> int:
        """Fill a buffer from the store; how many bytes came."""
        end = min(self._at + len(buffer), self._size)
        if end <= self._at:
            return 0
        part = on_store(self._address, lambda store, path: store.cat_file(path, self._at, end), kind=InputError)
        buffer[: len(part)] = part
        self._at += len(part)
        return len(part)


def require_regular(path: Address) -> None:
    """Refuse pipes and devices on this machine."""
    if not is_url(path):
        _local(path, _regular)


def _regular(path: Path) -> Path:
    """The file, unless it is a pipe or a device: reading one can last for ever."""
    path.stat()  # a link to nothing, or to itself, is an error
    if not (path.is_file() or path.is_dir()):
        raise InputError("is no regular file", place=str(path), expected="a file or folder")
    return path


def size_of(path: Address) -> int:
    """Size of a file [bytes]."""
    return _run_local_or_remote(path, lambda file: file.stat().st_size, lambda store, inner: int(store.size(inner)))


def _run_local_or_remote(path: Address, local: Callable[[Path], T], remote: Callable[[Any, str], T]) -> T:
    """Run one operation on a local path or the other on a store, noting that the place was read."""
    note(path)
    return on_store(path, remote, kind=InputError) if is_url(path) else _local(path, local)


def _local(path: Address, operation: Callable[[Path], T]) -> T:
    """What an operating system raises, as one message that names the place."""
    try:
        return operation(Path(path))
    except FileNotFoundError:
        raise InputError(
            "does not exist", place=str(path), expected="a file or folder", remedy="Check the path."
        ) from None
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        raise InputError(f"cannot be read: {reason}", place=str(path)) from None
