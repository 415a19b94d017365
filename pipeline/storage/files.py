"""Access to files by path or address: local paths, and `s3://`-style addresses through fsspec.

Everything that ingest and campaigns read goes through here, so that both kinds behave alike.
fsspec is imported only for addresses.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import IO, Any

from schemas.errors import InputError

Address = Path | str

_SECRETS = re.compile(r"(?<=://)[^/@\s]+@|\?[^\s'\"]*|((?:AKIA|ASIA)[A-Z0-9]{12,})")


def is_url(path: Address) -> bool:
    """Whether the path is an address with a protocol (`s3://bucket/run.mcap`)."""
    return isinstance(path, str) and "://" in path


def redacted(text: str) -> str:
    """The text without user names, passwords, keys and signatures that addresses may carry."""
    return _SECRETS.sub("", text)


def shown(path: Address) -> str:
    """The path as messages name it."""
    return redacted(str(path)) if is_url(path) else str(path)


def name_of(path: Address) -> str:
    """The last part of the path, without a trailing slash."""
    return PurePosixPath(str(path).rstrip("/")).name if is_url(path) else Path(path).name


def stem_of(path: Address) -> str:
    """The run id: the name without `.mcap`."""
    return name_of(path).removesuffix(".mcap")


def join(path: Address, name: str) -> Address:
    return f"{str(path).rstrip('/')}/{name}" if is_url(path) else Path(path) / name


def exists(path: Address) -> bool:
    if not is_url(path):
        return Path(path).exists()
    filesystem, inner = _filesystem(str(path))
    with _as_input_error(path):
        return bool(filesystem.exists(inner))


def is_dir(path: Address) -> bool:
    if not is_url(path):
        return Path(path).is_dir()
    filesystem, inner = _filesystem(str(path))
    with _as_input_error(path):
        return bool(filesystem.isdir(inner))


def list_dir(path: Address) -> list[str]:
    """Names in a folder, sorted."""
    with _as_input_error(path):
        if not is_url(path):
            return sorted(entry.name for entry in Path(path).iterdir())
        filesystem, inner = _filesystem(str(path))
        return sorted(name_of(f"x://{entry}") for entry in filesystem.ls(inner, detail=False))


def open_binary(path: Address) -> IO[bytes]:
    """A seekable binary file."""
    with _as_input_error(path):
        if not is_url(path):
            return Path(path).open("rb", buffering=0)
        filesystem, inner = _filesystem(str(path))
        stream: IO[bytes] = filesystem.open(inner, "rb")
        return stream


def read_bytes(path: Address) -> bytes:
    """The whole content."""
    with open_binary(path) as stream, _as_input_error(path):
        return stream.read()


def size_of(path: Address) -> int:
    """Size in bytes."""
    with _as_input_error(path):
        if not is_url(path):
            return Path(path).stat().st_size
        filesystem, inner = _filesystem(str(path))
        return int(filesystem.size(inner))


def _filesystem(url: str) -> tuple[Any, str]:
    import fsspec

    try:
        filesystem, inner = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError(
            f"cannot be opened: {redacted(str(error))}",
            place=redacted(url),
            remedy="Install the extra for this kind of address.",
        ) from None
    return filesystem, str(inner)


class _as_input_error:  # noqa: N801 - reads as a phrase at its uses
    """Turns what an operating system or a store raises into one message that names the place."""

    def __init__(self, path: Address) -> None:
        self.path = path
        self.place = shown(path)

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, FileNotFoundError):
            raise InputError(
                "does not exist", place=self.place, expected="a file or folder", remedy="Check the path."
            ) from None
        if isinstance(error, OSError):
            reason = error.strerror or str(error) or type(error).__name__
            raise InputError(f"cannot be read: {reason}", place=self.place) from None
        if isinstance(error, Exception) and is_url(self.path) and not isinstance(error, InputError):
            # Stores raise their client library's own exceptions, which share no base class.
            reason = str(error) or type(error).__name__
            raise InputError(f"cannot be read: {redacted(reason)}", place=self.place) from None
