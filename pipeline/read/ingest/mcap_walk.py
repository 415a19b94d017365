"""The strict walk through an MCAP file, front to back.

Indexes are never trusted to find data: every record is met in order and every length held against its
parent, so that nothing is read twice, left out or made up. What the file says about itself (indexes,
checksums, statistics) is then held against what was met.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Iterator
from typing import IO

from isal.isal_zlib import crc32
from mcap import records
from mcap.opcode import Opcode

from pipeline.read.ingest.mcap_block import (
    Allowance,
    Block,
    Piece,
    block_of,
    piece_of_chunk,
    piece_of_messages,
)
from pipeline.read.ingest.mcap_records import (
    HEAD,
    HEAD_SIZE,
    MAGIC,
    Channel,
    DamageError,
    Schema,
    parse,
    parse_message_index,
    unpacked,
)
from pipeline.read.ingest.mcap_summary import Summary, WalkCounts
from pipeline.storage.described import noted

_AFTER_THE_DATA = (
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.FOOTER, Opcode.SUMMARY_OFFSET,
    Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX,
)  # fmt: skip
_ONLY_THERE = _AFTER_THE_DATA[2:]
_KNOWN = int(max(Opcode))  # unknown records, of higher ones, are skipped, by specification
_TOGETHER = 256 * 1024  # smaller chunks are taken together; more would not stay in the processor's cache
_LEAST_PIECE = 8 * 1024  # what a piece that waits takes itself
_LOOSE = 64 * 1024  # of a log without chunks read at once
_FREE_RECORDS = 1 << 18  # records that the chunks of a log may hold beyond one per byte
_SLACK = 1024 * 1024  # what does not compress grows a little


class McapWalk:
    """Walks a log once; `blocks` yields its messages, the attributes hold what was met so far."""

    def __init__(
        self,
        stream: IO[bytes],
        size: int,
        file: str,
        chunk_limit: int,
        most_unpacked: int,
        first_ordinal: int = 0,
    ) -> None:
        self.channels: dict[int, Channel] = {}
        self.counts = WalkCounts()
        self.cut_at: int | None = None
        self.without_crc = 0  # blocks of messages whose content no checksum covers
        self._bare_chunks = array("q")  # contents of chunks without checksum, from and to
        self._stream = stream
        self._size = size
        self._file = file
        self._limit = chunk_limit
        self._left_to_unpack = most_unpacked
        self._schemas: dict[int, Schema] = {}
        self._known: set[bytes] = set()
        self._pieces: list[Piece] = []
        self._waiting = 0
        self._loose_until = 0
        self._ordinal = first_ordinal
        self._allowance = Allowance(_FREE_RECORDS + size)
        self._summary: Summary | None = None

    @property
    def next_ordinal(self) -> int:
        """Of the first message that follows in another file."""
        return self._ordinal

    @property
    def damages(self) -> list[str]:
        """What the file lacks: its end, or records that it declares."""
        cut = [] if self.cut_at is None else [f"cut off at byte {self.cut_at}"]
        return cut + ([] if self._summary is None else [f"holds {lost}" for lost in self._summary.lost])

    def message_counts(self) -> dict[str, int]:
        """Messages that were met, by topic."""
        counts: Counter[str] = Counter()
        for channel_id, count in self.counts.message_counts.items():
            counts[self.channels[channel_id].topic] += count
        return dict(counts)

    def blocks(self) -> Iterator[Block]:
        """All messages in order of the file. Stops at a cut, with `cut_at` set; raises `DamageError`.

        What comes before damage is handed out first.
        """
        damage: DamageError | None = None
        try:
            yield from self._walked()
        except DamageError as error:
            damage = error
        if self._pieces:
            yield self._block()
        for contradiction in [*self.counts.unexplained, *filter(None, [damage])]:
            raise contradiction

    def _walked(self) -> Iterator[Block]:
        """The messages in blocks, record by record to the end, a cut, or damage."""
        position = self._first_record()
        while position is not None:
            head = self._head(position)
            if head is None:
                break
            position = self._summary_record(*head, position) if self._summary else self._record(*head, position)
            if self._pieces and (self._summary or self._waiting >= _TOGETHER):
                yield self._block()

    def _read(self, position: int, length: int) -> bytes:
        """So many bytes of the file from a position on. Raises `OSError` where the file has become shorter."""
        self._stream.seek(position)
        content = self._stream.read(length)
        if len(content) < length:
            raise OSError(f"the file became shorter while it was read (expected {self._size} bytes)")
        return content

    def _first_record(self) -> int | None:
        """Position of the Header behind the magic bytes; none where the file is cut off before it ends."""
        if self._size == 0:
            raise DamageError(0, "the file is empty")
        start = self._read(0, min(self._size, len(MAGIC)))
        if not MAGIC.startswith(start):
            raise DamageError(0, "the file does not start with the MCAP magic bytes")
        if self._size == len(start):
            self.cut_at = self._size
            return None
        head = self._head(len(MAGIC))
        if head is not None and head[0] != Opcode.HEADER:
            raise DamageError(len(MAGIC), "the first record is not a Header")
        return len(MAGIC) if head is not None else None

    def _head(self, position: int) -> tuple[int, int] | None:
        """Opcode and length of the record here; none where the log is cut off."""
        left = self._size - position
        if left >= HEAD_SIZE:
            opcode, length = HEAD.unpack(self._read(position, HEAD_SIZE))
            if opcode == 0:
                self._check_zeros(position)
                return None
            if length <= left - HEAD_SIZE:
                return opcode, length
        if left and self._read(self._size - len(MAGIC), len(MAGIC)) == MAGIC:
            raise DamageError(position, "a record runs past the end of the file")
        self.cut_at = position
        return None

    def _check_zeros(self, position: int) -> None:
        """Only zeros to the end are space that was reserved but never written."""
        self._stream.seek(position)
        while piece := self._stream.read(_SLACK):
            if piece.strip(b"\0"):
                raise DamageError(position, "a record has the invalid opcode 0")
        self.cut_at = position

    def _record(self, opcode: int, length: int, position: int) -> int:
        """Meet one record of the data section; the position of the next."""
        if opcode == Opcode.MESSAGE_INDEX:
            self.counts.add_orphan(DamageError(position, "a message index does not follow a chunk"))
        if opcode == Opcode.MESSAGE:
            return self._loose_messages(length, position)
        if opcode == Opcode.CHUNK:
            return self._chunk(self._body(opcode, length, position), position)
        if opcode in _ONLY_THERE:
            raise DamageError(position, f"a {Opcode(opcode).name} record is not allowed in the data section")
        if opcode == Opcode.ATTACHMENT:  # passed by
            self.counts.attachments += 1
        elif opcode == Opcode.METADATA:
            self.counts.metadata += 1
        elif opcode <= _KNOWN:
            self._of_data(opcode, self._body(opcode, length, position), position)
        return position + HEAD_SIZE + length

    def _of_data(self, opcode: int, body: bytes, position: int) -> None:
        """Meet a record that is read whole: a definition, the Header, or the end of the data section."""
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._definition(opcode, body, position)
        elif opcode == Opcode.HEADER:
            if position != len(MAGIC):
                raise DamageError(position, "a second Header: two files may have been joined")
            parse(records.Header, body, position)
        elif opcode == Opcode.DATA_END:
            self._data_end(parse(records.DataEnd, body, position).data_section_crc, position)
            self._summary = Summary(position + HEAD_SIZE + len(body), self.counts, self.channels)

    def _body(self, opcode: int, length: int, position: int) -> bytes:
        """No record that is loaded whole may be larger than a chunk."""
        _check_size(f"a record of opcode {opcode}", length, self._limit + _SLACK, position)
        return self._read(position + HEAD_SIZE, length)

    def _definition(self, opcode: int, body: bytes, position: int) -> None:
        """A schema or channel; definitions are repeated in every chunk and in the summary."""
        key = bytes((opcode,)) + body
        if key not in self._known:
            (self._schema if opcode == Opcode.SCHEMA else self._channel)(body, position)
            self._known.add(key)

    def _schema(self, body: bytes, position: int) -> None:
        """Remember a schema; defined again, it must be the same."""
        record = parse(records.Schema, body, position)
        if record.id == 0:
            raise DamageError(position, "a Schema record has the id 0")
        schema = Schema(record.id, record.name, record.encoding, record.data)
        if self._schemas.setdefault(schema.id, schema) != schema:
            raise DamageError(position, f"schema {schema.id} is defined twice with different content")

    def _channel(self, body: bytes, position: int) -> None:
        """Remember a channel; its schema must be known, and defined again, it must be the same."""
        record = parse(records.Channel, body, position)
        schema = self._schemas.get(record.schema_id)
        notes = tuple(noted(record.metadata).items())
        channel = Channel(record.id, record.topic, record.message_encoding, schema, self._file, notes)
        if self.channels.get(record.id, channel) != channel:
            raise DamageError(position, f"channel {record.id} ({record.topic}) is defined twice with different content")
        if record.schema_id and schema is None:
            raise DamageError(position, f"schema {record.schema_id} of topic {record.topic} is missing")
        self.channels[record.id] = channel

    def _chunk(self, body: bytes, position: int) -> int:
        """The messages of a chunk; the position behind it and the message indexes that follow it."""
        chunk = parse(records.Chunk, body, position)
        size = chunk.uncompressed_size
        _check_size("a chunk", size, self._limit, position)
        end = position + HEAD_SIZE + len(body)
        if not chunk.uncompressed_crc and size:  # that of nothing is 0
            self._bare_chunks.extend((end - len(chunk.data), end))
            self.without_crc += 1
        self._left_to_unpack -= size
        if self._left_to_unpack < 0:
            raise DamageError(
                position, "the chunks unpack to too many times the size of the file ([ingest] unpacked_ratio_limit)"
            )
        record = HEAD_SIZE + len(body)
        content = unpacked(chunk, position)
        indexes, end = self._indexes(end, position, size)
        self.counts.chunks.add(chunk, position, record, record)
        orphan = self.counts.add_orphan
        self._keep(piece_of_chunk(content, position, self._chunk_record, self._allowance, indexes, orphan))
        return end

    def _indexes(self, position: int, chunk: int, room: int) -> tuple[list[tuple[int, memoryview]], int]:
        """Channel and entries of the message indexes of a chunk, and the position behind them or a cut in them."""
        indexes: list[tuple[int, memoryview]] = []
        while position + HEAD_SIZE <= self._size:
            opcode, length = HEAD.unpack(self._read(position, HEAD_SIZE))
            if opcode != Opcode.MESSAGE_INDEX or position + HEAD_SIZE + length > self._size:
                break
            room -= length
            if room < -_SLACK:  # a message takes more room in the chunk than its entry in an index
                raise DamageError(chunk, "a message index disagrees with its chunk")
            indexes.append(parse_message_index(self._read(position + HEAD_SIZE, length), position))
            position += HEAD_SIZE + length
        return indexes, position

    def _chunk_record(self, opcode: int, body: bytes, position: int) -> None:
        """A record inside a chunk that is no message."""
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._definition(opcode, body, position)
        elif opcode <= _KNOWN:
            raise DamageError(position, f"a record of opcode {opcode} is not allowed inside a chunk")

    def _loose_messages(self, length: int, position: int) -> int:
        """Messages outside of chunks, some at once; the position behind them."""
        _check_size("a message", length, self._limit + _SLACK, position)
        several = min(_LOOSE, self._size - position)
        piece = piece_of_messages(self._read(position, max(HEAD_SIZE + length, several)), position)
        self.without_crc += position != self._loose_until  # one for all that follow each other
        self._loose_until = position + piece.size
        self._keep(piece)
        return self._loose_until

    def _keep(self, piece: Piece) -> None:
        """Let the messages of a piece wait until there are enough for a block."""
        self._pieces.append(piece)
        self._waiting += max(piece.size, _LEAST_PIECE)

    def _block(self) -> Block:
        """The messages that wait."""
        pieces = self._pieces
        self._pieces = []
        self._waiting = 0
        block = block_of(pieces, self._ordinal)
        for channel_id, messages in block.items():
            if channel_id not in self.channels:
                self._define_lost(channel_id, pieces[0].offset)
            self.counts.message_counts[channel_id] += len(messages)
            first, last = int(messages.log_time.min()), int(messages.log_time.max())
            if first < 0:
                raise DamageError(pieces[0].offset, "a log time behind it is beyond the year 2262")
            self.counts.add_times(first, last)
        self._ordinal += sum(piece.size for piece in pieces)
        return block

    def _define_lost(self, channel_id: int, offset: int) -> None:
        """A channel that was defined in a chunk that is lost: the summary repeats all definitions."""
        unknown = DamageError(offset, f"a message behind it belongs to the unknown channel {channel_id}")
        position = len(MAGIC)
        in_summary = False
        while position + HEAD_SIZE <= self._size:
            opcode, length = HEAD.unpack(self._read(position, HEAD_SIZE))
            if length > self._size - position - HEAD_SIZE:
                break
            if in_summary and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._definition(opcode, self._body(opcode, length, position), position)
            in_summary = in_summary or opcode == Opcode.DATA_END
            position += HEAD_SIZE + length
        if channel_id not in self.channels:
            raise unknown
        self.counts.undefined = unknown

    def _data_end(self, crc: int, end: int) -> None:
        """The checksum over the whole data section, which few recorders write.

        The Rust writer leaves the contents of chunks out of it where chunks have no checksums.
        """
        if not crc:
            return
        if self._crc_of(end, array("q")) == crc:
            self.without_crc = 0
        elif self._bare_chunks and self._crc_of(end, self._bare_chunks) == crc:
            self.without_crc = len(self._bare_chunks) // 2
        else:
            self.counts.checksum = DamageError(end, "the checksum of the data section does not match")

    def _crc_of(self, end: int, left_out: array[int]) -> int:
        """CRC-32 of the file up to `end`, without some parts (each from and to)."""
        crc = at = 0
        for stop, resume in zip([*left_out[::2], end], [*left_out[1::2], end], strict=True):
            while at < stop:
                piece = self._read(at, min(stop - at, _SLACK))
                crc = crc32(piece, crc)
                at += len(piece)
            at = resume
        return crc

    def _summary_record(self, opcode: int, length: int, position: int) -> int | None:
        """A record behind the data; the position of the next, none after the closing magic."""
        assert self._summary is not None
        if opcode <= _KNOWN and opcode not in _AFTER_THE_DATA:
            raise DamageError(position, f"a {Opcode(opcode).name} record comes after the end of the data")
        body = self._body(opcode, length, position)
        whole = HEAD.pack(opcode, length) + body
        if opcode == Opcode.FOOTER:
            self._summary.finish(whole, position)
            self._check_end(position + len(whole))
            return None
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._definition(opcode, body, position)
        self._summary.add(opcode, whole, position)
        return position + len(whole)

    def _check_end(self, end: int) -> None:
        """The closing magic and nothing after it; a cut through it is one."""
        closing = self._read(end, min(len(MAGIC), self._size - end))
        if not MAGIC.startswith(closing):
            raise DamageError(end, "the magic bytes at the end are wrong")
        if closing != MAGIC:
            self.cut_at = end
        elif end + len(MAGIC) != self._size:
            raise DamageError(
                end + len(MAGIC), "there is data after the end of the file: two files may have been joined"
            )


def _check_size(what: str, size: int, limit: int, position: int) -> None:
    """Raise `DamageError` where something declares more bytes than the limit."""
    if size > limit:
        over = f"over the limit of {limit} ([ingest] chunk_limit_mib)"
        raise DamageError(position, f"{what} declares {size} bytes, {over}")
