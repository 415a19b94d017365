"""Forward reading of a file in large pieces, so that memory does not grow with the log."""

from __future__ import annotations

from collections.abc import Callable
from typing import IO

_PIECE = 4 * 1024 * 1024


class ByteWindow:
    """Parts of a file by offset, asked for in growing order; every byte is shown once to `on_bytes`."""

    def __init__(self, stream: IO[bytes], size: int, on_bytes: Callable[[bytes], object]) -> None:
        self.size = size
        self._stream = stream
        self._on_bytes = on_bytes
        self._start = 0
        self._data = b""

    def at(self, offset: int, length: int) -> memoryview:
        """These bytes; they must lie inside the file."""
        if offset + length > self._end:
            self._advance(offset, length)
        first = offset - self._start
        return memoryview(self._data)[first : first + length]

    def available(self, offset: int) -> memoryview:
        """From `offset` to the end of the piece in memory: at least one byte."""
        return self.at(offset, max(1, self._end - offset))

    @property
    def _end(self) -> int:
        return self._start + len(self._data)

    def _advance(self, offset: int, length: int) -> None:
        while self._end <= offset:  # what is skipped (an attachment) passes piece by piece
            self._start = self._end
            self._data = self._read(_PIECE)
        kept = self._data[offset - self._start :]
        missing = length - len(kept)
        self._data = kept + self._read(max(_PIECE, missing)) if missing > 0 else kept
        self._start = offset

    def _read(self, count: int) -> bytes:
        """Up to `count` bytes, fewer only at the end of the file."""
        pieces, missing = [], min(count, self.size - self._end)
        while missing > 0:
            piece = self._stream.read(missing)
            if not piece:
                raise OSError(f"the file became shorter while it was read (expected {self.size} bytes)")
            self._on_bytes(piece)
            pieces.append(piece)
            missing -= len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def drain(self) -> None:
        """Show the rest of the file to `on_bytes`."""
        while self._end < self.size:
            self._start, self._data = self._end, self._read(_PIECE)

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
