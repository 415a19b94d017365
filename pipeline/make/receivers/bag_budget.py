"""What a bag may unpack to. The reader of bags unpacks whatever stands in a file, a chunk or a message at once."""

from __future__ import annotations

import bz2
import os
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

from pipeline.make.receivers.unpack import open_zstd
from pipeline.read.ingest.mcap_run import walk_log
from pipeline.storage.budget import Budget
from schemas.config import IngestConfig
from schemas.errors import InputError

_MIB = 1024 * 1024
Unpack = Callable[[bytes], bytes]


def budget_of_bag(path: Path, config: IngestConfig) -> Budget:
    """The budget for the messages of a bag whose packed files are each within theirs; raises `InputError`."""
    files = [file for file in (sorted(path.iterdir()) if path.is_dir() else [path]) if file.is_file()]
    for file in files:
        if file.suffix == ".mcap":
            walk_log(file, config, _Nothing())
        elif file.suffix == ".zstd":
            budget = Budget(str(file), file.stat().st_size, config)
            with open_zstd(file) as packed, Path(os.devnull).open("wb") as nowhere:
                budget.copy(packed, nowhere)
    return Budget(str(path), sum(file.stat().st_size for file in files), config)


class _Nothing:
    """Takes the messages of a log that is only walked."""

    def add(self, *_: Any) -> None:
        """Take a message, and do nothing with it."""


def unpacker_of(bag: Any, place: str, config: IngestConfig) -> Unpack:
    """What unpacks one message of an opened bag. Its chunks, of ROS 1, are bounded from here on."""
    packed_messages = False
    for reader in bag.readers:
        if not bag.is2:
            reader.chunks = {at: _bounded_chunk(chunk, place, config) for at, chunk in reader.chunks.items()}
        elif reader.storage.metadata.compression_mode == "message":
            reader.storage.metadata = reader.storage.metadata._replace(compression_mode=None)
            packed_messages = True
    return _bounded_unpacker(open_zstd, place, config) if packed_messages else bytes


def _bounded_chunk(chunk: Any, place: str, config: IngestConfig) -> Any:
    """A chunk of a ROS 1 bag that unpacks no more than the limit."""
    from lz4 import frame as lz4

    openers = {bz2.decompress: bz2.open, lz4.decompress: lz4.open}
    opener = openers.get(chunk.decompressor)
    return chunk if opener is None else chunk._replace(decompressor=_bounded_unpacker(opener, place, config))


def _bounded_unpacker(opener: Callable[[BytesIO], Any], place: str, config: IngestConfig) -> Unpack:
    """An unpacking that stops at the limit."""
    most = int(config.chunk_limit_mib * _MIB)

    def unpack(packed: bytes) -> bytes:
        """Unpack a chunk or message; raises `InputError` beyond the limit."""
        with opener(BytesIO(packed)) as stream:
            content = stream.read(most + 1)
        if len(content) > most:
            expected = f"at most {config.chunk_limit_mib:g} MiB ([ingest] chunk_limit_mib)"
            raise InputError("a chunk or message unpacks to too much", place=place, expected=expected)
        return bytes(content)

    return unpack
