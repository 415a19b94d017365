"""Tables of an assessment as a person reads them: figures with bounds and source, and what a result was made from."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from typing import Any

import polars as pl

from pipeline import storage
from pipeline.results.manifest import NAME, read_manifest
from pipeline.stages.run_row.bounds import bounds_of
from pipeline.storage.address import Address, join
from pipeline.studies.safety.budget import published
from schemas.campaign import CampaignFigures


def figures_for_reading(figures: pl.DataFrame) -> dict[str, pl.DataFrame]:
    """Per solution: `figure, value, low, high, unit, source`; low and high are exact two-sided 95 % bounds."""
    return {str(row["solution"]): _figures(row) for row in figures.iter_rows(named=True)}


def _figures(row: Mapping[str, Any]) -> pl.DataFrame:
    bounds = bounds_of(row)
    beside = {"solution", *(name for name in row if re.search("_(low|high)(_|$)", name))}
    rows = [
        (name, value, *(row.get(bound) for bound in bounds.get(name, ("", ""))), *_told(name))
        for name, value in row.items()
        if name not in beside
    ]
    kinds = {"figure": pl.String, "value": pl.Float64, "low": pl.Float64, "high": pl.Float64}
    return pl.DataFrame(rows, schema={**kinds, "unit": pl.String, "source": pl.String}, orient="row", strict=False)


def _told(name: str) -> tuple[str, str]:
    """Unit, and paper or clause."""
    column = CampaignFigures.columns()[name]
    unit = str((column.metadata or {}).get("unit", "")) or "1"
    # By the beginning of the figure's name, the first that fits; docs/domain.md is DOMAIN.
    sources = published("figure_sources").iter_rows()
    return unit, next((source for start, source in sources if name.startswith(start)), "")


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


def some_of(sources: pl.DataFrame, most: int = 8) -> pl.DataFrame:
    """The sources as they fit a screen: digests shortened, and not all logs of many."""
    logs = sources.filter(pl.col("kind") == "log")
    shown = pl.concat([sources.filter(pl.col("kind") != "log"), logs.head(most)])
    if (more := logs.height - most) > 0:
        rest = pl.DataFrame([("log", f"and {more} more", NAME, None, "")], schema=_SCHEMA, orient="row")
        shown = pl.concat([shown, rest])
    return shown.with_columns(pl.col("sha256").str.head(16))


def _row(kind: str, of: str, file: dict[str, Any]) -> tuple[str, str, str, int, str]:
    return kind, of, file["name"], file["bytes"], file["sha256"]
