"""Writing: local files appear under their final name by one rename.

Object stores have no rename, but an object appears there whole or not at all, so that writing the marker of a result
last serves both.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from pipeline.storage.address import Address, is_url, redacted
from pipeline.storage.object_store import on_store
from schemas.errors import OutputError

# The names, beside their final ones, of files that are being written; what a killed process leaves is found by it.
_RANDOM_BYTES = 6
UNFINISHED = f".*.{'[0-9a-f]' * 2 * _RANDOM_BYTES}.tmp"


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
    temporary = final.with_name(f".{final.name}.{secrets.token_hex(_RANDOM_BYTES)}.tmp")
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
    if is_url(address):
        _remove_remote(address, lambda store, path: store.rm_file(path))
        return
    with as_output_error(address):
        Path(address).unlink(missing_ok=True)


def remove_folder(address: Address) -> None:
    """Remove a folder with all that is in it; its absence is no error."""
    if is_url(address):
        _remove_remote(address, lambda store, path: store.rm(path, recursive=True))
    else:
        shutil.rmtree(address, ignore_errors=True)


def _remove_remote(address: Address, operation: Callable[[Any, str], None]) -> None:
    def delete(store: Any, path: str) -> None:
        with contextlib.suppress(FileNotFoundError):
            operation(store, path)

    on_store(address, delete)


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
