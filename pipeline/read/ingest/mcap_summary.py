"""What a log says about itself at its end, held against what the walk met."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Footer, Statistics

from pipeline.read.ingest.mcap_records import HEAD_SIZE, Channel, DamageError, parse


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
    """The summary section, record by record; raises where it contradicts what was met.

    `lost`: what it declares beyond that.
    """

    def __init__(self, start: int, met: WalkCounts, channels: Mapping[int, Channel]) -> None:
        self.lost: list[str] = []
        self._start = start
        self._met = met
        self._channels = channels
        self._stated_chunks = 0
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
        """Fewer records than stated are a loss, which is said; everything else that differs is a contradiction."""
        met = self._met
        per_channel = {channel: count for channel, count in stated.channel_message_counts.items() if count}
        counts = dict(met.message_counts)
        pairs: list[tuple[str, object, object]] = [
            ("attachments", stated.attachment_count, met.attachments),
            ("metadata records", stated.metadata_count, met.metadata),
        ]
        if _is_less(counts, per_channel or counts) and counts != (per_channel or counts):
            lost = [(channel, counts.get(channel, 0), count) for channel, count in sorted(per_channel.items())]
            self.lost += [_loss(f"messages of {self._topic(of)}", *both) for of, *both in lost if both[0] < both[1]]
        elif per_channel:
            pairs.append(("messages per channel", per_channel, counts))
        for name, held, count in (
            ("messages", met.message_counts.total(), stated.message_count),
            ("chunks", met.chunks, stated.chunk_count),
        ):
            if held < count:
                self.lost += [_loss(name, held, count)] if name == "chunks" or not self.lost else []
            else:
                pairs.append((name, count, held))
        self._stated_chunks = stated.chunk_count
        if met.span_ns:
            # Some writers take a first time of 0 for none yet, and state the earliest after it.
            start_ns = stated.message_start_time if met.span_ns[0] else 0
            span_ns = (start_ns, stated.message_end_time)
            if not (self.lost and start_ns <= met.span_ns[0] and met.span_ns[1] <= span_ns[1]):
                pairs.append(("times", span_ns, met.span_ns))
        for name, recorded, counted in pairs:
            if recorded != counted:
                raise DamageError(position, f"the statistics record gives {recorded} {name}, the file holds {counted}")

    def _topic(self, channel_id: int) -> str:
        return self._channels[channel_id].topic if channel_id in self._channels else f"channel {channel_id}"

    def finish(self, footer: bytes, position: int) -> None:
        """The footer. A chunk index lists every chunk once, or there is none."""
        stated = parse(Footer, footer[HEAD_SIZE:], position)
        start = self._start if position != self._start else 0
        if stated.summary_start != start:
            raise DamageError(position, f"the footer places the summary at {stated.summary_start}, it is at {start}")
        if stated.summary_crc and crc32(footer[:-4], self._crc) != stated.summary_crc:
            raise DamageError(position, "the checksum of the summary does not match")
        all_indexed = (self._indexed, self._index_sum) == (self._met.chunks, self._met.chunk_sum)
        # Chunks that the statistics miss too are lost; without them the sum shows nothing of the others.
        known = bool(self.lost) and self._met.chunks < self._indexed == self._stated_chunks
        if self._indexed and not (all_indexed or known):
            raise DamageError(position, "the chunk index disagrees with the chunks")


def _is_less(counts: Mapping[int, int], stated: Mapping[int, int]) -> bool:
    return all(count <= stated.get(channel, 0) for channel, count in counts.items())


def _loss(what: str, held: int, declared: int) -> str:
    return f"{held} of {declared} {what} that are declared"
