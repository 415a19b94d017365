"""Records of an MCAP file, each read strictly inside its own length (MCAP specification, "Records")."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from struct import Struct
from typing import NamedTuple

from pipeline.ingest.mcap_model import Schema

MAGIC = b"\x89MCAP0\r\n"
HEAD = Struct("<BQ")  # opcode, length of what follows
HEAD_SIZE = HEAD.size


class Op(IntEnum):
    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


class DamageError(Exception):
    """A log that contradicts itself, at a byte offset of the file."""

    def __init__(self, offset: int, kind: str) -> None:
        self.offset = offset
        self.kind = kind
        super().__init__(f"damaged at byte {offset}: {kind}")


_U16, _U32, _U64 = Struct("<H"), Struct("<I"), Struct("<Q")
_CHUNK_HEAD = Struct("<QQQI")
_INDEX_ENTRY = Struct("<QQ")
_CHUNK_INDEX_HEAD, _CHUNK_INDEX_SIZES = Struct("<QQQQ"), Struct("<QQ")
_COUNT_OF_CHANNEL = Struct("<HQ")


class Cursor:
    """Reads the fields of one record; none may run past its end."""

    def __init__(self, body: memoryview, offset: int, record: str) -> None:
        self._body = body
        self._at = 0
        self._offset = offset
        self._record = record

    def _take(self, size: int) -> memoryview:
        end = self._at + size
        if end > len(self._body):
            raise DamageError(self._offset, f"a field runs past the end of its {self._record} record")
        part = self._body[self._at : end]
        self._at = end
        return part

    def u16(self) -> int:
        return int(_U16.unpack(self._take(2))[0])

    def u32(self) -> int:
        return int(_U32.unpack(self._take(4))[0])

    def u64(self) -> int:
        return int(_U64.unpack(self._take(8))[0])

    def fixed(self, fields: Struct) -> tuple[int, ...]:
        """Several numbers at once."""
        return fields.unpack(self._take(fields.size))

    def data(self, size: int) -> memoryview:
        return self._take(size)

    def text(self) -> str:
        content = bytes(self._take(self.u32()))
        try:
            return content.decode("utf-8")
        except UnicodeDecodeError:
            raise DamageError(self._offset, f"a text of a {self._record} record is not UTF-8") from None

    def rest(self) -> memoryview:
        return self._take(len(self._body) - self._at)

    def finish(self) -> None:
        """Fields that later versions append to a record are none of ours; unread bytes of known ones are."""
        if self._at != len(self._body):
            raise DamageError(self._offset, f"a {self._record} record is longer than its fields")

    def array(self, entry: Struct) -> memoryview:
        """An array that is prefixed by its length in bytes."""
        content = self._take(self.u32())
        if len(content) % entry.size:
            raise DamageError(self._offset, f"an array of a {self._record} record ends inside an entry")
        return content


@dataclass(frozen=True)
class ChannelRecord:
    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: tuple[tuple[str, str], ...]


class ChunkRecord(NamedTuple):
    """A chunk as it stands in the file; `records` is still compressed."""

    offset: int
    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    records: memoryview


class ChunkSummary(NamedTuple):
    """What the file's chunk index says of a chunk, and what the walk found."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    compression: str
    compressed_size: int
    size: int


@dataclass(frozen=True)
class Statistics:
    messages: int
    attachments: int
    metadata: int
    chunks: int
    start_ns: int
    end_ns: int
    by_channel: Mapping[int, int]


def parse_schema(body: memoryview, offset: int) -> Schema:
    cursor = Cursor(body, offset, "Schema")
    schema_id = cursor.u16()
    if schema_id == 0:
        raise DamageError(offset, "a Schema record has the id 0")
    name, encoding = cursor.text(), cursor.text()
    data = bytes(cursor.data(cursor.u32()))
    cursor.finish()
    return Schema(schema_id, name, encoding, data)


def parse_channel(body: memoryview, offset: int) -> ChannelRecord:
    cursor = Cursor(body, offset, "Channel")
    channel_id, schema_id = cursor.u16(), cursor.u16()
    topic, encoding = cursor.text(), cursor.text()
    metadata = Cursor(cursor.data(cursor.u32()), offset, "Channel")
    cursor.finish()
    return ChannelRecord(channel_id, schema_id, topic, encoding, tuple(_pairs(metadata)))


def _pairs(cursor: Cursor) -> list[tuple[str, str]]:
    pairs = []
    while cursor._at < len(cursor._body):
        pairs.append((cursor.text(), cursor.text()))
    return pairs


def parse_chunk(body: memoryview, offset: int) -> ChunkRecord:
    cursor = Cursor(body, offset, "Chunk")
    start_ns, end_ns, size, crc = cursor.fixed(_CHUNK_HEAD)
    compression = cursor.text()
    records = cursor.data(cursor.u64())
    cursor.finish()
    return ChunkRecord(offset, start_ns, end_ns, size, crc, compression, records)


def parse_message_index(body: memoryview, offset: int) -> tuple[int, memoryview]:
    """Channel and the array of (log time, offset in the chunk), 16 bytes each."""
    cursor = Cursor(body, offset, "MessageIndex")
    channel_id = cursor.u16()
    entries = cursor.array(_INDEX_ENTRY)
    cursor.finish()
    return channel_id, entries


def parse_chunk_index(body: memoryview, offset: int) -> ChunkSummary:
    cursor = Cursor(body, offset, "ChunkIndex")
    start_ns, end_ns, chunk_offset, length = cursor.fixed(_CHUNK_INDEX_HEAD)
    cursor.array(_COUNT_OF_CHANNEL)
    cursor.u64()
    compression = cursor.text()
    compressed_size, size = cursor.fixed(_CHUNK_INDEX_SIZES)
    cursor.finish()
    return ChunkSummary(start_ns, end_ns, chunk_offset, length, compression, compressed_size, size)


def parse_statistics(body: memoryview, offset: int) -> Statistics:
    cursor = Cursor(body, offset, "Statistics")
    messages = cursor.u64()
    cursor.u16()  # schemas and channels are counted as registered, which some writers do before use
    cursor.u32()
    attachments, metadata, chunks = cursor.u32(), cursor.u32(), cursor.u32()
    start_ns, end_ns = cursor.u64(), cursor.u64()
    counts = dict(_COUNT_OF_CHANNEL.iter_unpack(cursor.array(_COUNT_OF_CHANNEL)))
    cursor.finish()
    return Statistics(messages, attachments, metadata, chunks, start_ns, end_ns, counts)


def parse_attachment_lengths(head: memoryview, length: int, offset: int) -> None:
    """Whether the declared lengths of an attachment fit its record; the content itself is not needed."""
    cursor = Cursor(head, offset, "Attachment")
    cursor.data(16)
    cursor.text()
    cursor.text()
    size = cursor.u64()
    if cursor._at + size + 4 != length:
        raise DamageError(offset, "the content of an Attachment record does not fill it")
