"""A pipe given as a file: reading one can last for ever."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from pipeline.storage.files import open_binary, read_bytes
from schemas.errors import InputError


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log.mcap")
    for read in (read_bytes, open_binary):
        with pytest.raises(InputError, match="is no regular file"):
            read(tmp_path / "log.mcap")
