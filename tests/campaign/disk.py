"""A disk that fails, or a process that dies, at the n-th operation on it."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_WRITES = ("fsync", "mkdir", "replace", "unlink")
_READS = ("scandir",)


class Killed(KeyboardInterrupt):
    """Whoever is at work does nothing more."""


class Disk:
    """Counts operations below a folder; fails one of them, or that and all later ones as if the process had died."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.count, self.fatal_at, self.dies = str(folder), 0, -1, False

    def step(self, place: object) -> None:
        if not isinstance(place, int) and not str(Path(str(place)).absolute()).startswith(self.folder):
            return
        self.count += 1
        if self.dies and 0 < self.fatal_at <= self.count:
            raise Killed
        if self.count == self.fatal_at:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    @contextmanager
    def failing(self, number: int, dies: bool = False) -> Iterator[None]:
        """The operation of this number fails; those before are done, and so are those after unless `dies`."""
        self.count, self.fatal_at, self.dies = 0, number, dies
        with pytest.MonkeyPatch.context() as patch:
            for name in (*_WRITES, *_READS):
                patch.setattr(os, name, self._watched(getattr(os, name)))
            patch.setattr(io, "open", self._watched(io.open))
            yield

    def _watched(self, operation: Callable[..., Any]) -> Callable[..., Any]:
        def watched(place: Any = ".", *args: Any, **options: Any) -> Any:
            self.step(place)
            return operation(place, *args, **options)

        return watched


def operations(disk: Disk, work: Callable[[], object]) -> int:
    """How many operations a piece of work takes."""
    with disk.failing(-1):
        work()
    return disk.count
