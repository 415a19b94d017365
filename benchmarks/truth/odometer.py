"""Leaps of a counter: none found on healthy ones, and none that its bound does not cover; random drives with truth.

`python -m benchmarks.truth.odometer [DRIVES]`
"""

from __future__ import annotations

import sys
import time

import numpy as np
import polars as pl

from pipeline.stages.odometry import Odometry, odometry_of
from pipeline.stages.odometry.bound import odd_runs
from schemas.arrays import Bools, Floats
from schemas.config import AlignConfig, Configuration, Vehicle
from tests.stages.odometry.drives import drive, recorded

RATES_HZ = (1, 2, 5, 10, 20)
COUNTS_M = (0.02, 0.1, 0.5, 1.0, 2.0, 5.0)
NOISE_M = (0.1, 0.5, 1.0, 2.0)
HEALTHY = (*(("counts", size) for size in COUNTS_M), *(("noise", size) for size in NOISE_M), ("jitter", 0.03))
# Sizes of what the counter is set by [m]: anywhere, and less than the tolerance of a leap.
RESETS = {"any": (-400.0, 400.0), "small": (0.5, 4.9)}
DURATION_S = 600.0


def false_leaps(drives: int) -> None:
    config = AlignConfig()
    for rate_hz in RATES_HZ:
        for kind, size in (*HEALTHY, ("bunched", 0.5)):
            odd = near = 0
            for seed in range(drives):
                t_s, reads_m, _ = recorded(np.random.default_rng([seed, rate_hz, int(100 * size)]), kind, size, rate_hz)
                found = odd_runs(t_s, reads_m, size if kind == "counts" else 0.0, config)
                odd += len(found.odd)
                near += len(found.near)
            if odd or near:
                print(f"{rate_hz:3d} Hz {kind} {size}: {odd} odd, {near} nearly odd runs in {drives} drives")


def beyond_bound(drives: int) -> None:
    """The largest error of a way beyond its bound, over ways between all pairs of 60 instants [m]."""
    for rate_hz in RATES_HZ:
        for name, (least_m, most_m) in RESETS.items():
            beyond_m, lost, ways = [], 0, 0
            for seed in range(drives):
                off_m, known = _ways(np.random.default_rng([seed, rate_hz, 7]), rate_hz, least_m, most_m)
                beyond_m.append(float(off_m[known].max(initial=0.0)))
                lost += int((~known).sum())
                ways += known.size
            worst = ", ".join(f"{value:.1f}" for value in sorted(beyond_m)[-3:])
            print(f"{rate_hz:3d} Hz resets {name}: beyond the bound {worst} m; {100 * lost / ways:.0f} % lost")


def _ways(rng: np.random.Generator, rate_hz: int, least_m: float, most_m: float) -> tuple[Floats, Bools]:
    fine_s, travelled_m = drive(rng, DURATION_S)
    t_s = np.arange(0.0, DURATION_S - 1.0, 1.0 / rate_hz)
    true_m = np.interp(t_s, fine_s, travelled_m)
    rows = rng.choice(np.arange(20, t_s.size - 20), 8, replace=False)
    sets_m = sum(rng.uniform(least_m, most_m) * (np.arange(t_s.size) >= row) for row in rows)
    odometry = counted(t_s, true_m + sets_m)
    at = np.sort(rng.choice(t_s.size, 60, replace=False))
    begin, end = (ends.ravel() for ends in np.triu_indices(at.size, 1))
    at_ns = odometry.epoch_ns + np.round(t_s[at] * 1e9).astype(np.int64)
    way = odometry.distance_and_variance(at_ns[begin], at_ns[end])
    error_m = np.abs(way.distance_m - (true_m[at[end]] - true_m[at[begin]]))
    known = np.isfinite(way.distance_m) & (way.bound_m < 5e5)
    return np.maximum(error_m - way.bound_m, 0.0), known


def counted(t_s: Floats, distance_m: Floats) -> Odometry:
    """The odometer of these rows, a wheel."""
    rows = pl.DataFrame({"t": np.round(1e9 * t_s).astype(np.int64), "distance_m": distance_m, "origin": "wheel"})
    stream = rows.with_columns(
        pl.col("t").cast(pl.Datetime("ns", "UTC")),
        speed_mps=pl.lit(None, pl.Float64),
        sigma_speed_mps=pl.lit(None, pl.Float64),
        slip=pl.lit(None, pl.Boolean),
    )
    odometry = odometry_of(stream, Vehicle(), Configuration())
    assert odometry is not None
    return odometry


def cost() -> None:
    t_s = np.arange(0.0, 3600.0, 0.1)
    rows_m = np.floor(20.0 * t_s / 0.5) * 0.5
    begin_s = time.perf_counter()
    counted(t_s, rows_m)
    print(f"an hour at 10 Hz: {1e3 * (time.perf_counter() - begin_s):.0f} ms")


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    cost()
    false_leaps(count)
    beyond_bound(count)
