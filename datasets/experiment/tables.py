"""Results of an experiment: shares and times with exact bounds, tables, and all of it on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

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
_TIME_PARTS = ("", "_standard_error", "_low", "_high", "_median", "_median_low", "_median_high")


def share_columns(name: str, count: int, trials: int) -> Row:
    """`name`, `name_low` and `name_high`: a share and its exact bounds, null without trials."""
    return columns_of(name, clopper_pearson(count, trials))


def time_columns(name: str, times_s: Floats, least: float, greatest: float) -> Row:
    """Mean and median of independent times known to lie within [least, greatest], as columns; nulls of fewer than two.

    `name_s`, its standard error, and bounds that hold for any distribution on that range. Mean: empirical Bernstein
    bound, two-sided (Maurer and Pontil 2009, theorem 4), finite-sample. Median: order statistics, binomial coverage.
    """
    from scipy.stats import binom  # takes half a second to load

    columns = [f"{name}{part}_s" for part in _TIME_PARTS]
    n = times_s.size
    if n < 2:
        return dict.fromkeys(columns)
    mean = float(times_s.mean())
    variance = float(times_s.var(ddof=1))
    log = float(np.log(4.0 / (1.0 - CONFIDENCE)))
    half = np.sqrt(2.0 * variance * log / n) + 7.0 * (greatest - least) * log / (3.0 * (n - 1))
    ordered = np.sort(times_s)
    below = int(binom.ppf((1.0 - CONFIDENCE) / 2.0, n, 0.5))
    of_mean = (mean, float(np.sqrt(variance / n)), max(least, mean - float(half)), min(greatest, mean + float(half)))
    of_median = (float(np.median(times_s)), float(ordered[max(below - 1, 0)]), float(ordered[min(n - below, n - 1)]))
    return dict(zip(columns, of_mean + of_median, strict=True))


def table_of_rows(rows: list[Row]) -> pl.DataFrame:
    """The rows as a table; a column of which no row knows anything is one of numbers."""
    return pl.DataFrame(rows, infer_schema_length=None).with_columns(cs.by_dtype(pl.Null).cast(pl.Float64))


def write_contents(out: Path, contents: Contents, settings: Mapping[str, object]) -> list[Path]:
    """Every content and `settings.json`, which made them; the same content gives the same bytes."""
    made = json.dumps(dict(settings), indent=2, sort_keys=True) + "\n"
    files = {**contents, "settings.json": made}
    for name, content in files.items():
        if isinstance(content, pl.DataFrame):
            content = noted_bytes(content, {"table": name, "software": SOFTWARE, "settings": made})
        storage.write_bytes(_file_of(out, name), content.encode() if isinstance(content, str) else content)
    return [_file_of(out, name) for name in files]


def _file_of(out: Path, name: str) -> Path:
    """The file of a content; a table is Parquet."""
    return out / (name if "." in name else f"{name}.parquet")
