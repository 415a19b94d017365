"""What says that a run is complete, in either form: its `runs` file, or its row in the index of a pack (`packs`)."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import polars as pl

from pipeline.storage.described import PREFIX
from schemas.frozen import frozen

NAME = "runs"
"""The table whose file marks a run complete."""


@frozen
class Marker:
    """`source`: the `runs` file, or its metadata as JSON; `sha256`: of that file, which holds those of the others."""

    run_id: str
    sha256: str
    source: bytes | str

    @classmethod
    def of_file(cls, run_id: str, content: bytes) -> Marker:
        """The marker of a run from the content of its `runs` file."""
        return cls(run_id, sha256(content), content)

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata that `store.write_run` was given; nothing of a file that cannot be read."""
        return dict(json.loads(self.source)) if isinstance(self.source, str) else metadata_of(self.source)


def metadata_of(source: Path | bytes) -> dict[str, str]:
    """The program's own metadata of a file; nothing of a file that cannot be read."""
    try:
        metadata = pl.read_parquet_metadata(source)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError):
        return {}
    return {key.removeprefix(PREFIX): value for key, value in metadata.items() if key.startswith(PREFIX)}


def sha256(content: bytes | None) -> str:
    """The digest of a file's content; empty for a file that is not there."""
    return "" if content is None else hashlib.sha256(content).hexdigest()
