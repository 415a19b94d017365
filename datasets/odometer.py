"""The odometer stream of a journey: scale error, white increments, slip and slide."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import polars as pl

from datasets.faults import NS_PER_S, FaultKind, FaultSpec, is_active, odometer_increments, odometer_speeds
from datasets.motion import Motion
from datasets.scenario import OdometerSpec
from schemas.arrays import Floats
from schemas.conform import conform
from schemas.enums import Origin
from schemas.inputs import Odometer


def odometer_stream(
    spec: OdometerSpec,
    motion: Motion,
    faults: Sequence[FaultSpec],
    first_ns: int,
    rng: np.random.Generator,
) -> pl.DataFrame:
    """Distance and speed at the odometer's own rate, over the whole journey.

    Increments have variance `noise_m_per_root_s`^2 times the step (DIAG section Error models, white
    reading); wheels that stand make no noise.
    """
    t_ns = sample_times_ns(motion.duration_s, spec.rate_hz)
    t_s = t_ns / NS_PER_S
    step_s = 1.0 / spec.rate_hz
    moving = motion.speed_mps(t_s) != 0.0
    increments = np.diff(motion.distance_m(t_s), prepend=0.0) / spec.scale
    noise = spec.noise_m_per_root_s * np.sqrt(step_s) * rng.standard_normal(t_s.size)
    noise[0] = 0.0
    increments = odometer_increments(faults, t_s, increments + np.where(moving, noise, 0.0))
    speed = _reported_speed_mps(spec, motion, faults, t_s, rng)
    lost = np.zeros(t_s.size, dtype=np.bool_)
    for fault in faults:
        if fault.hits_odometer and fault.kind is FaultKind.OUTAGE:
            lost |= is_active(fault, t_s)
    return _odometer_table(spec, first_ns + t_ns, np.cumsum(increments), speed).filter(pl.Series(~lost))


def sample_times_ns(duration_s: float, rate_hz: float) -> npt.NDArray[np.int64]:
    """Instants from 0 to the end of the journey at a fixed rate."""
    count = int(np.floor(duration_s * rate_hz + 1e-9)) + 1
    return np.round(np.arange(count) * (NS_PER_S / rate_hz)).astype(np.int64)


def _reported_speed_mps(
    spec: OdometerSpec, motion: Motion, faults: Sequence[FaultSpec], t_s: Floats, rng: np.random.Generator
) -> Floats:
    """Speed that the odometer reports [m/s]."""
    true = motion.speed_mps(t_s)
    noise = np.where(true != 0.0, spec.speed_sigma_mps * rng.standard_normal(t_s.size), 0.0)
    return odometer_speeds(faults, t_s, true / spec.scale) + noise


def _odometer_table(
    spec: OdometerSpec, t_ns: npt.NDArray[np.int64], distance_m: Floats, speed_mps: Floats
) -> pl.DataFrame:
    """The stream `odometer`, with what the sensor is said to give."""
    nothing = pl.lit(None, pl.Float64)
    table = pl.DataFrame({"t": t_ns}).with_columns(
        t=pl.col("t").cast(pl.Datetime("ns", "UTC")),
        sensor=pl.lit("primary"),
        distance_m=pl.Series(spec.polarity * distance_m) if spec.distance else nothing,
        speed_mps=pl.Series(spec.polarity * speed_mps) if spec.speed else nothing,
        sigma_speed_mps=pl.lit(spec.speed_sigma_mps) if spec.speed else nothing,
        slip=pl.lit(None, pl.Boolean),
        origin=pl.lit(spec.origin.value, pl.Enum(Origin)),
    )
    return conform(table, Odometer)
