"""Records of an MCAP file, each read strictly inside its own length (MCAP specification, "Records")."""

from __future__ import annotations

import struct
from struct import Struct
from typing import Any, TypeVar

import pyarrow as pa
from isal.isal_zlib import crc32
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.records import Chunk, McapRecord

from schemas.frozen import frozen

MAGIC = b"\x89MCAP0\r\n"
HEAD = Struct("<BQ")  # opcode, length of what follows
HEAD_SIZE = HEAD.size


class DamageError(Exception):
    """A log that contradicts itself, at a byte offset of the file."""

    def __init__(self, offset: int, kind: str) -> None:
        super().__init__(f"damaged at byte {offset}: {kind}")


@frozen
class Schema:
    """A schema record: how the messages of a channel are written; `data` in the language that `encoding` names."""

    id: int
    name: str
    encoding: str
    data: bytes


@frozen
class Channel:
    """A channel with its schema; `file` serves error messages, `notes` are this program's in the channel's metadata."""

    id: int
    topic: str
    encoding: str
    schema: Schema | None
    file: str
    notes: tuple[tuple[str, str], ...] = ()

    @property
    def place(self) -> str:
        """File and topic, for error messages."""
        return f"{self.file}: topic {self.topic}"

    @property
    def schema_name(self) -> str:
        """Name of the schema; empty where the channel has none."""
        return self.schema.name if self.schema else ""

    @property
    def schema_encoding(self) -> str:
        """Language of the schema (`protobuf`, `ros2msg`); empty where the channel has none."""
        return self.schema.encoding if self.schema else ""


Record = TypeVar("Record", bound=McapRecord)
_U16, _U32, _U64 = Struct("<H"), Struct("<I"), Struct("<Q")
_INDEX_HEAD = Struct("<HI")
_INDEX_ENTRY_SIZE = 16
_LARGE = 16 * 1024  # bytes


class _Stream(ReadDataStream):
    """As of the `mcap` package, but a field that its record cuts short is an error, and what a chunk holds no copy."""

    def __init__(self, record: bytes) -> None:
        self._record = memoryview(record)
        self._count = 0

    def read(self, length: int) -> Any:
        """The next bytes of the record; a view where they are many. Raises `EndOfFile` where fewer are left."""
        content = self._record[self._count :][:length]
        if len(content) < length:
            raise EndOfFile
        self._count += length
        return content if length > _LARGE else bytes(content)

    def _number(self, kind: Struct) -> int:
        """The next integer, of this kind."""
        value: int = kind.unpack_from(self._record, self._count)[0]
        self._count += kind.size
        return value

    def read2(self) -> int:
        """The next unsigned integer of 16 bits."""
        return self._number(_U16)

    def read4(self) -> int:
        """The next unsigned integer of 32 bits."""
        return self._number(_U32)

    def read8(self) -> int:
        """The next unsigned integer of 64 bits."""
        return self._number(_U64)


def parse(kind: type[Record], body: bytes, offset: int) -> Record:
    """A record by the reader of the `mcap` package; it must be used up exactly."""
    stream = _Stream(body)
    name = kind.__name__
    try:
        record: Record = kind.read(stream)  # type: ignore[attr-defined]
    except UnicodeDecodeError:
        raise DamageError(offset, f"a text of a {name} record is not UTF-8") from None
    except (EndOfFile, OverflowError, struct.error):
        raise DamageError(offset, f"a field runs past the end of its {name} record") from None
    if stream.count != len(body):
        raise DamageError(offset, f"a {name} record is longer than its fields")
    return record


def parse_message_index(body: bytes, offset: int) -> tuple[int, memoryview]:
    """Channel and the array of (log time, offset in the chunk), 16 bytes each."""
    entries = memoryview(body)[_INDEX_HEAD.size :]
    if len(body) < _INDEX_HEAD.size or _INDEX_HEAD.unpack_from(body)[1] != len(entries):
        raise DamageError(offset, "the array of a MessageIndex record does not fill it")
    if len(entries) % _INDEX_ENTRY_SIZE:
        raise DamageError(offset, "an array of a MessageIndex record ends inside an entry")
    return _INDEX_HEAD.unpack_from(body)[0], entries


def unpacked(chunk: Chunk, offset: int) -> bytes | pa.Buffer:
    """The records of a chunk: exactly the declared size, with the declared checksum, or an error."""
    size = chunk.uncompressed_size
    try:
        content = _decompressed(chunk)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise DamageError(offset, f"a chunk cannot be decompressed ({error})") from None
    if content is None:
        raise DamageError(offset, f"a chunk has the unknown compression {chunk.compression!r}")
    if len(content) != size:
        raise DamageError(offset, f"a chunk holds {len(content)} bytes or more but declares {size}")
    if chunk.uncompressed_crc and crc32(content) != chunk.uncompressed_crc:
        raise DamageError(offset, "the checksum of a chunk does not match its content")
    return content


def _decompressed(chunk: Chunk) -> bytes | pa.Buffer | None:
    """No more than one byte above the declared size; none where the compression is not known."""
    if chunk.compression == "":
        return chunk.data
    if chunk.compression == "zstd":
        return pa.decompress(chunk.data, chunk.uncompressed_size, codec="zstd")
    if chunk.compression == "lz4":
        # As a stream: at once it would not say when a frame ends short of the declared size.
        with pa.CompressedInputStream(pa.BufferReader(chunk.data), "lz4") as stream:
            return stream.read_buffer(chunk.uncompressed_size + 1)
    return None
