"""What an MCAP file consists of, as far as reading a run needs it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Schema:
    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True)
class Channel:
    """A channel with its schema; `file` serves error messages."""

    id: int
    topic: str
    encoding: str
    schema: Schema | None
    file: str

    @property
    def place(self) -> str:
        return f"{self.file}: topic {self.topic}"

    @property
    def schema_name(self) -> str:
        return self.schema.name if self.schema else ""

    @property
    def schema_encoding(self) -> str:
        return self.schema.encoding if self.schema else ""
