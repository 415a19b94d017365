"""One campaign at a time per output.

`OUT/.lock` names the campaign that holds it, so that workers of one that has ended (a lost scheduler, a killed
client) find out before they write. On this machine a lock on the folder itself decides; in a store, the file.
"""

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
from pipeline.campaign.waits import WAITS
from pipeline.storage.address import Address, is_url, join, redacted
from schemas.errors import OutputError

_NAME = ".lock"


@contextlib.contextmanager
def locked(out: Address) -> Iterator[str]:
    """Hold the output for this campaign, under the name that is given. Raises `OutputError` while another holds it."""
    own = secrets.token_hex(8)
    with _locked_remote(str(out), own) if is_url(out) else _locked_local(Path(out), own):
        yield own


def check_held(out: Address, own: str) -> None:
    """Raises `OutputError` unless the campaign of this name still holds the output."""
    if not _content(join(out, _NAME)).startswith(own):
        raise OutputError(
            "is no longer held by this campaign",
            place=redacted(str(out)),
            remedy="Repeat the command: complete runs are skipped.",
        )


@contextlib.contextmanager
def _locked_local(out: Path, own: str) -> Iterator[None]:
    """A lock on the folder itself: it goes with the process, however that ends."""
    with storage.as_output_error(out):
        out.mkdir(parents=True, exist_ok=True)
        folder = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _busy(out) from None
        storage.write_bytes(out / _NAME, own.encode())
        try:
            yield
        finally:
            storage.remove(out / _NAME)
    finally:
        os.close(folder)


@contextlib.contextmanager
def _locked_remote(out: str, own: str) -> Iterator[None]:
    """A lock object that its holder rewrites every few seconds.

    One that stays as it is for several beats belongs to a campaign that was killed. No clocks are
    compared, only what is seen to change.
    """
    place = str(join(out, _NAME))
    _wait_for_silence(place, out)
    storage.write_bytes(place, f"{own} 0".encode())
    time.sleep(WAITS.lock_beat_s / 4)
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
        if _content(place).startswith(own):
            storage.remove(place)


def _wait_for_silence(place: str, out: str) -> None:
    seen = _content(place)
    until = time.monotonic() + WAITS.lock_silence_s
    while seen and time.monotonic() < until:
        time.sleep(WAITS.lock_beat_s / 4)
        now = _content(place)
        if now and now != seen:
            raise _busy(out)
        seen = now


def _content(place: Address) -> str:
    return (storage.content_of(place) or b"").decode()


def _beat(place: str, own: str, ended: threading.Event) -> None:
    """Rewrite the lock until the end, or until a campaign that took this one for dead has taken it over."""
    count = 0
    while not ended.wait(WAITS.lock_beat_s):
        count += 1
        with contextlib.suppress(OutputError):
            if not _content(place).startswith(own):
                return
            storage.write_bytes(place, f"{own} {count}".encode())


def _busy(out: Address) -> OutputError:
    return OutputError(
        "another campaign is writing here",
        place=redacted(str(out)),
        remedy="Wait until it ends, or choose another --out.",
    )
