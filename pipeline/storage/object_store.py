"""Operations on object stores: tried again where a store answers with an error, given up where it stays that way."""

from __future__ import annotations

import contextlib
import errno
import inspect
import os
import time
from collections.abc import Awaitable, Callable
from functools import lru_cache, partial
from itertools import count
from typing import Any, TypeVar

from pipeline.storage.address import Address, check_public, redacted
from pipeline.storage.objects import AlteredError
from schemas.errors import BaliseError, InputError, OutputError, UsageError

T = TypeVar("T")

_PATIENCE = "BALISE_STORE_PATIENCE_S"
_PATIENCE_S = 45.0
_TRIES = 4
_TRIES_OF_ALTERED = 6
_TRIES_OF_WHAT_MAY_PASS = 12
_FIRST_PAUSE_S = 0.25
_LONGEST_PAUSE_S = 8.0
_LOOK_S = 0.5
# A connection that is silent for long is tried anew while there is patience left, and a file comes in one stream, so
# that it is seen to come. `FSSPEC_S3` (JSON) overrides.
_SETTINGS: dict[str, dict[str, Any]] = {
    "s3": {"max_concurrency": 1, "config_kwargs": {"connect_timeout": 5, "read_timeout": 15}}
}
_LASTING = (errno.EINVAL, errno.EPERM, errno.ENOSYS)
_CONNECTION_ERRORS = {"HTTPClientError", "ClientConnectionError", "ClientPayloadError"}


def on_store(address: Address, operation: Callable[[Any, str], T], kind: type[BaliseError] = OutputError) -> T:
    """Run an operation on the store of an address.

    An answer that may be another one later (busy, broken connection, none at all) is asked for again as long as
    there is patience: `BALISE_STORE_PATIENCE_S` seconds without anything having come, 45 unless set.
    """
    store, path = open_store(address, kind)
    limit_s = patience_s()
    watched = _PatientStore(store, limit_s)
    reason = "no answer"
    for attempt in count():
        try:
            return operation(watched, path)
        except BaliseError:
            raise
        except Exception as error:
            # Stores raise their client library's own exceptions, which share no base class.
            if isinstance(error, FileNotFoundError) and kind is InputError:
                raise _absent(address) from None
            reason = _words_of(error, reason)
            pause_s = min(_FIRST_PAUSE_S * 2**attempt, _LONGEST_PAUSE_S)
            unanswered = _may_pass(error) and watched.silence_s + pause_s > limit_s
            if unanswered or attempt + 1 >= _tries(error):
                what = "" if isinstance(error, AlteredError) else _failure(limit_s if unanswered else None)
                raise _refused(address, what + reason, kind) from None
            time.sleep(pause_s)
    raise AssertionError("the last attempt returns or raises")


def patience_s() -> float:
    """How long a store may give no sign of life [s]."""
    text = os.environ.get(_PATIENCE, "")
    try:
        limit_s = float(text or _PATIENCE_S)
    except ValueError:
        limit_s = 0.0
    if not limit_s > 0:
        raise UsageError("is not a time", place=_PATIENCE, found=text, expected="seconds, more than 0")
    return limit_s


def open_store(address: Address, kind: type[BaliseError] = OutputError) -> tuple[Any, str]:
    """The file system of an address and its path there, through which every access to a store goes.

    Args:
        address: address in an object store.
        kind: kind of the error that is raised.

    Raises:
        BaliseError: of this kind; nothing is installed for such addresses, or the address is none.
    """
    check_public(address)
    protocol, _, rest = str(address).partition("://")
    try:
        store = _filesystem(protocol, f"{protocol}://{rest.split('/', 1)[0]}")
        return store, str(store._strip_protocol(str(address)))
    except (ImportError, ValueError) as error:
        raise kind(
            f"cannot be opened: {redacted(str(error))}",
            place=redacted(str(address)),
            remedy="Install the extra for this kind of address (`balise[s3]`).",
        ) from None


@lru_cache(maxsize=64)
def _filesystem(protocol: str, root: str) -> Any:
    """The file system of a bucket or server, made once per process."""
    import fsspec

    settings = {**_SETTINGS.get(protocol, {}), **fsspec.config.conf.get(protocol, {})}
    # Listings must not be remembered: other processes write here too.
    return fsspec.core.url_to_fs(root, **{**settings, "use_listings_cache": False})[0]


class _PatientStore:
    """A store whose operations end when nothing has come for a while; `arrived` tells that something has."""

    def __init__(self, store: Any, limit_s: float) -> None:
        self._store = store
        self._limit_s = limit_s
        self.arrived()

    @property
    def silence_s(self) -> float:
        """Time for which nothing has arrived [s]."""
        return time.monotonic() - self._since_s

    def arrived(self, *_: object) -> None:
        """Something has arrived now."""
        self._since_s = time.monotonic()

    def __getattr__(self, name: str) -> Any:
        """An operation of the store; where it is asynchronous, one that ends after too long a silence."""
        ours = getattr(self._store, f"_{name}", None)
        if name == "cat" and inspect.iscoroutinefunction(ours):
            ours = partial(type(self._store)._cat, self)  # which asks for each file through `_cat_file` below
        if not inspect.iscoroutinefunction(ours):
            return getattr(self._store, name)
        from fsspec.asyn import sync

        return partial(sync, self._store.loop, self._within, ours)

    async def _cat_file(self, *args: object, **kwargs: object) -> bytes:
        """Of many files that are asked for at once, each that comes is a sign of life."""
        content: bytes = await self._store._cat_file(*args, **kwargs)
        self.arrived()
        return content

    async def _within(self, operation: Callable[..., Awaitable[T]], *args: object, **kwargs: object) -> T:
        """Await an operation. Raises `TimeoutError` once nothing has come for longer than the limit."""
        import asyncio  # whoever asks a store has loaded it already

        task = asyncio.ensure_future(operation(*args, **kwargs))
        while not task.done():
            await asyncio.wait({task}, timeout=min(_LOOK_S, self._limit_s))
            if not task.done() and self.silence_s > self._limit_s:
                task.cancel()
                with contextlib.suppress(BaseException):
                    await task
                raise TimeoutError("no answer")
        return task.result()


def arrivals(store: _PatientStore) -> Any:
    """What fsspec tells of the bytes of all files that arrive, passed on to the watch."""
    from fsspec.callbacks import Callback

    class Arrivals(Callback):  # type: ignore[misc]
        """Counts every byte that arrives as a sign of life."""

        # fsspec asks for it before each file (`Callback.branch_coro`).
        def branched(self, *_: object, **__: object) -> Callback:
            """Itself, for each single file."""
            return self

        def call(self, *_: object, **__: object) -> None:
            """Bytes have arrived."""
            store.arrived()

    return Arrivals()


def _words_of(error: Exception, before: str) -> str:
    """What an error says; that time has run out says less than what was answered before."""
    if isinstance(error, TimeoutError):
        return before
    return str(error).rstrip(".") or type(error).__name__


def _tries(error: Exception) -> int:
    """How often an operation is tried that ends in this error."""
    if isinstance(error, FileNotFoundError | PermissionError):
        return 1
    if isinstance(error, AlteredError):
        return _TRIES_OF_ALTERED
    return _TRIES_OF_WHAT_MAY_PASS if _may_pass(error) else _TRIES


def _may_pass(error: Exception) -> bool:
    """Whether it is the store or the way to it that fails, not what is asked of it."""
    if isinstance(error, OSError):
        return error.errno not in _LASTING and not isinstance(error, FileNotFoundError | PermissionError)
    return any(kind.__name__ in _CONNECTION_ERRORS for kind in type(error).__mro__)


def _absent(address: Address) -> InputError:
    """The error for an address at which there is nothing."""
    return InputError(
        "does not exist", place=redacted(str(address)), expected="a file or folder", remedy="Check the address."
    )


def _failure(unanswered_s: float | None) -> str:
    """How the message about a failure begins: refused, or without an answer for so long [s]."""
    return (
        "the store refused: " if unanswered_s is None else f"the store gave no usable answer for {unanswered_s:g} s: "
    )


def _refused(address: Address, reason: str, kind: type[BaliseError]) -> BaliseError:
    """The error, of this kind, for an operation that failed for good; without secrets of the address."""
    return kind(
        redacted(reason),
        place=redacted(str(address)),
        remedy="Check address, rights and connection; complete runs are kept, and skipped next time.",
    )
