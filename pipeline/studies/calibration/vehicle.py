"""Odometer scale and GNSS latency of a vehicle, with their uncertainty, from runs known to be fault-free.

Unlike the causal filter of a replay this looks at whole runs, which is right only because they are not the runs to be
diagnosed.
"""

from __future__ import annotations

import numpy as np

from pipeline.stages.evidence.carrying import SignedOdometer
from pipeline.stages.odometry import Odometry
from pipeline.stages.odometry.scale_lag import scale_and_lag, spans_of_rows
from schemas.arrays import Floats
from schemas.frozen import frozen


@frozen
class RunEstimate:
    """One run's scale and latency [s], by so many movements of 10 s; no latency where it is not measured."""

    scale: float
    scale_sigma: float
    latency_s: float | None
    latency_sigma_s: float | None
    points: int


def estimate_run(t_s: Floats, path_m: Floats, odometry: Odometry) -> RunEstimate | None:
    """Scale and latency of one run, by movements of 10 s.

    Args:
        t_s: times of usable epochs on the odometer's scale [s], shape (n,).
        path_m: path positions [m], shape (n,).
        odometry: the odometer, growing with the path.

    Returns:
        Scale and latency; None where too little can be compared.
    """
    begin, end = spans_of_rows(t_s)
    found = scale_and_lag(t_s[begin], t_s[end], path_m[end] - path_m[begin], SignedOdometer(odometry).counter_rows)
    if not np.isfinite(found.scale_sigma):
        return None
    return RunEstimate(
        scale=found.scale,
        scale_sigma=found.scale_sigma,
        latency_s=found.lag_s if found.measured else None,
        latency_sigma_s=found.lag_sigma_s if found.measured else None,
        points=begin.size,
    )


@frozen
class PooledFigure:
    """Of the next run of the vehicle."""

    value: float
    sigma: float


def pool_runs(values: Floats, sigmas: Floats) -> PooledFigure:
    """Runs together; the sigma includes their scatter: wheels wear and sensors drift.

    Args:
        values: one figure per run, shape (n,).
        sigmas: their standard deviations, shape (n,).

    Returns:
        The figure that the next run may have, with its standard deviation.

    Source:
        DerSimonian and Laird 1986.
    """
    weight = 1.0 / sigmas**2
    mean = float(weight @ values / weight.sum())
    scatter = float(weight @ (values - mean) ** 2)
    spare = weight.sum() - float(weight @ weight) / weight.sum()
    between = max(0.0, (scatter - (values.size - 1)) / spare) if values.size > 1 else 0.0
    weight = 1.0 / (sigmas**2 + between)
    mean = float(weight @ values / weight.sum())
    return PooledFigure(mean, float(np.sqrt(1.0 / weight.sum() + between)))
