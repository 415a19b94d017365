"""The log of a run as a worker holds it: fetched if need be, known by its content, and still the same in the end."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import polars as pl

from pipeline import storage
from pipeline.campaign import known_logs
from pipeline.campaign.outcome import changed
from pipeline.campaign.plan import RunJob
from pipeline.ingest import read_run
from pipeline.results import manifest
from pipeline.storage.address import is_url, redacted
from schemas.errors import BaliseError, InputError
from schemas.run import RunLog


class RecordedLog:
    """`digest` is empty until somebody has read the content: until then no failure is the log's own.

    `files` lists them as the manifest does; `state` is that of its files before anybody read them.
    """

    def __init__(self, job: RunJob) -> None:
        self.digest = self.files = ""
        self._job = job
        self._version: str | None = None
        self.state: tuple[storage.FileState, ...] = ()

    @property
    def size_bytes(self) -> int:
        return sum(file.size_bytes for file in self.state)

    def known_digest(self) -> str:
        """The digest of the log's content, where it can be told without fetching it."""
        self._version = self._stored_version()
        return known_logs.known_digest(self._job, self._version)

    @contextlib.contextmanager
    def here(self) -> Iterator[Path]:
        """The log on this machine; raises `ChangedError` if somebody has written to it meanwhile."""
        with storage.local_copy(self._job.address, self._version) as path, _told_of(self._job, path):
            if self._stored_version() != self._version:
                raise changed(redacted(self._job.address))
            self.state = _signature(path)
            try:
                yield path
            except InputError:
                self._check_unchanged(path)
                raise
            self._check_unchanged(path)

    def read(self, path: Path) -> RunLog:
        """Decode the log."""
        try:
            run = read_run(path, self._job.config.ingest)
        except pl.exceptions.PanicException as error:
            self.digest_at(path)
            reason = str(error).partition("\n")[0]
            raise InputError(f"cannot be decoded, it is damaged: {reason}", place=str(path)) from None
        except Exception:
            self.digest_at(path)
            raise
        self.digest_at(path, run.input_digest)
        return run

    def digest_at(self, path: Path, known: str = "") -> str:
        """What the log holds, kept for the next campaign; `known`: the SHA-256 of a log of one file that was read."""
        if not self.digest:
            with _as_input_error(path):
                listed = storage.file_digests(path, known)
            self.digest, self.files = storage.digest_of_files(listed), manifest.listing(listed)
            known_logs.remember(self._job, self._version, self.digest)
        return self.digest

    def _stored_version(self) -> str | None:
        """What a store says of the log."""
        return storage.version(self._job.address) if is_url(self._job.address) else None

    def _check_unchanged(self, path: Path) -> None:
        if _signature(path) != self.state:
            raise changed(path)


def _signature(path: Path) -> tuple[storage.FileState, ...]:
    with _as_input_error(path):
        return storage.signature(path)


@contextlib.contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", place=str(path)) from None


@contextlib.contextmanager
def _told_of(job: RunJob, path: Path) -> Iterator[None]:
    """Errors name the log by its own address, not by that of a temporary copy."""
    try:
        yield
    except BaliseError as error:
        if error.place and str(path) != job.address:
            error.place = error.place.replace(str(path), redacted(job.address))
        raise
