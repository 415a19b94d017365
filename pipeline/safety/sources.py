"""What a result was made from, as its manifest tells it."""

from __future__ import annotations

import hashlib
from typing import Any

import polars as pl

from pipeline import storage
from pipeline.results.manifest import NAME, read_manifest
from pipeline.storage.address import Address, join

_SHOWN = 8
_SCHEMA = {"kind": pl.String, "of": pl.String, "name": pl.String, "bytes": pl.Int64, "sha256": pl.String}


def source_files(out: Address) -> pl.DataFrame:
    """`kind, of, name, bytes, sha256`: manifest, program, settings, site and logs; none without a manifest."""
    manifest = read_manifest(out)
    if manifest is None:
        return pl.DataFrame(schema=_SCHEMA)
    content = storage.content_of(join(out, NAME)) or b""
    rows: list[tuple[str, str, str, int | None, str]] = [
        ("manifest", "", NAME, len(content), hashlib.sha256(content).hexdigest())
    ]
    made = {(run["software"], run["software_digest"]) for run in manifest["runs"].values()}
    rows += [("program", "", software or "", None, digest or "") for software, digest in sorted(made, key=str)]
    for entries in manifest["settings"].values():
        rows += [_row(kind, "", file) for entry in entries for kind, file in entry.items() if file]
    for listed in manifest["sites"].values():
        rows += [_row("site", "", file) for file in listed]
    for run_id, run in manifest["runs"].items():
        rows += [_row("log", run_id, file) for file in run["log"]]
    return pl.DataFrame(rows, schema=_SCHEMA, orient="row").unique(maintain_order=True)


def some_of(sources: pl.DataFrame) -> pl.DataFrame:
    """The sources as they fit a screen: digests shortened, and not all logs of many."""
    logs = sources.filter(pl.col("kind") == "log")
    shown = pl.concat([sources.filter(pl.col("kind") != "log"), logs.head(_SHOWN)])
    if (more := logs.height - _SHOWN) > 0:
        rest = pl.DataFrame([("log", f"and {more} more", NAME, None, "")], schema=_SCHEMA, orient="row")
        shown = pl.concat([shown, rest])
    return shown.with_columns(pl.col("sha256").str.head(16))


def _row(kind: str, of: str, file: dict[str, Any]) -> tuple[str, str, str, int, str]:
    return kind, of, file["name"], file["bytes"], file["sha256"]
