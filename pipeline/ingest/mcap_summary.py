"""What a log says about itself at its end, held against what the walk met."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from struct import Struct

import numpy as np
from isal.isal_zlib import crc32
from mcap.records import ChunkIndex, Footer, Statistics

from pipeline.ingest.byte_window import ByteWindow
from pipeline.ingest.mcap_records import HEAD_SIZE, MAGIC, DamageError, Op, parse

# Of a chunk: first and last time, offset, length, compressed size, size, compression. Packed, for a log may have a
# million.
CHUNK_ENTRY = np.dtype(
    [(name, "<u8") for name in ("start", "end", "offset", "length", "compressed", "size")] + [("compression", "S16")]
)
_ENTRY = Struct("<6Q16s")


@dataclass
class Met:
    """What the walk counted on its way."""

    message_counts: Counter[int] = field(default_factory=Counter)
    chunks: bytearray = field(default_factory=bytearray)  # entries of `CHUNK_ENTRY`
    attachments: int = 0
    metadata: int = 0
    span_ns: tuple[int, int] | None = None

    def add_times(self, low_ns: int, high_ns: int) -> None:
        old = self.span_ns or (low_ns, high_ns)
        self.span_ns = (min(old[0], low_ns), max(old[1], high_ns))


class Summary:
    """The summary section, record by record; raises where it contradicts what was met."""

    def __init__(self, start: int, met: Met) -> None:
        self._start = start
        self._met = met
        self._crc = 0
        self._indexed = bytearray()

    def add(self, opcode: int, whole: memoryview, position: int) -> None:
        """A record before the footer."""
        self._crc = crc32(whole, self._crc)
        if opcode == Op.CHUNK_INDEX:
            self._indexed += _entry_of(parse(ChunkIndex, whole[HEAD_SIZE:], position))
        elif opcode == Op.STATISTICS:
            self._check_statistics(parse(Statistics, whole[HEAD_SIZE:], position), position)

    def _check_statistics(self, told: Statistics, position: int) -> None:
        met = self._met
        per_channel = {channel: count for channel, count in told.channel_message_counts.items() if count}
        pairs = [
            ("messages", told.message_count, met.message_counts.total()),
            ("chunks", told.chunk_count, len(met.chunks) // CHUNK_ENTRY.itemsize),
            ("attachments", told.attachment_count, met.attachments),
            ("metadata records", told.metadata_count, met.metadata),
            ("messages per channel", per_channel or dict(met.message_counts), dict(met.message_counts)),
        ]
        if met.span_ns:
            # Some writers take a first time of 0 for none yet, and tell of the earliest after it.
            start_ns = told.message_start_time if met.span_ns[0] else 0
            pairs.append(("times", (start_ns, told.message_end_time), met.span_ns))
        for name, expected, found in pairs:
            if expected != found:
                raise DamageError(position, f"the statistics record gives {expected} {name}, the file holds {found}")

    def finish(self, footer: memoryview, position: int, window: ByteWindow) -> int | None:
        """The footer and the end of the file; the offset of a cut through the closing magic, if there is one."""
        told = parse(Footer, footer[HEAD_SIZE:], position)
        start, crc = told.summary_start, told.summary_crc
        met = self._start if position != self._start else 0
        if start != met:
            raise DamageError(position, f"the footer places the summary at {start}, it is at {met}")
        if crc and crc32(footer[:-4], self._crc) != crc:
            raise DamageError(position, "the checksum of the summary does not match")
        cut_at = _check_end(position + len(footer), window)
        self._check_chunk_index(position)
        return cut_at

    def _check_chunk_index(self, position: int) -> None:
        """A chunk index lists every chunk once, or there is none."""
        if not self._indexed:
            return
        told, chunks = (np.frombuffer(entries, dtype=CHUNK_ENTRY) for entries in (self._indexed, self._met.chunks))
        told = told[np.argsort(told["offset"], kind="stable")]
        if not np.array_equal(told["offset"], chunks["offset"]):
            kind = f"the chunk index names {len(told)} chunks, but the file has {len(chunks)}"
            raise DamageError(position, kind)
        if (told != chunks).any():
            raise DamageError(position, "the chunk index disagrees with the chunks")


def chunk_entry(start: int, end: int, offset: int, length: int, compressed: int, size: int, compression: str) -> bytes:
    """What a chunk index says of a chunk, to be compared."""
    return _ENTRY.pack(start, end, offset, length, compressed, size, compression.encode())


def _entry_of(index: ChunkIndex) -> bytes:
    return chunk_entry(
        index.message_start_time,
        index.message_end_time,
        index.chunk_start_offset,
        index.chunk_length,
        index.compressed_size,
        index.uncompressed_size,
        index.compression,
    )


def _check_end(end: int, window: ByteWindow) -> int | None:
    """The closing magic and nothing after it; the offset of a cut through it."""
    left = min(len(MAGIC), window.size - end)
    closing = bytes(window.at(end, left)) if left else b""
    if not MAGIC.startswith(closing):
        raise DamageError(end, "the magic bytes at the end are wrong")
    if closing != MAGIC:
        return end
    if end + len(MAGIC) != window.size:
        raise DamageError(end + len(MAGIC), "there is data after the end of the file: two files may have been joined")
    return None
