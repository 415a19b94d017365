"""The log of a run as a worker holds it: fetched if need be, known by its content, and still the same in the end."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator
from pathlib import Path

import polars as pl

from pipeline import storage
from pipeline.campaign.outcome import changed_error
from pipeline.campaign.plan import RunJob
from pipeline.read.ingest import read_run
from pipeline.results import catalogue, manifest
from pipeline.storage.address import is_url, redacted
from schemas.errors import BaliseError, InputError
from schemas.run import RunLog


class RecordedLog:
    """`digest` is empty until somebody has read the content: until then no failure is the log's own.

    `files` lists them as the manifest does, `raw_files` the raw logs that it was converted from; `state` is that of its
    files before anybody read them.

    An object store gives each object an entity tag that changes with its content. Beside the result stands which
    content (SHA-256 of the files) stood behind which tag of this run: `OUT/.catalogue/inputs`. That stays true whatever
    happens to log and result later. What it does not name is fetched and read.
    """

    def __init__(self, job: RunJob) -> None:
        self.digest = self.files = self.raw_files = ""
        self._job = job
        self._version: str | None = None
        self.state: tuple[storage.FileState, ...] = ()

    def known_digest(self) -> str:
        """The digest of the log's content, where it is known without fetching it."""
        self._version = self._stored_version()
        if self._version is None or self._job.previous is None:
            return ""
        return (catalogue.kept_content(self._job.out, self._note_name(), self._log_key()) or b"").decode()

    def _note_name(self) -> str:
        """Name of the file that keeps what is known of a log from campaign to campaign."""
        return f"inputs/{hashlib.sha256(self._job.run_id.encode()).hexdigest()}.txt"

    def _log_key(self) -> str:
        """One key for address and version: the address itself may hold what is nobody's business."""
        return hashlib.sha256(f"{self._job.address}\n{self._version}".encode()).hexdigest()

    @contextlib.contextmanager
    def local_copy(self) -> Iterator[Path]:
        """The log on this machine; raises `ChangedError` if somebody has written to it meanwhile."""
        with storage.local_copy(self._job.address, self._version) as path, _with_own_address(self._job, path):
            if self._stored_version() != self._version:
                raise changed_error(redacted(self._job.address))
            self.state = _signature(path)
            try:
                yield path
            except InputError:
                self._check_unchanged(path)
                raise
            self._check_unchanged(path)

    def read(self, path: Path) -> RunLog:
        """Read the run from a local copy; a file that makes the reader panic is damaged."""
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
        self.raw_files = manifest.file_list_text(run.notes.raw_logs) if run.notes.raw_logs else ""
        return run

    def digest_at(self, path: Path, known: str = "") -> str:
        """What the log holds, kept for the next campaign; `known`: the SHA-256 of a log of one file that was read."""
        if not self.digest:
            with _as_input_error(path):
                listed = storage.file_digests(path, known)
            self.digest = storage.digest_of_files(listed)
            self.files = manifest.file_list_text(listed)
            if self._version is not None:
                catalogue.keep(self._job.out, self._note_name(), self._log_key(), self.digest.encode())
        return self.digest

    def _stored_version(self) -> str | None:
        """Version of a log in an object store; none for a local one."""
        return storage.version(self._job.address) if is_url(self._job.address) else None

    def _check_unchanged(self, path: Path) -> None:
        """Refuse a log that changed since it was first looked at."""
        if _signature(path) != self.state:
            raise changed_error(path)


def _signature(path: Path) -> tuple[storage.FileState, ...]:
    """Size and time of change of each file of a log."""
    with _as_input_error(path):
        return storage.signature(path)


@contextlib.contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    """Report what the system reports as an error of the input."""
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", place=str(path)) from None


@contextlib.contextmanager
def _with_own_address(job: RunJob, path: Path) -> Iterator[None]:
    """Errors name the log by its own address, not by that of a temporary copy."""
    try:
        yield
    except BaliseError as error:
        if error.place and str(path) != job.address:
            error.place = error.place.replace(str(path), redacted(job.address))
        raise
