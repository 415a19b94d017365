"""Epochs that have a position and a truth, as arrays in time order: the ground on which hazards are judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.epochs.timeline import linking_gap_s, nominal_period_s
from schemas.arrays import NS_PER_S, Bools, Floats, Ints, flags, floats, ints, times_ns
from schemas.config import LdsConfig


@dataclass(frozen=True)
class Series:
    """One row per usable epoch; `row` is its index in the epochs' frame.

    `error_m` is position by GNSS minus truth in the direction of travel; `excess_m` is GNSS minus true
    travel, whose steps are the jumps (oriented along growing path); `noise_m` is 3 sigma of position and
    truth together, `quiet_m` the larger of that and what the evidence cannot resolve; `slip_m` what the odometer
    counted too far between two reads around the epoch (`truth_slip_m`).
    """

    row: Ints
    t_ns: Ints
    path_m: Floats
    truth_m: Floats
    excess_m: Floats
    error_m: Floats
    noise_m: Floats
    bound_m: Floats
    slip_m: Floats
    direction: Floats
    leg: Ints
    linked: Bools
    period_s: float

    @property
    def quiet_m(self) -> Floats:
        return np.maximum(self.noise_m, self.bound_m)

    @property
    def size(self) -> int:
        return int(self.t_ns.size)


def series_of(epochs: pl.DataFrame, truth: pl.DataFrame, lds: LdsConfig) -> Series:
    """Usable epochs of one solution. `linked[i]`: the movement from epoch i-1 to i may be interpolated,
    that is, the gap is short (DOMAIN section 4) and the truth knows the movement over it.
    """
    t_ns = times_ns(epochs)
    period_s = nominal_period_s(t_ns) or 1.0
    path, place = floats(epochs, "path_m"), floats(truth, "truth_path_m")
    usable = flags(epochs, "fix_valid") & np.isfinite(path) & np.isfinite(place)
    row = np.flatnonzero(usable)
    direction = direction_of(epochs)[row]
    sigma = np.hypot(np.nan_to_num(floats(epochs, "sigma_along_m")[row]), floats(truth, "truth_sigma_m")[row])
    stretch = truth["truth_stretch"].to_numpy()[row]
    t, x, p = t_ns[row], path[row], place[row]
    linked = np.zeros(row.size, dtype=np.bool_)
    gap_ns = linking_gap_s(period_s, lds.crossing_gap_s) * NS_PER_S
    linked[1:] = (np.diff(t) <= gap_ns) & (np.diff(stretch) == 0)
    leg = ints(epochs["leg"])[row]
    return Series(
        row=row,
        t_ns=t,
        path_m=x,
        truth_m=p,
        excess_m=x - floats(truth, "truth_travel_m")[row],
        error_m=(x - p) * direction,
        noise_m=3.0 * sigma,
        bound_m=np.nan_to_num(floats(truth, "truth_bound_m")[row]),
        slip_m=np.nan_to_num(floats(truth, "truth_slip_m")[row]),
        direction=direction,
        leg=leg,
        linked=linked,
        period_s=period_s,
    )


def errors_of(epochs: pl.DataFrame, truth: pl.DataFrame) -> dict[str, Floats]:
    """Position by GNSS minus truth per axis [m]; along in the direction of travel, across left of
    growing path; NaN where either is missing.
    """
    along = (floats(epochs, "path_m") - floats(truth, "truth_path_m")) * direction_of(epochs)
    fixed = flags(epochs, "fix_valid")
    cross = floats(epochs, "cross_track_m") - floats(truth, "truth_cross_m")
    up = floats(epochs, "vertical_m") - floats(truth, "truth_up_m")
    return {
        "along": np.where(fixed, along, np.nan),
        "cross": np.where(fixed, cross, np.nan),
        "up": np.where(fixed, up, np.nan),
    }


def direction_of(epochs: pl.DataFrame) -> Floats:
    """Direction of travel per epoch, +1 or -1; held where it is not known, growing path where it never is."""
    series = epochs["direction"]
    if series.null_count() or (series == 0).any():
        series = series.replace(0, None).forward_fill().backward_fill().fill_null(1)
    return series.to_numpy().astype(np.float64)
