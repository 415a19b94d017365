"""Which inputs a step has read, and what they held: noted at the door that each of them is opened through.

Every function that opens an input, asks whether it is there, or lists a folder calls `note` first. Inside `noting` that
is kept, with the state of the place before anybody read it; outside nothing happens. What a step has asked for and not
found counts as read: a file that comes into being later changes what the step makes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from tempfile import TemporaryDirectory

from pipeline.storage.address import Address, is_url
from pipeline.storage.identity import FileDigest, file_digest, file_digests, signature, version
from schemas.errors import BaliseError

NO_DIGEST = ""
"""Of what cannot be digested, or changed while it was read: nobody knows whether it is the same."""


class Noted:
    """The inputs of a step: places on this machine, absolute and not resolved, and addresses."""

    def __init__(self, around: Noted | None = None) -> None:
        self._around = around
        self._states: dict[str, object] = {}
        self._scratch: list[str] = []

    def note(self, place: Address) -> None:
        """Remember the state of a place that a step reads."""
        if self._around is not None:
            self._around.note(place)
        text = str(place) if is_url(place) else str(Path(place).absolute())
        if text not in self._states and not any(text.startswith(folder) for folder in self._scratch):
            self._states[text] = _state(text)

    def leave_out(self, folder: Path) -> None:
        """What is made of inputs and read in turn is none itself."""
        if self._around is not None:
            self._around.leave_out(folder)
        self._scratch.append(f"{folder.absolute()}{os.sep}")

    def digests(self) -> dict[str, str]:
        """Digest of each place's content when it was read; `NO_DIGEST` where that is not known."""
        return {
            place: digest_now(place) if state == _state(place) else NO_DIGEST for place, state in self._states.items()
        }

    def listing(self) -> tuple[FileDigest, ...]:
        """The files among them that are there; their names alone, for results hold no paths."""
        files = [Path(place) for place in self._states if not is_url(place) and Path(place).is_file()]
        return tuple(sorted(file_digests(file)[0] for file in files))


_NOTED: ContextVar[Noted | None] = ContextVar("inputs of the step under way", default=None)


@contextmanager
def noting() -> Iterator[Noted]:
    """Note every input that is opened in this block, for whoever notes around it as well."""
    noted = Noted(_NOTED.get())
    before = _NOTED.set(noted)
    try:
        yield noted
    finally:
        _NOTED.reset(before)


def note(place: Address) -> None:
    """Whoever opens a file, lists a folder, or asks whether something is there, says it here before."""
    if (noted := _NOTED.get()) is not None:
        noted.note(place)


def note_all_below(folder: Path) -> None:
    """A file; or every file of a folder and of those below, links followed, for readers that open what they like."""
    if _NOTED.get() is None:
        return
    note(folder)
    visited = {os.path.realpath(folder)}
    for place, below, names in os.walk(folder, followlinks=True):
        for name in (".", *names):
            note(Path(place, name))
        real = {name: os.path.realpath(Path(place, name)) for name in below}
        below[:] = [name for name in below if real[name] not in visited]
        visited.update(real.values())


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder of this program's own for what it unpacks or copies of inputs, gone after the block."""
    with TemporaryDirectory(prefix="balise-") as folder:
        if (noted := _NOTED.get()) is not None:
            noted.leave_out(Path(folder))
        yield Path(folder)


def digest_now(place: str) -> str:
    """What decides the content of a place: SHA-256 of a file, names in a folder, the version of an address."""
    try:
        if is_url(place):
            return version(place) or NO_DIGEST
        path = Path(place)
        if path.is_dir():
            names = sorted(os.fsencode(entry.name) for entry in path.iterdir())
            return f"folder {hashlib.sha256(b'/'.join(names)).hexdigest()}"
        if path.is_file():
            return file_digest(path)
        return NO_DIGEST if os.path.lexists(path) else "absent"
    except (OSError, BaliseError):
        return NO_DIGEST


def _state(place: str) -> object:
    """What changes when somebody writes there. Of a folder its names: it may be read and written to by turns."""
    if not is_url(place) and Path(place).is_file():
        try:
            return signature(Path(place))
        except OSError:
            return None
    return digest_now(place)
