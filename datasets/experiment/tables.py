"""Results of an experiment: shares with their bounds, tables, and all of it on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import polars as pl
from polars import selectors as cs

from pipeline import storage
from pipeline.figures.bounds import clopper_pearson
from pipeline.storage.parquet import parquet_bytes

# By name: tables, and pages and pictures under their whole name.
Contents = Mapping[str, pl.DataFrame | str | bytes]
Row = dict[str, object]


def share(name: str, count: int, trials: int) -> Row:
    """`name`, `name_low` and `name_high`: a share and its exact bounds, null without trials."""
    found = clopper_pearson(count, trials)
    return {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}


def table(rows: list[Row]) -> pl.DataFrame:
    """The rows as a table; a column of which no row knows anything is one of numbers."""
    return pl.DataFrame(rows, infer_schema_length=None).with_columns(cs.by_dtype(pl.Null).cast(pl.Float64))


def write(out: Path, contents: Contents, settings: Mapping[str, object]) -> list[Path]:
    """Every content and `settings.json`, which made them; the same content gives the same bytes."""
    files = {**contents, "settings.json": json.dumps(dict(settings), indent=2, sort_keys=True) + "\n"}
    for name, content in files.items():
        if isinstance(content, pl.DataFrame):
            content = parquet_bytes(content)
        storage.write_bytes(_path(out, name), content.encode() if isinstance(content, str) else content)
    return [_path(out, name) for name in files]


def _path(out: Path, name: str) -> Path:
    return out / (name if "." in name else f"{name}.parquet")
