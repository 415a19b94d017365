"""What a store says of its objects, and whether what came is what it said."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.storage.address import name_of

Listing = dict[str, dict[str, Any]]

_MD5 = re.compile(r'"?([0-9a-f]{32})"?')
# How a store encrypts where the entity tag is the MD5 of the content all the same.
_PLAIN = (None, "AES256")


class AlteredError(Exception):
    """What came is not what the store lists; another attempt may bring it."""


def objects_at(store: Any, path: str) -> Listing:
    """What a store tells of an object, or of each object directly in a folder, by its path.

    `find`, `exists` and `isdir` of fsspec say that nothing is there, too, where the store has only failed to answer.
    """
    try:
        info = store.info(path)
    except FileNotFoundError:
        return {}
    entries = entries_of(store, path) if info["type"] == "directory" else [info]
    return {entry["name"]: entry for entry in entries if entry["type"] != "directory"}


def entries_of(store: Any, folder: str) -> list[dict[str, Any]]:
    """What lies in a folder; nothing where it does not exist."""
    try:
        entries = store.ls(folder, detail=True)
    except FileNotFoundError:
        return []
    return [entry for entry in entries if entry["name"].strip("/") != folder.strip("/")]


def kind_of(store: Any, path: str) -> str:
    """`file` or `directory`; empty where there is neither."""
    try:
        return str(store.info(path)["type"])
    except FileNotFoundError:
        return ""


def version_of(info: Mapping[str, Any]) -> str | None:
    """An object's entity tag, size and time; weak tags stand for other content too, and are none."""
    tag = info.get("ETag") or info.get("etag")
    if not tag or str(tag).startswith("W/"):
        return None
    return f"{tag} {info.get('size')} {info.get('LastModified')}"


def version_in(listing: Listing) -> str | None:
    """What changes with the content of any of these objects; none where one of them has no version."""
    versions = {place: version_of(info) for place, info in listing.items()}
    if not versions or None in versions.values():
        return None
    return "\n".join(f"{name_of(place)} {text}" for place, text in sorted(versions.items()))


def check_copy(store: Any, place: str, info: Mapping[str, Any], copy: Path) -> None:
    """Raises `AlteredError` unless the copy has the size, and where its entity tag is a digest also the content."""
    size = copy.stat().st_size
    listed = info.get("size")
    if listed is not None and size != listed:
        raise AlteredError(f"{name_of(place)} came with {size} bytes, and {listed} are listed")
    tag = _MD5.fullmatch(str(info.get("ETag", "")))
    if tag is None:
        return
    with copy.open("rb") as stream:
        digest = hashlib.file_digest(stream, lambda: hashlib.md5(usedforsecurity=False)).hexdigest()
    if digest != tag[1] and _tag_is_digest(store, place):
        raise AlteredError(f"{name_of(place)} came with other content than its entity tag says")


def _tag_is_digest(store: Any, place: str) -> bool:
    """Whether the tag is the MD5 of the content: of S3 objects, unless they lie encrypted with a key of one's own."""
    if not hasattr(store, "call_s3"):
        return False
    bucket, key, _ = store.split_path(place)
    head = store.call_s3("head_object", Bucket=bucket, Key=key)
    return head.get("ServerSideEncryption") in _PLAIN and "SSECustomerAlgorithm" not in head
