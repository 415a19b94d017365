"""Records of compressed chunks, into memory that is used again: exactly the declared size, or an error."""

from __future__ import annotations

from typing import Any

import pyarrow as pa
import zstandard
from isal.isal_zlib import crc32

from pipeline.ingest.mcap_records import ChunkRecord, DamageError

_ZSTD_MAGIC = 0xFD2FB528


class Decompressor:
    """Unpacks chunks one after the other."""

    def __init__(self) -> None:
        self._zstd = zstandard.ZstdDecompressor()

    def unpack(self, chunk: ChunkRecord, room: memoryview) -> None:
        """Fill `room`, of the size that the chunk declares; raises where content, size or checksum differ."""
        try:
            size = self._fill(chunk, room)
        except (pa.ArrowException, zstandard.ZstdError, OSError, RuntimeError, ValueError) as error:
            raise DamageError(chunk.offset, f"a chunk cannot be decompressed ({error})") from None
        if size != chunk.size:
            raise DamageError(chunk.offset, f"a chunk holds {size} bytes or more but declares {chunk.size}")
        if chunk.crc and crc32(room) != chunk.crc:
            raise DamageError(chunk.offset, "the checksum of a chunk does not match its content")

    def _fill(self, chunk: ChunkRecord, room: memoryview) -> int:
        """How many bytes the chunk holds, as far as that is no more than one above what it declares."""
        if chunk.compression == "":
            if len(chunk.records) == chunk.size:
                room[:] = chunk.records
            return len(chunk.records)
        if chunk.compression == "zstd" and _zstd_frame_size(chunk.records) == len(chunk.records):
            return _from_stream(self._zstd.stream_reader(chunk.records, read_size=len(chunk.records)), room)
        if chunk.compression == "zstd":  # several frames, or none: the strict way
            room[:] = memoryview(pa.decompress(chunk.records, chunk.size, codec="zstd"))
            return chunk.size
        if chunk.compression == "lz4":
            # As a stream: at once it would not say when a frame ends short of the declared size.
            return _from_stream(pa.CompressedInputStream(pa.BufferReader(chunk.records), "lz4"), room)
        raise DamageError(chunk.offset, f"a chunk has the unknown compression {chunk.compression!r}")


def _from_stream(stream: Any, room: memoryview) -> int:
    size = 0
    while size < len(room):
        count = stream.readinto(room[size:])
        if not count:
            return size
        size += count
    return size + len(stream.read(1))


def _zstd_frame_size(content: memoryview) -> int | None:
    """Compressed size of the frame at the start, by its blocks (RFC 8878, 3.1.1); none if it is not whole.

    The stream reader neither says that a frame is cut short after its last byte of data nor what follows.
    """
    if len(content) < 6 or int.from_bytes(content[:4], "little") != _ZSTD_MAGIC:
        return None
    descriptor = content[4]
    single_segment = descriptor >> 5 & 1
    sizes = (1 if single_segment else 0, 2, 4, 8)
    at = 5 + (1 - single_segment) + (0, 1, 2, 4)[descriptor & 3] + sizes[descriptor >> 6]
    while at + 3 <= len(content):
        block = content[at] | content[at + 1] << 8 | content[at + 2] << 16
        kind, size = block >> 1 & 3, block >> 3
        at += 3 + (1 if kind == 1 else size)
        if block & 1:
            return at + (4 if descriptor >> 2 & 1 else 0)
    return None
