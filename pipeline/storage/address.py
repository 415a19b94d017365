"""Paths and addresses: what they are called, put together, and shown."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

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
    """What has this name in a folder."""
    return f"{str(path).rstrip('/')}/{name}" if is_url(path) else Path(path) / name
