"""A run on a straight line as matched epochs and an odometer stream, with known errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from pipeline.stages.alignment.align import align
from pipeline.stages.odometry import odometry_of
from pipeline.stages.odometry.polarity import polarity
from schemas.arrays import floats, times_ns
from schemas.config import Configuration, Vehicle
from schemas.stages import MatchedEpochs
from tests.arrays_of_table import arrays_of_table
from tests.tables import WHEEL

SHARES = (0.083, 0.014, 0.150, 0.752)
TAUS_S = (360.0, 1800.0, 3600.0, 100.0)
# Positions without fast noise, and this is known: the bank looks on from the first epoch.
NO_NOISE = dict.fromkeys(("noise_along_m", "noise_cross_m", "noise_up_m"), (0.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Straight:
    """A train that starts at 10 s, reaches 40 m/s, slows down once and speeds up again.

    With `cruise_s` it is under way at 60 m/s when the recording begins, and brakes after that time.
    """

    duration_s: float = 720.0
    period_s: float = 0.1
    odometer_period_s: float = 0.05
    scale: float = 1.0
    latency_s: float = 0.0
    sigma_m: float = 1.0
    odometer_sigma_mps: float = 0.05
    polarity: int = 1
    cruise_s: float | None = None


def gauss_markov(rng, n, period_s, sigma_m):
    from scipy.signal import lfilter  # takes long to load

    error = np.zeros(n)
    for share, tau in zip(SHARES, TAUS_S, strict=True):
        phi = np.exp(-period_s / tau)
        noise = rng.standard_normal(n) * np.sqrt(share * (1 - phi**2))
        noise[0] = rng.standard_normal() * np.sqrt(share)
        error += sigma_m * lfilter([1.0], [1.0, -phi], noise)
    return error


def distance(t_s, cruise_s=None):
    fine = np.arange(0.0, t_s[-1] + 1.0, 0.01)
    speed = np.minimum(0.7 * np.maximum(fine - 10.0, 0.0), 40.0)
    speed -= 8.0 * np.clip((fine - 300.0) / 20.0, 0, 1) - 8.0 * np.clip((fine - 400.0) / 20.0, 0, 1)
    if cruise_s is not None:
        speed = np.maximum(60.0 - 0.8 * np.maximum(fine - cruise_s, 0.0), 5.0)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * 0.01)])
    return np.interp(t_s, fine, way)


def times(t_s):
    return pl.Series("t", np.round(t_s * 1e9).astype(np.int64)).cast(pl.Datetime("ns", "UTC"))


def run(plan: Straight, seed: int, fault=None):
    """Epochs and odometer; `fault(t_s)` is added to the GNSS position [m]."""
    rng = np.random.default_rng(seed)
    t_odometer = np.arange(0.0, plan.duration_s + 1.0, plan.odometer_period_s)
    walk = np.cumsum(rng.standard_normal(t_odometer.size)) * plan.odometer_sigma_mps * np.sqrt(plan.odometer_period_s)
    read = plan.polarity * (distance(t_odometer, plan.cruise_s) / plan.scale + walk)
    t_gnss = np.arange(1.0, plan.duration_s, plan.period_s)
    error = gauss_markov(rng, t_gnss.size, plan.period_s, plan.sigma_m)
    path_m = distance(t_gnss - plan.latency_s, plan.cruise_s) + error
    if fault is not None:
        path_m = path_m + fault(t_gnss)
    return epochs_of(t_gnss, path_m, plan.sigma_m), odometer_of(t_odometer, read)


def epochs_of(t_s, path_m, sigma_m=1.0, **columns):
    n = len(t_s)
    frame = pl.DataFrame(
        {
            "t": times(np.asarray(t_s)),
            "path_m": pl.Series(path_m, nan_to_null=True),
            "netelement_id": ["line"] * n,
            "cross_track_m": np.zeros(n),
            "vertical_m": pl.Series([None] * n, dtype=pl.Float64),
            "sigma_along_m": np.full(n, sigma_m),
            "sigma_cross_m": np.full(n, sigma_m),
            "sigma_up_m": np.full(n, 1.5 * sigma_m),
            "fix_valid": np.ones(n, dtype=bool),
            "on_track": np.ones(n, dtype=bool),
            "near_track": np.ones(n, dtype=bool),
            "survey_sigma_m": pl.Series([None] * n, dtype=pl.Float64),
            "interpolation_error_m": np.zeros(n),
            "curvature_per_m": np.zeros(n),
            "velocity_along_mps": pl.Series([None] * n, dtype=pl.Float64),
            **{f"digits_{axis}_m": np.zeros(n) for axis in ("along", "cross", "up")},
        }
    )
    return frame.with_columns(**{name: pl.Series(values) for name, values in columns.items()})


def odometer_of(t_s, distance_m=None, speed_mps=None, slip=None):
    nothing = [None] * len(t_s)
    return pl.DataFrame(
        {
            "t": times(np.asarray(t_s)),
            "distance_m": pl.Series(nothing if distance_m is None else distance_m, dtype=pl.Float64),
            "speed_mps": pl.Series(nothing if speed_mps is None else speed_mps, dtype=pl.Float64),
            "sigma_speed_mps": pl.Series(nothing, dtype=pl.Float64),
            "slip": pl.Series(nothing if slip is None else slip, dtype=pl.Boolean),
        }
    ).with_columns(WHEEL)


def odometry_from(odometer, vehicle=None, config=None):
    """The odometer of a stream, as recorded."""
    return odometry_of(odometer, vehicle or Vehicle(), config or Configuration())


def align_run(epochs, odometer, vehicle, config):
    """The epochs aligned with an odometer that the first metres turned to growing path."""
    return align_with(epochs, odometry_from(odometer, vehicle, config), vehicle, config)


def align_with(epochs, found, vehicle, config):
    """As `align_run`, with what is known of the odometer already."""
    if found is not None:
        placed = epochs["fix_valid"].to_numpy() & epochs["on_track"].to_numpy()
        path_m = np.where(placed, floats(epochs, "path_m"), np.nan)
        found = found.growing_along_path(
            polarity(found, times_ns(epochs), path_m, config.matching.orientation_distance_m)
        )
    return align(arrays_of_table(MatchedEpochs, epochs), found, vehicle, config).table
