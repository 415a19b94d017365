"""One campaign at a time per output.

`OUT/.lock` names the campaign that holds it, so that workers of one that has ended (a lost scheduler, a killed
client) find out before they write. On this machine the lock of the operating system on `OUT/.held` decides, which goes
with the process, however that ends; in a store, the file.
"""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from pipeline import storage
from pipeline.campaign.waits import WAITS
from pipeline.storage.address import Address, is_url, join, redacted
from schemas.errors import OutputError

NAME = ".lock"
HELD = ".held"


@contextlib.contextmanager
def hold_output(out: Address) -> Iterator[str]:
    """Hold the output for this campaign, under the name that is given. Raises `OutputError` while another holds it."""
    name = secrets.token_hex(8)
    with _hold_remote(str(out), name) if is_url(out) else _hold_local(Path(out), name):
        yield name


def check_held(out: Address, name: str) -> None:
    """Raises `OutputError` unless the campaign of this name still holds the output."""
    if not _read_lock(join(out, NAME)).startswith(name):
        raise OutputError(
            "is no longer held by this campaign",
            place=redacted(str(out)),
            remedy="Repeat the command: complete runs are skipped.",
        )


@contextlib.contextmanager
def _hold_local(out: Path, name: str) -> Iterator[None]:
    """Hold the lock of a local folder of results."""
    held = FileLock(out / HELD)
    with storage.as_output_error(out):
        out.mkdir(parents=True, exist_ok=True)
        try:
            held.acquire(blocking=False)
        except Timeout:
            raise _busy_error(out) from None
    try:
        storage.write_bytes(out / NAME, name.encode())
        yield
    finally:
        storage.remove(out / NAME)
        held.release()


@contextlib.contextmanager
def _hold_remote(out: str, name: str) -> Iterator[None]:
    """A lock object that its holder rewrites every few seconds.

    One that stays as it is for several beats belongs to a campaign that was killed. No clocks are
    compared, only what is seen to change.
    """
    place = str(join(out, NAME))
    _wait_for_silence(place, out)
    storage.write_bytes(place, f"{name} 0".encode())
    time.sleep(WAITS.lock_beat_s / 4)
    if not _read_lock(place).startswith(name):
        raise _busy_error(out)
    ended = threading.Event()
    beat = threading.Thread(target=_renew_lock, args=(place, name, ended), daemon=True)
    beat.start()
    try:
        yield
    finally:
        ended.set()
        beat.join()
        if _read_lock(place).startswith(name):
            storage.remove(place)


def _wait_for_silence(place: str, out: str) -> None:
    """Wait until the holder of a lock must be gone; refuse if it renews the lock meanwhile."""
    before = _read_lock(place)
    until = time.monotonic() + WAITS.lock_silence_s
    while before and time.monotonic() < until:
        time.sleep(WAITS.lock_beat_s / 4)
        now = _read_lock(place)
        if now and now != before:
            raise _busy_error(out)
        before = now


def _read_lock(place: Address) -> str:
    """What a lock says; empty if there is none."""
    return (storage.content_of(place) or b"").decode()


def _renew_lock(place: str, name: str, ended: threading.Event) -> None:
    """Rewrite the lock until the end, or until a campaign that took this one for dead has taken it over."""
    count = 0
    while not ended.wait(WAITS.lock_beat_s):
        count += 1
        with contextlib.suppress(OutputError):
            if not _read_lock(place).startswith(name):
                return
            storage.write_bytes(place, f"{name} {count}".encode())


def _busy_error(out: Address) -> OutputError:
    """The error for results that another campaign is writing."""
    return OutputError(
        "another campaign is writing here",
        place=redacted(str(out)),
        remedy="Wait until it ends, or choose another --out.",
    )
