"""Logs of object stores that need not be fetched again to know that they are the same.

A store gives each object an entity tag that changes with its content. Beside the result stands, per run, which content
(SHA-256 of the files) stood behind which tag: `OUT/.catalogue/inputs`. That stays true whatever happens to log and
result later, so that it may be looked up at any time. What it does not name is fetched and read.
"""

from __future__ import annotations

import hashlib

from pipeline import storage
from pipeline.campaign.plan import RunJob
from pipeline.storage.address import Address, join


def known_digest(job: RunJob, version: str | None) -> str:
    """Digest of the log's files as of this version; empty where nobody has read it at this version."""
    if version is None or job.previous is None:
        return ""
    name, _, digest = (storage.content_of(_address(job)) or b"").decode().partition(" ")
    return digest if name == _name(job, version) else ""


def remember(job: RunJob, version: str | None, files_digest: str) -> None:
    """Keep what was read of a log at this version."""
    if version is not None:
        storage.write_bytes(_address(job), f"{_name(job, version)} {files_digest}".encode())


def _name(job: RunJob, version: str) -> str:
    """One name for address and version: the address itself may hold what is nobody's business."""
    return hashlib.sha256(f"{job.address}\n{version}".encode()).hexdigest()


def _address(job: RunJob) -> Address:
    return join(join(join(job.out, ".catalogue"), "inputs"), f"{hashlib.sha256(job.run_id.encode()).hexdigest()}.txt")
