"""Exact bounds on expectations and medians of simulated times (shares have theirs in `pipeline.figures.bounds`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import binom

from pipeline.figures.bounds import CONFIDENCE
from schemas.arrays import Floats


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
    n = values.size
    if n < 2:
        return None
    mean, variance = float(values.mean()), float(values.var(ddof=1))
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


def time_columns(name: str, times_s: Floats, least: float, greatest: float) -> dict[str, object]:
    """`name_s` and its errors and bounds `name_low_s`, ...; nulls without values."""
    found = expected(times_s, least, greatest)
    figures = found or (None,) * len(Expected._fields)
    suffixes = ("", *(f"_{field}" for field in Expected._fields[1:]))
    return {f"{name}{suffix}_s": figure for suffix, figure in zip(suffixes, figures, strict=True)}
