"""Did a run raise alarms that noise does not explain? Such a run calibrates no other."""

from __future__ import annotations

import polars as pl

from pipeline.studies.calibration.sigmas import overall_ratio
from schemas.enums import MonitorState
from schemas.tables import AXES, SCALES

_LINKING = ("link_order", "link_distance")


def beyond_noise(epochs: pl.DataFrame, factor: float) -> tuple[str, ...]:
    """Monitors of a run, replayed uncalibrated, that fail by more than its noise; `factor` is k_T.

    The raw monitor of an axis shows its noise; a drift hardly moves it, and of a step only one epoch in thousands is
    large. So every monitor of the axis is held against k_T times its sigma, widened by what the raw one measured over
    what was predicted. A monitor's own average would be widened by the fault that it sees. Linking knows no such noise.
    """
    found = []
    for axis in AXES:
        shown = _ratios(epochs, f"{axis}_raw")
        widened = max(1.0, overall_ratio((factor * shown).to_numpy())) if len(shown) else 1.0
        names = [f"{axis}_{scale}" for scale in SCALES]
        found += [name for name in names if (_ratios(epochs, name).abs() > widened).any()]
    return (*found, *(name for name in _LINKING if (epochs[f"{name}_state"] == MonitorState.FAIL.value).any()))


def _ratios(epochs: pl.DataFrame, monitor: str) -> pl.Series:
    """Value over threshold where the monitor was evaluated."""
    return (epochs[f"{monitor}_value"] / epochs[f"{monitor}_threshold"]).drop_nulls()
