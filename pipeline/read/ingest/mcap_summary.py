"""What a log says about itself at its end, held against what the walk met."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from isal.isal_zlib import crc32
from mcap.opcode import Opcode
from mcap.records import Chunk, ChunkIndex, Footer, Statistics

from pipeline.read.ingest.mcap_records import HEAD_SIZE, Channel, DamageError, parse


@dataclass
class ChunkList:
    """Chunks in order: where each begins, its length (of an index: with its message indexes), a hash of the rest."""

    offsets: array[int] = field(default_factory=lambda: array("q"))
    lengths: array[int] = field(default_factory=lambda: array("q"))
    contents: array[int] = field(default_factory=lambda: array("q"))

    def __len__(self) -> int:
        """Number of chunks."""
        return len(self.offsets)

    def add(self, of: Chunk | ChunkIndex, offset: int, record: int, with_indexes: int) -> None:
        """A chunk whose record has this offset and length."""
        packed = len(of.data) if isinstance(of, Chunk) else of.compressed_size
        content = (of.message_start_time, of.message_end_time, record, packed, of.uncompressed_size, of.compression)
        self.offsets.append(offset)
        self.lengths.append(with_indexes)
        self.contents.append(hash(content))

    def is_same(self, other: ChunkList) -> bool:
        """Whether both list the same chunks at the same places."""
        return (self.offsets, self.contents) == (other.offsets, other.contents)

    def sorted(self) -> ChunkList:
        """The chunks in order of their places in the file."""
        order = sorted(range(len(self)), key=self.offsets.__getitem__)
        columns = (self.offsets, self.lengths, self.contents)
        return ChunkList(*(array("q", map(column.__getitem__, order)) for column in columns))

    def lost_of(self, listed: ChunkList, missing: int) -> set[int] | None:
        """Before which of these chunks others of a list were lost, when the file became `missing` bytes shorter.

        None where these are not chunks of the list, in its order, each as far ahead of its place as was lost before it.
        """
        before: set[int] = set()
        ahead = room = number = end = 0
        for offset, length, content in zip(listed.offsets, listed.lengths, listed.contents, strict=True):
            if offset < end:
                return None
            end = offset + length
            there = number < len(self) and content == self.contents[number]
            if there and ahead <= offset - self.offsets[number] <= ahead + room:
                ahead = offset - self.offsets[number]
                room = 0
                number += 1
            else:
                before.add(number)
                room += length
        return before if number == len(self) and ahead <= missing <= ahead + room else None


@dataclass
class WalkCounts:
    """What the walk counted on its way.

    `chunks`: what a chunk index must say of each, in few bytes: a log may have a million of them. `orphans`: indexes
    without their chunk, by how many chunks were met before. `checksum`: that of the data does not match. `undefined`:
    a channel is defined in the summary alone.
    """

    message_counts: Counter[int] = field(default_factory=Counter)
    chunks: ChunkList = field(default_factory=ChunkList)
    orphans: list[tuple[int, DamageError]] = field(default_factory=list)
    checksum: DamageError | None = None
    undefined: DamageError | None = None
    attachments: int = 0
    metadata: int = 0
    span_ns: tuple[int, int] | None = None

    @property
    def unexplained(self) -> list[DamageError]:
        """What no lost chunk explains so far."""
        return [*filter(None, [self.undefined, self.checksum]), *(damage for _, damage in self.orphans)]

    def explain(self, lost_before: set[int]) -> None:
        """Chunks were lost before these, with definitions; the checksum cannot match, indexes there have no chunk."""
        if lost_before:
            self.orphans = [orphan for orphan in self.orphans if orphan[0] not in lost_before]
            self.checksum = None
            self.undefined = None

    def add_orphan(self, damage: DamageError) -> None:
        """What contradicts the log, unless it turns out that a chunk was lost there."""
        self.orphans.append((len(self.chunks), damage))

    def add_times(self, low_ns: int, high_ns: int) -> None:
        """Widen the span of log times by these, the earliest and the latest of a block [ns]."""
        old = self.span_ns or (low_ns, high_ns)
        self.span_ns = (min(old[0], low_ns), max(old[1], high_ns))


class Summary:
    """The summary section, record by record; raises where it contradicts what was met.

    `lost`: what it declares beyond that.
    """

    def __init__(self, start: int, counted: WalkCounts, channels: Mapping[int, Channel]) -> None:
        self.lost: list[str] = []
        self._start = start
        self._counted = counted
        self._channels = channels
        self._stated_chunks: int | None = None
        self._crc = 0
        self._listed = ChunkList()

    def add(self, opcode: int, whole: bytes, position: int) -> None:
        """A record before the footer."""
        self._crc = crc32(whole, self._crc)
        if opcode == Opcode.CHUNK_INDEX:
            index = parse(ChunkIndex, whole[HEAD_SIZE:], position)
            length = index.chunk_length + index.message_index_length
            self._listed.add(index, index.chunk_start_offset, index.chunk_length, length)
        elif opcode == Opcode.STATISTICS:
            self._check_statistics(parse(Statistics, whole[HEAD_SIZE:], position), position)

    def _check_statistics(self, stated: Statistics, position: int) -> None:
        """Fewer records than stated are a loss, which is said; everything else that differs is a contradiction."""
        counted = self._counted
        per_channel = {channel: count for channel, count in stated.channel_message_counts.items() if count}
        counts = dict(counted.message_counts)
        pairs: list[tuple[str, object, object]] = [
            ("attachments", stated.attachment_count, counted.attachments),
            ("metadata records", stated.metadata_count, counted.metadata),
        ]
        if _is_less(counts, per_channel or counts) and counts != (per_channel or counts):
            lost = [(channel, counts.get(channel, 0), count) for channel, count in sorted(per_channel.items())]
            self.lost += [_loss(f"messages of {self._topic(of)}", *both) for of, *both in lost if both[0] < both[1]]
        elif per_channel:
            pairs.append(("messages per channel", per_channel, counts))
        for name, held, count in (
            ("messages", counted.message_counts.total(), stated.message_count),
            ("chunks", len(counted.chunks), stated.chunk_count),
        ):
            if held < count:
                self.lost += [_loss(name, held, count)] if name == "chunks" or not self.lost else []
            else:
                pairs.append((name, count, held))
        self._stated_chunks = stated.chunk_count
        if counted.span_ns:
            # Some writers take a first time of 0 for none yet, and state the earliest after it.
            start_ns = stated.message_start_time if counted.span_ns[0] else 0
            span_ns = (start_ns, stated.message_end_time)
            if not (self.lost and start_ns <= counted.span_ns[0] and counted.span_ns[1] <= span_ns[1]):
                pairs.append(("times", span_ns, counted.span_ns))
        for name, recorded, found in pairs:
            if recorded != found:
                raise DamageError(position, f"the statistics record gives {recorded} {name}, the file holds {found}")

    def _topic(self, channel_id: int) -> str:
        """The topic of a channel, or its number where the channel is not known."""
        return self._channels[channel_id].topic if channel_id in self._channels else f"channel {channel_id}"

    def finish(self, footer: bytes, position: int) -> None:
        """The footer. A chunk index lists every chunk once, or there is none."""
        stated = parse(Footer, footer[HEAD_SIZE:], position)
        start = self._start if position != self._start else 0
        if stated.summary_crc and crc32(footer[:-4], self._crc) != stated.summary_crc:
            raise DamageError(position, "the checksum of the summary does not match")
        missing = stated.summary_start - start
        elsewhere = DamageError(position, f"the footer places the summary at {stated.summary_start}, it is at {start}")
        if missing < 0 or (missing and not start):
            raise elsewhere
        lost_before = self._lost_before(missing, position)
        if missing and not self.lost:
            raise elsewhere
        self._counted.explain(lost_before)

    def _lost_before(self, missing: int, position: int) -> set[int]:
        """Before which chunks others were lost, as the chunk index shows; `lost` names them where nothing else did."""
        counted = self._counted.chunks
        listed = self._listed.sorted()
        if not len(listed) or listed.is_same(counted):
            return set()
        lost_before = counted.lost_of(listed, missing)
        if not lost_before or self._stated_chunks not in (None, len(listed)):
            raise DamageError(position, "the chunk index disagrees with the chunks")
        self.lost = self.lost or [_loss("chunks", len(counted), len(listed))]
        return lost_before


def _is_less(counts: Mapping[int, int], stated: Mapping[int, int]) -> bool:
    """Whether no channel has more messages than stated."""
    return all(count <= stated.get(channel, 0) for channel, count in counts.items())


def _loss(what: str, held: int, declared: int) -> str:
    """A loss in words: how many are held of those that are declared."""
    return f"{held} of {declared} {what} that are declared"
