"""By which build of the program a result was made."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

# What the program is made of: pages also follow from their styles, scripts and words.
_SOURCES = {".css", ".csv", ".html", ".js", ".py", ".toml"}
_DECIDING_LIBRARIES = ("dataframely", "numpy", "polars", "pyarrow", "pyproj", "scipy")


@cache
def software_digest() -> str:
    """SHA-256 over the program's own sources and the versions of the libraries that its figures rest on.

    The version alone would let results of an edited checkout pass for its own.
    """
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for package in ("pipeline", "schemas"):
        for source in sorted(path for path in (root / package).rglob("*.*") if path.suffix in _SOURCES):
            digest.update(f"{source.relative_to(root).as_posix()} ".encode())
            digest.update(hashlib.sha256(source.read_bytes()).digest())
    for library in _DECIDING_LIBRARIES:
        digest.update(f"{library} {version(library)}\n".encode())
    return digest.hexdigest()
