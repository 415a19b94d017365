"""Results of an experiment on disk: one Parquet per table and the settings that made them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import polars as pl

from pipeline.storage.parquet import parquet_bytes
from schemas.config import Configuration
from schemas.errors import OutputError, UsageError


def refuse_configuration(experiment: str, config: Configuration | None) -> None:
    """A published experiment has the paper's settings; silently ignoring others would mislead."""
    if config is not None:
        raise UsageError(
            "takes no configuration",
            place=f"experiment {experiment}",
            expected="the published settings",
            remedy="`rare`, `bank` and `catalogue` judge the bank of a configuration.",
        )


def write_tables(out: Path, tables: Mapping[str, pl.DataFrame], settings: Mapping[str, object]) -> list[Path]:
    """`NAME.parquet` for every table and `settings.json`; the same content gives the same bytes."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        written = []
        for name, frame in tables.items():
            path = out / f"{name}.parquet"
            path.write_bytes(parquet_bytes(frame))
            written.append(path)
        path = out / "settings.json"
        path.write_text(json.dumps(dict(settings), indent=2, sort_keys=True) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", place=str(out)) from None
    return [*written, path]


def write_page(path: Path, text: str) -> Path:
    """A page of text beside the tables."""
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot be written: {error.strerror}", place=str(path)) from None
    return path
