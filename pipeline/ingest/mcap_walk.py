"""The strict walk through an MCAP file, front to back.

Indexes are never trusted to find data: every record is met in order and every length held against its
parent, so that nothing is read twice, left out or made up. What the file says about itself (indexes,
checksums, statistics) is then held against what was met.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import mcap.records
import numpy as np

from pipeline.ingest.byte_window import ByteWindow
from pipeline.ingest.decompress import Decompressor
from pipeline.ingest.mcap_block import Block, block_of
from pipeline.ingest.mcap_chunk import Allowance, Index, Placed, messages_in
from pipeline.ingest.mcap_model import Channel, Schema
from pipeline.ingest.mcap_records import (
    HEAD,
    HEAD_SIZE,
    MAGIC,
    ChunkRecord,
    DamageError,
    Op,
    check_attachment,
    parse,
    parse_chunk,
    parse_message_index,
)
from pipeline.ingest.mcap_summary import Met, Summary, chunk_entry

_DATA_OPS = (Op.CHUNK, Op.MESSAGE, Op.MESSAGE_INDEX, Op.ATTACHMENT, Op.METADATA, Op.DATA_END, Op.HEADER)
_TOGETHER = 8 * 1024 * 1024  # chunks of up to so many bytes are taken at once
_RAW_BLOCK = 1 << 16  # messages of a log without chunks that are handed on together
_LEAST_PENDING = 8 * 1024  # what a chunk that waits takes itself
_FREE_RECORDS = 1 << 18  # records of chunks without index that a log may hold beyond one per byte
_SLACK = 1024 * 1024  # what does not compress grows a little
_ATTACHMENT_HEAD = 64 * 1024  # holds times, name and media type of an attachment


@dataclass
class Pending:
    """A chunk whose message indexes are still being met."""

    chunk: ChunkRecord
    length: int
    indexes: list[Index] = field(default_factory=list)

    def entry(self) -> bytes:
        """What a chunk index must say of it."""
        chunk = self.chunk
        return chunk_entry(
            chunk.start_ns, chunk.end_ns, chunk.offset, self.length, len(chunk.records), chunk.size, chunk.compression
        )


class McapWalk:
    """Walks a log once; `blocks` yields its messages, the attributes tell what was met so far."""

    def __init__(self, window: ByteWindow, file: str, chunk_limit: int) -> None:
        self.channels: dict[int, Channel] = {}
        self.met = Met()
        self.data_crc = (0, 0)
        self.crc_covers_chunks = True
        self.without_own_crc = array("q")  # contents of chunks, from and to
        self._loose_blocks = 0
        self.cut_at: int | None = None
        self._window = window
        self._file = file
        self._limit = chunk_limit
        self._schemas: dict[int, Schema] = {}
        self._definitions: dict[int, mcap.records.Channel] = {}
        self._pending: list[Pending] = []
        self._pending_size = 0
        self._memory = np.empty(0, dtype=np.uint8)
        self._unpacker = Decompressor()
        self._ordinal = 0
        self._allowance = Allowance(_FREE_RECORDS + window.size)
        self._known: set[bytes] = set()
        self._summary: Summary | None = None

    def blocks(self) -> Iterator[Block]:
        """All messages in order of the file. Stops at a cut, with `cut_at` set; raises `DamageError`."""
        position = self._first_record()
        while position is not None:
            head = self._head(position)
            if head is None:
                break
            opcode, length = head
            if self._pending and not self._waits_for(opcode):
                yield self._finished_chunks()
            if opcode == Op.MESSAGE and self._summary is None:
                block, position = self._loose_messages(position)
                yield block
            else:
                position = self._record(opcode, length, position)
        if self._pending:
            # The cut may have taken part of the last chunk's indexes, so that chunk is walked instead.
            self._pending[-1].indexes.clear()
            yield self._finished_chunks()

    def _waits_for(self, opcode: int) -> bool:
        """Whether the chunks met last wait: for their indexes, or for neighbours to be taken with them."""
        return opcode == Op.MESSAGE_INDEX or (opcode == Op.CHUNK and self._pending_size < _TOGETHER)

    @property
    def without_crc(self) -> int:
        """Blocks of messages whose content no checksum covers."""
        loose = 0 if self.data_crc[0] else self._loose_blocks
        return loose + (0 if self.data_crc[0] and self.crc_covers_chunks else len(self.without_own_crc) // 2)

    def _first_record(self) -> int | None:
        size = self._window.size
        if size == 0:
            raise DamageError(0, "the file is empty")
        start = bytes(self._window.at(0, min(size, len(MAGIC))))
        if not MAGIC.startswith(start):
            raise DamageError(0, "the file does not start with the MCAP magic bytes")
        if size == len(start):
            self.cut_at = size
            return None
        head = self._head(len(MAGIC))
        if head is not None and head[0] != Op.HEADER:
            raise DamageError(len(MAGIC), "the first record is not a Header")
        return len(MAGIC) if head is not None else None

    def _head(self, position: int) -> tuple[int, int] | None:
        """Opcode and length of the record here; none where the log is cut off."""
        left = self._window.size - position
        if left >= HEAD_SIZE:
            opcode, length = HEAD.unpack_from(self._window.at(position, HEAD_SIZE))
            if opcode == 0:
                self._check_zeros(position)
                return None
            if length <= left - HEAD_SIZE:
                return opcode, length
        if left and self._window.ends_with(MAGIC):
            raise DamageError(position, "a record runs past the end of the file")
        self.cut_at = position
        return None

    def _check_zeros(self, position: int) -> None:
        if not self._window.is_zero_from(position):
            raise DamageError(position, "a record has the invalid opcode 0")
        self.cut_at = position

    def _loose_messages(self, position: int) -> tuple[Block, int]:
        """Messages outside of chunks, as many as are in memory and follow each other."""
        first = HEAD.unpack_from(self._window.at(position, HEAD_SIZE))[1]
        self._check_size("message", first, position)
        self._window.at(position, HEAD_SIZE + first)
        view = self._window.available(position)
        starts: list[int] = []
        at, room, message = 0, len(view) - HEAD_SIZE, int(Op.MESSAGE)
        unpack = HEAD.unpack_from
        while at <= room and len(starts) < _RAW_BLOCK:
            opcode, length = unpack(view, at)
            following = at + HEAD_SIZE + length
            if opcode != message or following > len(view):
                break
            starts.append(at)
            at = following
        self._loose_blocks += 1
        data = np.frombuffer(view[:at], dtype=np.uint8)
        block = block_of(data, np.array(starts, dtype=np.int64), position.__add__, self._ordinal)
        return self._counted(block, position, at), position + at

    def _record(self, opcode: int, length: int, position: int) -> int | None:
        """Meet one record; the position of the next, none after the closing magic."""
        following = position + HEAD_SIZE + length
        if self._summary is not None:
            return self._summary_record(opcode, length, position, self._summary)
        if opcode == Op.ATTACHMENT:
            self._attachment(length, position)
            return following
        if opcode not in _HANDLERS:
            self._other_record(opcode, position)
            return following
        self._check_size(_NAMES[opcode], length, position)
        body = self._window.at(position + HEAD_SIZE, length)
        _HANDLERS[opcode](self, body, position)
        return following

    def _check_size(self, name: str, length: int, position: int) -> None:
        """No record that is loaded whole may be larger than a chunk (attachments are passed by)."""
        limit = self._limit + _SLACK
        if length > limit:
            raise DamageError(
                position,
                f"a {name} record declares {length} bytes, over the limit of {limit} ([ingest] chunk_limit_mib)",
            )

    def _other_record(self, opcode: int, position: int) -> None:
        """Unknown opcodes are skipped, by specification; known ones stand where they must not."""
        if opcode <= max(Op):
            raise DamageError(position, f"a {Op(opcode).name} record is not allowed in the data section")

    def _header(self, body: memoryview, position: int) -> None:
        if position != len(MAGIC):
            raise DamageError(position, "a second Header: two files may have been joined")
        parse(mcap.records.Header, body, position)

    def _schema(self, body: memoryview, position: int) -> None:
        record = parse(mcap.records.Schema, body, position)
        if record.id == 0:
            raise DamageError(position, "a Schema record has the id 0")
        schema = Schema(record.id, record.name, record.encoding, record.data)
        if self._schemas.setdefault(schema.id, schema) != schema:
            raise DamageError(position, f"schema {schema.id} is defined twice with different content")

    def _channel(self, body: memoryview, position: int) -> None:
        record = parse(mcap.records.Channel, body, position)
        if self._definitions.setdefault(record.id, record) != record:
            raise DamageError(position, f"channel {record.id} ({record.topic}) is defined twice with different content")
        if record.schema_id and record.schema_id not in self._schemas:
            raise DamageError(position, f"schema {record.schema_id} of topic {record.topic} is missing")
        schema = self._schemas.get(record.schema_id)
        if record.id not in self.channels:
            self.channels[record.id] = Channel(record.id, record.topic, record.message_encoding, schema, self._file)

    def _chunk(self, body: memoryview, position: int) -> None:
        chunk = parse_chunk(body, position)
        if chunk.size > self._limit:
            told = f"a chunk declares {chunk.size} bytes, over the limit of {self._limit} ([ingest] chunk_limit_mib)"
            raise DamageError(position, told)
        end = position + HEAD_SIZE + len(body)
        if not chunk.crc and chunk.size:  # that of nothing is 0
            self.without_own_crc.extend((end - len(chunk.records), end))
        self._pending.append(Pending(chunk, len(body) + HEAD_SIZE))
        self._pending_size += max(chunk.size, len(body), _LEAST_PENDING)

    def _message_index(self, body: memoryview, position: int) -> None:
        if not self._pending:
            raise DamageError(position, "a message index does not follow a chunk")
        channel, entries = parse_message_index(body, position)
        if len(entries):  # recovered logs have empty ones
            self._pending[-1].indexes.append((channel, entries))

    def _attachment(self, length: int, position: int) -> None:
        head = self._window.at(position + HEAD_SIZE, min(length, _ATTACHMENT_HEAD))
        check_attachment(head, length, position)
        self.met.attachments += 1

    def _metadata_record(self, body: memoryview, position: int) -> None:
        self.met.metadata += 1

    def _data_end(self, body: memoryview, position: int) -> None:
        self.data_crc = (parse(mcap.records.DataEnd, body, position).data_section_crc, position)
        self._summary = Summary(position + HEAD_SIZE + len(body), self.met)

    def _finished_chunks(self) -> Block:
        """The messages of the chunks that waited, which are taken at once."""
        pending, self._pending = self._pending, []
        size, self._pending_size = sum(waiting.chunk.size for waiting in pending), 0
        if size > len(self._memory):
            self._memory = np.empty(max(size, _TOGETHER + _SLACK), dtype=np.uint8)
        data = self._memory[:size]
        placed: list[Placed] = []
        for waiting in pending:
            chunk = waiting.chunk
            placed.append(Placed(placed[-1].end if placed else 0, chunk.size, chunk.offset, waiting.indexes))
            self._unpacker.unpack(chunk, memoryview(data.data)[placed[-1].base : placed[-1].end])
            self.met.chunks += waiting.entry()
        found = messages_in(data, placed, self._ordinal, self._chunk_record, self._allowance)
        return self._counted(found, placed[0].offset, size)

    def _chunk_record(self, opcode: int, body: memoryview, position: int) -> None:
        """A record inside a chunk that is no message; definitions are repeated in every chunk."""
        if opcode in (Op.SCHEMA, Op.CHANNEL):
            key = bytes((opcode,)) + body
            if key not in self._known:
                _HANDLERS[opcode](self, body, position)
                self._known.add(key)
        elif opcode <= max(Op):
            raise DamageError(position, f"a record of opcode {opcode} is not allowed inside a chunk")

    def _counted(self, block: Block, offset: int, size: int) -> Block:
        for channel_id, messages in block.items():
            if channel_id not in self.channels:
                raise DamageError(offset, f"a message belongs to the unknown channel {channel_id}")
            self.met.message_counts[channel_id] += len(messages)
            times = messages.heads["log_time"]
            if times.min() < 0:
                raise DamageError(offset, "a log time is beyond the year 2262")
            self.met.add_times(int(times.min()), int(times.max()))
        self._ordinal += size
        return block

    def _summary_record(self, opcode: int, length: int, position: int, summary: Summary) -> int | None:
        if opcode in _DATA_OPS:
            raise DamageError(position, f"a {Op(opcode).name} record comes after the end of the data")
        self._check_size("summary", length, position)
        whole = self._window.at(position, HEAD_SIZE + length)
        if opcode == Op.FOOTER:
            self.cut_at = summary.finish(whole, position, self._window)
            return None
        if opcode in (Op.SCHEMA, Op.CHANNEL):
            _HANDLERS[opcode](self, whole[HEAD_SIZE:], position)
        summary.add(opcode, whole, position)
        return position + HEAD_SIZE + length


_NAMES = {int(op): op.name for op in Op}
_HANDLERS: dict[int, Callable[[McapWalk, memoryview, int], None]] = {
    Op.HEADER: McapWalk._header,
    Op.SCHEMA: McapWalk._schema,
    Op.CHANNEL: McapWalk._channel,
    Op.CHUNK: McapWalk._chunk,
    Op.MESSAGE_INDEX: McapWalk._message_index,
    Op.METADATA: McapWalk._metadata_record,
    Op.DATA_END: McapWalk._data_end,
}
