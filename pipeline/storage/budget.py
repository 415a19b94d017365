"""What one file may unpack to: a few bytes that somebody packed must not fill a disk or a memory."""

from __future__ import annotations

import lzma
import struct
import tarfile
import time
import zipfile
import zlib
from typing import IO

import pyarrow as pa

from schemas.config import IngestConfig
from schemas.errors import InputError

# What the readers of archives raise for damage, a password, a method that they do not know, a disk that is full.
UNPACKING = (
    *(OSError, EOFError, RuntimeError, NotImplementedError, ValueError, IndexError, MemoryError),
    *(zlib.error, lzma.LZMAError, zipfile.BadZipFile, tarfile.TarError, pa.ArrowException, struct.error),
)
_PIECE = 1024 * 1024
_MIB = 1024 * 1024
# Below this a ratio says nothing: a small log of a train that stands packs to hardly anything.
_FREE = 64 * _MIB


def most_unpacked(packed: int, config: IngestConfig) -> int:
    """Bytes that a file of `packed` bytes may unpack to by its ratio alone."""
    return max(_FREE, round(config.unpacked_ratio_limit * packed))


class Budget:
    """What is left to the archives of one file, those inside it included. Raises `InputError` when it is spent.

    `packed`: size of that file [bytes]; what unpacks to no more takes no room that was not there.
    """

    def __init__(self, place: str, packed: int, config: IngestConfig) -> None:
        self._place = place
        self._config = config
        self._most = max(packed, round(config.unpacked_limit_mib * _MIB))
        self._most_by_ratio = most_unpacked(packed, config)
        self._bytes = 0
        self._files = 0
        self._begun_s = time.monotonic()

    def take_file(self) -> None:
        """Count one more file; raises where there are too many."""
        self._files += 1
        if self._files > self._config.unpacked_files_limit:
            raise self._spent("holds too many files", "unpacked_files_limit", "files")

    def take(self, count: int) -> None:
        """Count unpacked bytes; raises where size, ratio or time is beyond its limit."""
        self._bytes += count
        if self._bytes > self._most:
            raise self._spent("unpacks to too much", "unpacked_limit_mib", "MiB")
        if self._bytes > self._most_by_ratio:
            raise self._spent("unpacks to too many times its size", "unpacked_ratio_limit", "times its size")
        if time.monotonic() - self._begun_s > self._config.unpacked_limit_s:
            raise self._spent("takes too long to unpack", "unpacked_limit_s", "s")

    def copy(self, packed: IO[bytes], plain: IO[bytes]) -> None:
        """Unpack one file, piece by piece."""
        self.take_file()
        while piece := packed.read(_PIECE):
            self.take(len(piece))
            plain.write(piece)

    def _spent(self, message: str, key: str, unit: str) -> InputError:
        """The error for a limit that is exceeded; `key`: its name in the configuration, `unit` of its value."""
        limit = getattr(self._config, key)
        return InputError(
            message,
            place=self._place,
            expected=f"at most {limit:g} {unit}",
            remedy=f"If it is what was recorded, write a larger `{key}` under [ingest] in the configuration file.",
        )
