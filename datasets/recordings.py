"""Which public recording a path holds, if any."""

from __future__ import annotations

from pathlib import Path

from datasets import infrabel
from datasets.comma2k19 import comma2k19_run
from pipeline.receivers import Converted


def known_recording(path: Path) -> Converted | None:
    """A segment of comma2k19 (a folder) or a log of the Infrabel train (a CSV with its columns); none if neither."""
    if (path / "processed_log").is_dir():
        return Converted(comma2k19_run(path)[0], {})
    if path.suffix.lower() != ".csv" or not path.is_file():
        return None
    with path.open("rb") as stream:
        head = stream.readline()
    return infrabel.infrabel_recording(path) if all(name.encode() in head for name in infrabel.COLUMNS) else None
