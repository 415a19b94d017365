"""`OUT/.catalogue`: what saves time with the next call, no part of the result. It may be deleted at any time.

An entry is its SHA-256, the key of what it was made from, and its content. Whatever is damaged, unreadable or made from
something else counts as not there. No question is answered from it but what became of a run (`campaign/resume.py`).
"""

from __future__ import annotations

import hashlib

from pipeline import storage
from pipeline.storage.address import Address, join
from schemas.errors import OutputError

FOLDER = ".catalogue"


def keep(out: Address, name: str, key: str, content: bytes) -> None:
    """Keep content that was made from what `key` stands for."""
    entry = f"{key}\n".encode() + content
    storage.write_bytes(_address(out, name), hashlib.sha256(entry).hexdigest().encode() + b"\n" + entry)


def kept_content(out: Address, name: str, key: str) -> bytes | None:
    """The content kept under this name and key; None where it is missing, damaged or made from something else."""
    try:
        digest, _, entry = (storage.content_of(_address(out, name)) or b"").partition(b"\n")
    except OutputError:
        return None
    made_from, _, content = entry.partition(b"\n")
    is_whole = digest.decode(errors="replace") == hashlib.sha256(entry).hexdigest()
    return content if is_whole and made_from == key.encode() else None


def _address(out: Address, name: str) -> Address:
    """Address of a file that is kept with the results."""
    return join(join(out, FOLDER), name)
