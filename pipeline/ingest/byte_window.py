"""Forward reading of a file in large pieces, so that memory does not grow with the log."""

from __future__ import annotations

from collections.abc import Callable
from typing import IO

import numpy as np

_PIECE = 1024 * 1024


class ByteWindow:
    """Parts of a file by offset, asked for in growing order; every byte is shown once to `on_bytes`."""

    def __init__(self, stream: IO[bytes], size: int, on_bytes: Callable[[memoryview], object]) -> None:
        self.size = size
        self._stream = stream
        self._on_bytes = on_bytes
        self._start = 0
        self._data = memoryview(b"")

    def at(self, offset: int, length: int) -> memoryview:
        """These bytes; they must lie inside the file."""
        if offset + length > self._end:
            self._advance(offset, length)
        first = offset - self._start
        return self._data[first : first + length]

    def available(self, offset: int) -> memoryview:
        """From `offset` to the end of the piece in memory: at least one byte."""
        return self.at(offset, max(1, self._end - offset))

    @property
    def _end(self) -> int:
        return self._start + len(self._data)

    def _advance(self, offset: int, length: int) -> None:
        while self._end <= offset:  # what is skipped (an attachment) passes piece by piece
            self._load(self._data[:0], _PIECE)
        kept = self._data[offset - self._start :]
        self._load(kept, max(_PIECE, length - len(kept)))

    def _load(self, kept: memoryview, count: int) -> None:
        """Go on to the next `count` bytes of the file, fewer only at its end, behind those that are kept."""
        count = min(count, self.size - self._end)
        # New memory each time: views of the old are still waiting to be decompressed and hashed.
        memory = memoryview(np.empty(len(kept) + count, dtype=np.uint8).data)
        memory[: len(kept)] = kept
        self._fill(memory[len(kept) :])
        self._start, self._data = self._end - len(kept), memory

    def _fill(self, room: memoryview) -> None:
        read: Callable[[memoryview], int] = self._stream.readinto  # type: ignore[attr-defined]
        filled = 0
        while filled < len(room):
            count = read(room[filled:])
            if not count:
                raise OSError(f"the file became shorter while it was read (expected {self.size} bytes)")
            filled += count
        self._on_bytes(room)

    def drain(self) -> None:
        """Show the rest of the file to `on_bytes`."""
        while self._end < self.size:
            self._load(self._data[:0], _PIECE)

    def ends_with(self, tail: bytes) -> bool:
        """Whether the file ends so."""
        self._stream.seek(max(0, self.size - len(tail)))
        found = self._stream.read(len(tail)) == tail
        self._stream.seek(self._end)
        return found

    def is_zero_from(self, offset: int) -> bool:
        """Whether the file holds only zeros from here: space that was reserved but never written."""
        position = offset
        while position < self.size:
            count = min(_PIECE, self.size - position)
            if any(bytes(self.at(position, count)).strip(b"\0")):
                return False
            position += count
        return True
