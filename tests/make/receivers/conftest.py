"""Messages in a receiver's log, converted."""

from __future__ import annotations

import pytest

from pipeline.make.receivers import convert


@pytest.fixture
def converted(tmp_path):
    def of(*parts: bytes):
        path = tmp_path / "receiver.log"
        path.write_bytes(b"".join(parts))
        return convert([path], "r")

    return of
