"""What a log says about itself at its end, held against what the walk met."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Footer, Statistics

from pipeline.read.ingest.mcap_records import HEAD_SIZE, DamageError, parse


@dataclass
class WalkCounts:
    """What the walk counted on its way.

    `chunk_sum` adds up what a chunk index must say of each chunk, in any order: a log may have a million of them.
    """

    message_counts: Counter[int] = field(default_factory=Counter)
    chunks: int = 0
    chunk_sum: int = 0
    attachments: int = 0
    metadata: int = 0
    span_ns: tuple[int, int] | None = None

    def add_chunk(self, chunk: Chunk, offset: int, length: int) -> None:
        """A chunk whose record has this offset and length."""
        start_ns = chunk.message_start_time
        end_ns = chunk.message_end_time
        self.chunks += 1
        self.chunk_sum += hash(
            (start_ns, end_ns, offset, length, len(chunk.data), chunk.uncompressed_size, chunk.compression)
        )

    def add_times(self, low_ns: int, high_ns: int) -> None:
        old = self.span_ns or (low_ns, high_ns)
        self.span_ns = (min(old[0], low_ns), max(old[1], high_ns))


class Summary:
    """The summary section, record by record; raises where it contradicts what was met."""

    def __init__(self, start: int, met: WalkCounts) -> None:
        self._start = start
        self._met = met
        self._crc = 0
        self._indexed = 0
        self._index_sum = 0

    def add(self, opcode: int, whole: bytes, position: int) -> None:
        """A record before the footer."""
        self._crc = crc32(whole, self._crc)
        if opcode == Opcode.CHUNK_INDEX:
            index = parse(ChunkIndex, whole[HEAD_SIZE:], position)
            span_ns = (index.message_start_time, index.message_end_time)
            place = (index.chunk_start_offset, index.chunk_length)
            content = (index.compressed_size, index.uncompressed_size, index.compression)
            self._indexed += 1
            self._index_sum += hash((*span_ns, *place, *content))
        elif opcode == Opcode.STATISTICS:
            self._check_statistics(parse(Statistics, whole[HEAD_SIZE:], position), position)

    def _check_statistics(self, stated: Statistics, position: int) -> None:
        met = self._met
        per_channel = {channel: count for channel, count in stated.channel_message_counts.items() if count}
        pairs: list[tuple[str, object, object]] = [
            ("messages", stated.message_count, met.message_counts.total()),
            ("chunks", stated.chunk_count, met.chunks),
            ("attachments", stated.attachment_count, met.attachments),
            ("metadata records", stated.metadata_count, met.metadata),
            ("messages per channel", per_channel or dict(met.message_counts), dict(met.message_counts)),
        ]
        if met.span_ns:
            # Some writers take a first time of 0 for none yet, and state the earliest after it.
            start_ns = stated.message_start_time if met.span_ns[0] else 0
            pairs.append(("times", (start_ns, stated.message_end_time), met.span_ns))
        for name, recorded, counted in pairs:
            if recorded != counted:
                raise DamageError(position, f"the statistics record gives {recorded} {name}, the file holds {counted}")

    def finish(self, footer: bytes, position: int) -> None:
        """The footer. A chunk index lists every chunk once, or there is none."""
        stated = parse(Footer, footer[HEAD_SIZE:], position)
        start = self._start if position != self._start else 0
        if stated.summary_start != start:
            raise DamageError(position, f"the footer places the summary at {stated.summary_start}, it is at {start}")
        if stated.summary_crc and crc32(footer[:-4], self._crc) != stated.summary_crc:
            raise DamageError(position, "the checksum of the summary does not match")
        if self._indexed and (self._indexed, self._index_sum) != (self._met.chunks, self._met.chunk_sum):
            raise DamageError(position, "the chunk index disagrees with the chunks")
