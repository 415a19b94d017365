"""Results of an experiment: shares and times with exact bounds, tables, and all of it on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from polars import selectors as cs

from pipeline import storage
from pipeline.stages.run_row.bounds import CONFIDENCE, clopper_pearson, columns_of
from pipeline.storage.described import noted_bytes
from schemas.arrays import Floats
from schemas.version import SOFTWARE

# By name: tables, and pages and pictures under their whole name.
Contents = Mapping[str, pl.DataFrame | str | bytes]
Row = dict[str, object]


def share(name: str, count: int, trials: int) -> Row:
    """`name`, `name_low` and `name_high`: a share and its exact bounds, null without trials."""
    return columns_of(name, clopper_pearson(count, trials))


class Expected(NamedTuple):
    """Mean with its standard error and bounds that hold for any distribution on the known range."""

    mean: float
    standard_error: float
    low: float
    high: float
    median: float
    median_low: float
    median_high: float


def expected(values: Floats, least: float, greatest: float, confidence: float = CONFIDENCE) -> Expected | None:
    """Mean and median of independent values known to lie within [least, greatest]; none without values.

    Mean: empirical Bernstein bound, two-sided (Maurer and Pontil 2009, theorem 4), finite-sample.
    Median: order statistics with binomial coverage.
    """
    from scipy.stats import binom  # takes half a second to load

    n = values.size
    if n < 2:
        return None
    mean = float(values.mean())
    variance = float(values.var(ddof=1))
    log = float(np.log(4.0 / (1.0 - confidence)))
    half = np.sqrt(2.0 * variance * log / n) + 7.0 * (greatest - least) * log / (3.0 * (n - 1))
    ordered = np.sort(values)
    below = int(binom.ppf((1.0 - confidence) / 2.0, n, 0.5))
    return Expected(
        mean=mean,
        standard_error=float(np.sqrt(variance / n)),
        low=max(least, mean - float(half)),
        high=min(greatest, mean + float(half)),
        median=float(np.median(values)),
        median_low=float(ordered[max(below - 1, 0)]),
        median_high=float(ordered[min(n - below, n - 1)]),
    )


def time_columns(name: str, times_s: Floats, least: float, greatest: float) -> Row:
    """`name_s` and its errors and bounds `name_low_s`, ...; nulls without values."""
    found = expected(times_s, least, greatest)
    figures = found or (None,) * len(Expected._fields)
    suffixes = ("", *(f"_{field}" for field in Expected._fields[1:]))
    return {f"{name}{suffix}_s": figure for suffix, figure in zip(suffixes, figures, strict=True)}


def table(rows: list[Row]) -> pl.DataFrame:
    """The rows as a table; a column of which no row knows anything is one of numbers."""
    return pl.DataFrame(rows, infer_schema_length=None).with_columns(cs.by_dtype(pl.Null).cast(pl.Float64))


def write(out: Path, contents: Contents, settings: Mapping[str, object]) -> list[Path]:
    """Every content and `settings.json`, which made them; the same content gives the same bytes."""
    made = json.dumps(dict(settings), indent=2, sort_keys=True) + "\n"
    files = {**contents, "settings.json": made}
    for name, content in files.items():
        if isinstance(content, pl.DataFrame):
            content = noted_bytes(content, {"table": name, "software": SOFTWARE, "settings": made})
        storage.write_bytes(_path(out, name), content.encode() if isinstance(content, str) else content)
    return [_path(out, name) for name in files]


def _path(out: Path, name: str) -> Path:
    return out / (name if "." in name else f"{name}.parquet")
