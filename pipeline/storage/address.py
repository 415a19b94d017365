"""Paths and addresses: what they are called, put together, and shown."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from schemas.errors import UsageError

Address = Path | str

# User and password up to the last @ (a key may hold slashes), what follows a question mark, keys by their looks.
_SECRETS = re.compile(
    r"(?<=://)(?:[^/@:\s]*:[^\s]*|[^/@\s]+)@|(?<=://)(?!arn:)[^/\s:@]+:(?!\d+(?:[/\s]|$))[^\s'\"]*"
    r"|\?[^\s'\"]*|(?:AKIA|ASIA)[A-Z0-9]{12,}"
)
_BUCKETS = re.compile(r"s3a?://(?!arn:)[^/]*[:@]")


def is_url(path: Address) -> bool:
    """Whether the path is an address with a protocol (`s3://bucket/run.mcap`)."""
    return isinstance(path, str) and "://" in path


def redacted(text: str) -> str:
    """The text without user names, passwords, keys and signatures that addresses may carry."""
    return _SECRETS.sub("", text)


def shown(path: Address) -> str:
    """The path as messages name it."""
    return redacted(str(path)) if is_url(path) else str(path)


def check_public(path: Address) -> None:
    """Refuse a bucket's address with a key in it: no store reads it there, and error messages would repeat it."""
    if _BUCKETS.match(str(path)):
        raise UsageError(
            "has credentials or a port, which are not allowed in the address of a bucket",
            place=redacted(str(path)),
            expected="s3://BUCKET/...",
            remedy="Set AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and AWS_ENDPOINT_URL in the environment.",
        )


def name_of(path: Address) -> str:
    """The last part of the path, without a trailing slash, nor the signature that a web address may carry."""
    if not is_url(path):
        return Path(path).name
    bare = str(path).partition("?")[0] if str(path).startswith("http") else str(path)
    return PurePosixPath(bare.rstrip("/")).name


def stem_of(path: Address) -> str:
    """The run id: the name without `.mcap`."""
    return name_of(path).removesuffix(".mcap")


def join(path: Address, name: str) -> Address:
    """What has this name in a folder."""
    return f"{str(path).rstrip('/')}/{name}" if is_url(path) else Path(path, name)


def is_geojson(address: Address) -> bool:
    """Whether a name is that of a network as registers of infrastructure export it, all in one file."""
    return name_of(address).lower().endswith(".geojson")
