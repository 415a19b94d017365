"""Records of an MCAP file, each read strictly inside its own length (MCAP specification, "Records")."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from io import BytesIO
from struct import Struct
from typing import NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.records import McapRecord

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


Record = TypeVar("Record", bound=McapRecord)

_CHUNK_HEAD = Struct("<QQQII")  # first and last time, size, checksum, length of the name of the compression
_LENGTH = Struct("<Q")
_INDEX_HEAD, _INDEX_ENTRY_SIZE = Struct("<HI"), 16


class _Stream(ReadDataStream):
    """As of the `mcap` package, but a field that its record cuts short is an error."""

    def read(self, length: int) -> bytes:
        content = super().read(length)
        if len(content) < length:
            raise EndOfFile
        return content


class ChunkRecord(NamedTuple):
    """A chunk as it stands in the file; `records` is still compressed."""

    offset: int
    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    records: memoryview


def parse(kind: type[Record], body: memoryview, offset: int) -> Record:
    """A record by the reader of the `mcap` package; it must be used up exactly."""
    stream = _Stream(BytesIO(body))
    with _reading(kind.__name__, offset):
        record: Record = kind.read(stream)  # type: ignore[attr-defined]
    _check_used_up(kind.__name__, stream.count, len(body), offset)
    return record


def parse_chunk(body: memoryview, offset: int) -> ChunkRecord:
    """A chunk; its records are not copied."""
    with _reading("Chunk", offset):
        start_ns, end_ns, size, crc, length = _CHUNK_HEAD.unpack_from(body)
        name_end = _CHUNK_HEAD.size + length
        compression = str(body[_CHUNK_HEAD.size : name_end], "utf-8")
        (records_size,) = _LENGTH.unpack_from(body, name_end)
    first = name_end + _LENGTH.size
    _check_used_up("Chunk", first + records_size, len(body), offset)
    return ChunkRecord(offset, start_ns, end_ns, size, crc, compression, body[first:])


def parse_message_index(body: memoryview, offset: int) -> tuple[int, memoryview]:
    """Channel and the array of (log time, offset in the chunk), 16 bytes each."""
    with _reading("MessageIndex", offset):
        channel_id, size = _INDEX_HEAD.unpack_from(body)
    _check_used_up("MessageIndex", _INDEX_HEAD.size + size, len(body), offset)
    if size % _INDEX_ENTRY_SIZE:
        raise DamageError(offset, "an array of a MessageIndex record ends inside an entry")
    return channel_id, body[_INDEX_HEAD.size :]


def check_attachment(head: memoryview, length: int, offset: int) -> None:
    """Whether the declared lengths of an attachment fit its record; the content itself is not needed."""
    stream = _Stream(BytesIO(head))
    with _reading("Attachment", offset):
        stream.read(16)
        stream.read_prefixed_string()
        stream.read_prefixed_string()
        size = stream.read8()
    if stream.count + size + 4 != length:
        raise DamageError(offset, "the content of an Attachment record does not fill it")


@contextmanager
def _reading(record: str, offset: int) -> Iterator[None]:
    try:
        yield
    except UnicodeDecodeError:
        raise DamageError(offset, f"a text of a {record} record is not UTF-8") from None
    except (EndOfFile, struct.error):
        raise DamageError(offset, f"a field runs past the end of its {record} record") from None


def _check_used_up(record: str, used: int, size: int, offset: int) -> None:
    if used > size:
        raise DamageError(offset, f"a field runs past the end of its {record} record")
    if used < size:
        raise DamageError(offset, f"a {record} record is longer than its fields")
