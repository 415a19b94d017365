"""One campaign at a time per output."""

from __future__ import annotations

import contextlib
import fcntl
import os
import secrets
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from pipeline import storage
from pipeline.ingest.files import Address, is_url, join
from schemas.errors import OutputError

_BEAT_S = 2.0
_SILENCE_S = 8.0


@contextlib.contextmanager
def locked(out: Address) -> Iterator[None]:
    """Hold the output for this campaign. Raises `OutputError` while another one holds it."""
    with _locked_remote(str(out)) if is_url(out) else _locked_local(Path(out)):
        yield


@contextlib.contextmanager
def _locked_local(out: Path) -> Iterator[None]:
    """A lock on the folder itself: it goes with the process, however that ends, and leaves no file."""
    with storage.as_output_error(out):
        out.mkdir(parents=True, exist_ok=True)
        probe = out / f".probe-{secrets.token_hex(4)}.tmp"
        probe.touch()
        probe.unlink()
        folder = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _busy(out) from None
        yield
    finally:
        os.close(folder)


@contextlib.contextmanager
def _locked_remote(out: str) -> Iterator[None]:
    """A lock object that its holder rewrites every few seconds.

    One that stays as it is for several beats belongs to a campaign that was killed. No clocks are
    compared, only what is seen to change.
    """
    place = str(join(out, ".lock"))
    own = secrets.token_hex(8)
    _wait_for_silence(place, out)
    storage.write_bytes(place, f"{own} 0".encode())
    time.sleep(_BEAT_S / 4)
    if not _content(place).startswith(own):
        raise _busy(out)
    ended = threading.Event()
    beat = threading.Thread(target=_beat, args=(place, own, ended), daemon=True)
    beat.start()
    try:
        yield
    finally:
        ended.set()
        beat.join()
        storage.remove(place)


def _wait_for_silence(place: str, out: str) -> None:
    seen = _content(place)
    until = time.monotonic() + _SILENCE_S
    while seen and time.monotonic() < until:
        time.sleep(_BEAT_S / 4)
        now = _content(place)
        if now and now != seen:
            raise _busy(out)
        seen = now


def _content(place: str) -> str:
    return storage.read_many([place]).get(place, b"").decode()


def _beat(place: str, own: str, ended: threading.Event) -> None:
    count = 0
    while not ended.wait(_BEAT_S):
        count += 1
        with contextlib.suppress(OutputError):
            storage.write_bytes(place, f"{own} {count}".encode())


def _busy(out: Address) -> OutputError:
    return OutputError(
        "another campaign is writing here",
        place=storage.redacted(str(out)),
        remedy="Wait for its end, or choose another --out.",
    )
