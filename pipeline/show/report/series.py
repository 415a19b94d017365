"""What the time axes and the Stanford diagram of a run's page show, one solution at a time."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import polars as pl

from pipeline.show.report.decimate import WHOLE_SERIES, Band, detail_rows, kept_rows, state_band
from pipeline.show.report.markup import Json, pack_numbers
from pipeline.stages.epochs.clock import gap_limit_s, nominal_period_s
from schemas.arrays import Bools, Floats, Ints, floats
from schemas.enums import Judgement, LdsMode, LdsState, MonitorState
from schemas.monitors import ALL_MONITORS, DRAWINGS, MONITORS

SERIES = (
    "speed_mps",
    "error_along_m",
    "error_cross_m",
    "error_up_m",
    "cross_track_m",
    "vertical_m",
    "confidence_m",
    "exposure_s",
    "distance_from_lrvb_m",
    "path_m",
    "undetected_ahead_m",
    "undetected_behind_m",
)
NO_EPOCH = "no epoch"
UNKNOWN = "not known"
MONITOR_CODES = (NO_EPOCH, MonitorState.PASS.value, MonitorState.NOT_EVALUATED.value, MonitorState.FAIL.value)
_BINS = 56
MOMENTS = ("t_onset", "t_hazard", "t_failure", "t_detected", "t_negated", "t_end")


def time_data(epochs: pl.DataFrame, moments_ns: Ints, gap_reset_s: float) -> Json:
    """Series and bands over time; times are milliseconds from `t0_ms`. Across a gap lines are broken."""
    if epochs.is_empty():
        return {"t0_ms": 0, "t1_ms": 0, "t": None, "series": {}, "bands": [], "silent": {}}
    t_ns = epochs["t"].to_physical().to_numpy()
    t0_ms = int(t_ns[0] // 1_000_000)
    t_ms = t_ns // 1_000_000 - t0_ms
    limit_s = gap_limit_s(nominal_period_s(t_ns), gap_reset_s)
    hold_ms = max(1, int(limit_s * 1000))
    gaps = np.flatnonzero(np.diff(t_ms) > hold_ms) + 1
    shown_ms = np.insert(t_ms, gaps, t_ms[gaps - 1] + hold_ms)
    whole = detail_rows(shown_ms * 1_000_000, moments_ns - t0_ms * 1_000_000)
    columns = {name: floats(epochs, name) for name in SERIES} | _ratios(epochs)
    columns["residual_m"] = _odometer_residual_m(epochs)
    known = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    return {
        "t0_ms": t0_ms,
        "t1_ms": int(t_ns[-1] // 1_000_000),
        "t": pack_numbers(shown_ms, "u4") if len(shown_ms) <= WHOLE_SERIES else None,
        "series": {
            name: _thin_series(shown_ms, np.insert(values, gaps, np.nan), whole) for name, values in known.items()
        },
        "bands": [_band_data(*row, t_ms, hold_ms) for row in _state_series(epochs)],
        "silent": _never_evaluated(epochs, known),
    }


def _never_evaluated(epochs: pl.DataFrame, known: Collection[str]) -> dict[str, str]:
    """The most frequent reason for each drawing of monitors none of which was ever evaluated."""
    never = {}
    for drawing, lines in monitor_lines().items():
        reasons = [epochs[f"{name}_reason"].cast(pl.String).alias("reason") for name, _ in lines]
        counts = (
            pl.concat(reasons).drop_nulls().value_counts(sort=True).sort("count", "reason", descending=[True, False])
        )
        if counts.height and not any(f"ratio_{name}" in known for name, _ in lines):
            never[drawing] = counts["reason"][0]
    return never


def moments_of(*frames: pl.DataFrame) -> Ints:
    """Every instant that hazards and alarms name [ns]."""
    names = (*MOMENTS, "t_start")
    columns = [frame[name].drop_nulls() for frame in frames for name in names if name in frame.columns]
    parts = [column.to_physical().to_numpy() for column in columns]
    return np.concatenate(parts) if parts else np.array([], dtype=np.int64)


def monitor_lines() -> dict[str, list[list[str]]]:
    """Name and label of the lines of each drawing of monitors."""
    return {
        drawing: [[monitor.name, monitor.label] for monitor in ALL_MONITORS if monitor.drawing == drawing]
        for drawing in DRAWINGS
    }


def _ratios(epochs: pl.DataFrame) -> dict[str, Floats]:
    """Statistic of each monitor over its threshold, signed: beyond -1 and 1 it fails."""
    ratios = {}
    for monitor in MONITORS:
        value = floats(epochs, f"{monitor}_value")
        threshold = floats(epochs, f"{monitor}_threshold")
        evaluated = (epochs[f"{monitor}_state"] != MonitorState.NOT_EVALUATED).to_numpy() & (threshold > 0)
        ratios[f"ratio_{monitor}"] = np.divide(value, threshold, out=np.full(len(value), np.nan), where=evaluated)
    return ratios


def _odometer_residual_m(epochs: pl.DataFrame) -> Floats:
    """GNSS minus odometer along the path, from where both are first known [m]."""
    both = floats(epochs, "path_m") - floats(epochs, "odometer_m")
    known = np.flatnonzero(np.isfinite(both))
    return both - both[known[0]] if len(known) else both


def _thin_series(t_ms: Ints, values: Floats, whole: Bools) -> Json:
    """A series, thinned out if it is long."""
    if len(values) <= WHOLE_SERIES:
        return {"y": pack_numbers(values, "f4")}  # at every time in `t`
    rows = kept_rows(values, whole)
    return {"x": pack_numbers(t_ms[rows], "u4"), "y": pack_numbers(values[rows], "f4")}


def _state_series(epochs: pl.DataFrame) -> list[tuple[str, str, Sequence[str], Ints]]:
    """Name, group and states from harmless to bad, and the code of each epoch."""
    modes = (NO_EPOCH, LdsMode.LINKED, LdsMode.INITIALISING, LdsMode.ODOMETRY, LdsMode.FAIL_SAFE)
    states = (NO_EPOCH, LdsState.P0, UNKNOWN, LdsState.P3, LdsState.P2, LdsState.P1)
    judgements = (NO_EPOCH, Judgement.RIGHT, Judgement.UNKNOWN, Judgement.WRONG)
    rows: list[tuple[str, str, Sequence[str], Ints]] = [
        ("LDS mode", "lds", modes, _state_codes(epochs["lds_mode"], modes)),
        ("LDS state", "lds", states, _state_codes(epochs["lds_state"], states)),
        ("judgement", "lds", judgements, _state_codes(epochs["judgement"], judgements)),
        ("TVB", "lds", (NO_EPOCH, "TVB", "no TVB"), 2 - epochs["tvb"].cast(pl.Int64).to_numpy()),
        ("alarm", "lds", (NO_EPOCH, "no alarm", "alarm"), 1 + epochs["alarm"].cast(pl.Int64).to_numpy()),
    ]
    rows += [
        (name, "monitors", MONITOR_CODES, _state_codes(epochs[f"{name}_state"], MONITOR_CODES)) for name in MONITORS
    ]
    return rows


def _state_codes(states: pl.Series, order: Sequence[str]) -> Ints:
    """States as numbers."""
    names = [str(name) for name in order]
    codes = pl.Series(range(len(names)), dtype=pl.Int64)
    known = states.cast(pl.String).fill_null(UNKNOWN)
    return known.replace_strict(pl.Series(names), codes, return_dtype=pl.Int64).to_numpy()


def _band_data(name: str, group: str, states: Sequence[str], codes: Ints, t_ms: Ints, hold_ms: int) -> Json:
    """A band of states over time."""
    pieces: Band = state_band(t_ms, codes, hold_ms, gap_code=0)
    return {
        "name": name,
        "group": group,
        "states": [str(state) for state in states],
        "starts": pack_numbers(pieces.starts_ms, "u4"),
        "codes": pack_numbers(pieces.codes, "u1"),
        "end_ms": pieces.end_ms,
    }


def stanford_data(epochs: pl.DataFrame, limit_m: float) -> Json:
    """Counts of epochs of known error on a square grid up to twice the limit; the last bin holds all beyond it."""
    known = epochs.select(error=pl.col("error_along_m").abs(), bound=pl.col("confidence_m")).drop_nulls()
    width = 2.0 * limit_m / _BINS
    cells = (
        known.select(
            x=(pl.col("error") / width).floor().clip(0, _BINS - 1).cast(pl.Int64),
            y=(pl.col("bound") / width).floor().clip(0, _BINS - 1).cast(pl.Int64),
        )
        .group_by("x", "y")
        .len("count")
        .sort("x", "y")
    )
    counts = np.array(cells["count"].to_list(), dtype=np.int64)
    return {
        "width_m": width,
        "bins": _BINS,
        "limit_m": limit_m,
        "cells": [list(row) for row in cells.iter_rows()],
        "epochs": int(counts.sum()),
    }
