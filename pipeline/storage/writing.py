"""Writing: local files appear under their final name by one rename, which a power cut does not undo.

Object stores have no rename, but an object appears there whole or not at all, so that writing the marker of a result
last serves both.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import IO, Any

from pipeline.storage.address import Address, is_url, redacted
from pipeline.storage.object_store import on_store
from schemas.errors import OutputError

# The names, beside their final ones, of files that are being written; what a killed process leaves is found by it.
_RANDOM_BYTES = 6
UNFINISHED = f".*.{'[0-9a-f]' * 2 * _RANDOM_BYTES}.tmp"
_OF_THE_NAME = 100
# What file systems answer whose folders need no syncing, or cannot be synced.
_NOT_SYNCED = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES)


def absolute(address: Address) -> str:
    """The address as a worker with another working directory understands it.

    Args:
        address: path, or address in an object store.

    Returns:
        An absolute path, or the address as it is.
    """
    return str(address) if is_url(address) else str(Path(address).absolute())


def write_bytes(address: Address, content: bytes) -> None:
    """Write a file that is there whole or not at all.

    Args:
        address: path, or address in an object store.
        content: the bytes.

    Raises:
        OutputError: it cannot be written.
    """
    commit([stage(address, content)])


def stage(address: Address, content: bytes) -> tuple[Address, Address]:
    """Put the content next to its final place (object stores: at it); `commit` gives it its name.

    Args:
        address: path, or address in an object store.
        content: the bytes.

    Returns:
        Where the content is, and the final address.
    """
    if is_url(address):
        on_store(address, lambda store, path: store.pipe_file(path, content))
        return address, address
    final = Path(address)
    temporary = _temporary(final)
    with as_output_error(address), _writing(temporary) as file:
        file.write(content)
    return temporary, final


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A file to write to that is there under its name when it is whole, and not at all where writing fails.

    Args:
        path: the final path.

    Returns:
        A context with the open file.
    """
    temporary = _temporary(path)
    with as_output_error(path), _writing(temporary) as file:
        yield file
    commit([(temporary, path)])


def replace_files(folder: Path, contents: Mapping[str, bytes | None], marker: str) -> None:
    """Write files of one folder, and remove those without content; the marker goes first and comes last.

    So a folder with its marker is whole, whenever somebody looks.

    Args:
        folder: a local folder.
        contents: bytes by file name; None removes the file.
        marker: the file that says that the folder is whole.
    """
    staged: list[tuple[Address, Address]] = []
    try:
        for name in sorted(contents, key=lambda name: name == marker):
            if (content := contents[name]) is not None:
                staged.append(stage(folder / name, content))
        for name in sorted(contents, key=lambda name: name != marker):
            if name == marker or contents[name] is None:
                remove(folder / name)
        commit(staged)
    except BaseException:
        discard(staged)
        raise


def _temporary(final: Path) -> Path:
    """A hidden name, not yet taken, beside the final one."""
    return final.with_name(f".{final.name[:_OF_THE_NAME]}.{secrets.token_hex(_RANDOM_BYTES)}.tmp")


@contextlib.contextmanager
def _writing(temporary: Path) -> Iterator[IO[bytes]]:
    """A file that is on the disk in the end, or gone."""
    temporary.parent.mkdir(parents=True, exist_ok=True)
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


class SweptError(OutputError):
    """Staged files are gone: another campaign took them for those of one that had ended."""


def commit(staged: list[tuple[Address, Address]]) -> None:
    """Give staged files their names, in order, the last when the others are sure to stay.

    Whatever fails, nothing stays that has no name yet.

    Args:
        staged: pairs of where the content is and its final address.

    Raises:
        SweptError: somebody removed one of them.
    """
    try:
        _commit(staged)
    except BaseException:
        discard(staged)
        raise


def _commit(staged: list[tuple[Address, Address]]) -> None:
    """Rename the staged files on this machine, the last one once the others are on the disk."""
    local = [(Path(temporary), Path(final)) for temporary, final in staged if temporary != final]
    for part in (local[:-1], local[-1:]):
        for temporary, final in part:
            with as_output_error(final):
                try:
                    temporary.replace(final)
                except FileNotFoundError:
                    raise SweptError("was removed while it was written", place=str(final)) from None
        _sync(final for _, final in part)


def _sync(files: Iterable[Path]) -> None:
    """Fsync the folders, so that new names survive a power cut; Windows opens no folder."""
    if os.name == "nt":
        return
    for folder in {above for file in files for above in (file.parent, file.parent.parent)}:
        with as_output_error(folder):
            number = os.open(folder, os.O_RDONLY)
            try:
                os.fsync(number)
            except OSError as error:
                if error.errno not in _NOT_SYNCED:
                    raise
            finally:
                os.close(number)


def discard(staged: list[tuple[Address, Address]]) -> None:
    """Drop staged files that will not be committed.

    Args:
        staged: pairs as `stage` yields them.
    """
    for temporary, final in staged:
        if temporary != final:
            Path(temporary).unlink(missing_ok=True)


def unfinished_in(folder: Path | str) -> list[str]:
    """Names of files in a folder that were being written; none where it does not exist.

    Args:
        folder: path of a folder.

    Returns:
        File names.
    """
    with as_output_error(folder):
        try:
            names = os.listdir(folder)  # noqa: PTH208 - of thousands of folders
        except (FileNotFoundError, NotADirectoryError):
            return []
    return [name for name in names if fnmatchcase(name, UNFINISHED)]


def remove(address: Address) -> None:
    """Remove a file; its absence is no error.

    Args:
        address: path, or address in an object store.
    """
    if is_url(address):
        _remove_remote(address, lambda store, path: store.rm_file(path))
        return
    with as_output_error(address), contextlib.suppress(FileNotFoundError):
        Path(address).unlink()
        _sync([Path(address)])


def remove_folder(address: Address) -> None:
    """Remove a folder with all that is in it; its absence is no error.

    Args:
        address: path, or address in an object store.
    """
    if is_url(address):
        _remove_remote(address, lambda store, path: store.rm(path, recursive=True))
    else:
        shutil.rmtree(address, ignore_errors=True)


def remove_folders(folders: Sequence[Address]) -> None:
    """Remove folders that lie in one with all that is in them, so that a power cut does not bring one back.

    Args:
        folders: addresses with one parent.
    """
    for folder in folders:
        if is_url(folder):
            remove_folder(folder)
            continue
        with as_output_error(folder), contextlib.suppress(FileNotFoundError):
            shutil.rmtree(folder)
    if folders and not is_url(folders[0]):
        _sync([Path(folders[0])])


def _remove_remote(address: Address, operation: Callable[[Any, str], None]) -> None:
    """Run a removal on the store of an address; that nothing is there is no error."""

    def delete(store: Any, path: str) -> None:
        """The removal, content with nothing to remove."""
        with contextlib.suppress(FileNotFoundError):
            operation(store, path)

    on_store(address, delete)


@contextlib.contextmanager
def as_output_error(address: Address) -> Iterator[None]:
    """Turn what an operating system or a store raises into one message that names the place.

    Args:
        address: path, or address in an object store.

    Returns:
        A context in which to write there.

    Raises:
        OutputError: the system or the store failed.
    """
    try:
        yield
    except OSError as error:
        reason = redacted(error.strerror or str(error) or type(error).__name__)
        raise OutputError(
            f"cannot be written: {reason}",
            place=redacted(str(address)),
            remedy="Free space or choose another --out; complete runs are kept, and skipped next time.",
        ) from None
