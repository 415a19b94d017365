"""What the noise measured in a run adds to the thresholds of the raw monitors (DOMAIN section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from pipeline.stages.epochs.clock import nominal_period_s
from schemas.arrays import floats, times_ns
from schemas.config import Configuration
from schemas.tables import AXES


def widened_by_noise(
    epochs: pl.DataFrame, run: Mapping[str, Any], config: Configuration
) -> dict[str, tuple[float, float]]:
    """Per axis: last raw threshold over that of the model alone, and the white noise [m]; axes without noise left out.

    M at one epoch is 1.5 times the white noise squared, and adds 2 M / Δt² to the variance of the raw monitor.
    `epochs`: of one solution, in order of time; `run`: its columns `white_noise_*_m`.
    """
    widened: dict[str, tuple[float, float]] = {}
    if epochs.height < 2:
        return widened
    period_s = nominal_period_s(times_ns(epochs))
    for axis in AXES:
        thresholds = floats(epochs, f"{axis}_raw_threshold")
        thresholds = thresholds[np.isfinite(thresholds)]
        white_m = run.get(f"white_noise_{axis}_m")
        if not thresholds.size or not white_m:
            continue
        whole = float(thresholds[-1] / config.monitors.threshold_factor) ** 2
        model = whole - 3.0 * (white_m / period_s) ** 2
        if model > 0.0:
            widened[axis] = (float(np.sqrt(whole / model)), white_m)
    return widened
