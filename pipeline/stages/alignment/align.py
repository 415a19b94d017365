"""Alignment: the odometer at each epoch's time of validity, and what a test along the track has to allow for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from pipeline.stages.alignment.learning import Hold, learn
from pipeline.stages.alignment.odometer_filter import Estimates, stamp_jitter_s
from pipeline.stages.epochs.clock import periods_before_s
from pipeline.stages.epochs.verdicts import NO_ODOMETER, first_reason
from pipeline.stages.monitors.noise import NoiseMeter
from pipeline.stages.monitors.series import along_axis
from pipeline.stages.odometry.driven import with_hysteresis
from pipeline.stages.odometry.odometry import Odometry
from schemas.arrays import Bools, Floats, Ints, flags, floats, times_ns
from schemas.config import Configuration, LdsConfig, MonitorConfig, Vehicle
from schemas.enums import NotEvaluated

BEYOND_SPAN = NotEvaluated.BEYOND_SPAN
_OF_ODOMETER = (
    *("along_m", "odometer_m", "travelled_m", "stamp_jitter_s", "odometer_white_m2_per_s", "odometer_rows_m"),
    *("odometer_period_s", "odometer_scale", "scale_sigma"),
)


def align(positions: pl.DataFrame, odometry: Odometry | None, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """Positions of one solution with the odometer beside them: `schemas.stages.Aligned`."""
    positions = positions.with_columns(pl.col(r"^digits_(along|cross|up)_m$").clip(upper_bound=config.scatter_limit_m))
    positions = positions.with_columns(*_sigmas(config.monitors), _confidence(config.lds))
    if odometry is None:
        return _without_odometer(positions, vehicle, config)
    # A position that has jumped aside is still compared: that is how the monitors see the jump.
    along_m = unrolled(positions, flags(positions, "near_track"))
    positions = positions.with_columns(pl.Series("along_m", along_m, nan_to_null=True))
    t_ns = times_ns(positions)
    jitter_s = stamp_jitter_s(odometry.seconds(t_ns), periods_before_s(t_ns), config.align.clock_periods)
    in_use, holds = learn(positions, flags(positions, "on_track"), jitter_s, odometry, vehicle, config)
    aligned = positions.with_columns(_columns(t_ns, jitter_s, odometry, in_use, config))
    if not odometry.independent or config.lds.ci_source != "sigma":
        return aligned
    excess_m2 = stated_excess_m2(aligned, holds, config)
    widened = (pl.col("sigma_along_m") ** 2 + pl.Series(excess_m2)).sqrt()
    return aligned.with_columns(confidence_m=config.lds.ci_factor * widened)


def stated_excess_m2(aligned: pl.DataFrame, holds: Sequence[Hold], config: Configuration) -> Floats:
    """By how much the variance along the track is larger than stated, as epochs before each show it (DOMAIN section 3).

    Measured in every run, whatever noise is given for the thresholds; nothing of a hold enters.
    """
    axis = along_axis(aligned, config)
    meter = NoiseMeter(axis.series, axis.moving, None, config)
    for alarm, back in holds:
        meter.freeze(int(np.searchsorted(axis.series.epoch, alarm)))
        if back < aligned.height:
            meter.restart(int(np.searchsorted(axis.series.epoch, back)))
    known = np.searchsorted(axis.series.epoch, np.arange(aligned.height), side="right") - 1
    if not axis.series.epoch.size:
        return np.zeros(aligned.height)
    return np.asarray(np.where(known < 0, 0.0, meter.stated_excess_m2()[known]))


def _sigmas(config: MonitorConfig) -> list[pl.Expr]:
    """Sigmas that every test counts with: a + b sigma as `calibrate` fitted it, and the digits."""
    calibrated = {
        f"calibrated_{axis}_m": config.sigma_intercept_m + config.sigma_slope * pl.col(f"sigma_{axis}_m")
        for axis in ("along", "cross", "up")
    }
    with_digits = (calibrated["calibrated_along_m"] ** 2 + pl.col("digits_along_m") ** 2).sqrt()
    return [with_digits.alias("position_sigma_m"), *(value.alias(name) for name, value in calibrated.items())]


def _confidence(lds: LdsConfig) -> pl.Expr:
    """K sigma along the track, as stated, or the receiver's HPL (DOMAIN section 4)."""
    half_width = lds.ci_factor * pl.col("sigma_along_m") if lds.ci_source == "sigma" else pl.col("hpl_m")
    return half_width.alias("confidence_m")


def unrolled(epochs: pl.DataFrame, near: Bools) -> Floats:
    """Path position less what a curve adds to the way of a position beside the track [m]; NaN off the track.

    A point y to the left of a track with left curvature k moves dx / (1 - k y) along it while the train moves dx.
    """
    along = np.full(near.size, np.nan)
    rows = np.flatnonzero(near)
    path_m = floats(epochs, "path_m")[rows]
    beside = np.nan_to_num(floats(epochs, "curvature_per_m")[rows] * floats(epochs, "cross_track_m")[rows])
    along[rows] = path_m - np.cumsum(beside * np.diff(path_m, prepend=path_m[:1]))
    return along


def odometer_at(times: pl.Series, aligned: pl.DataFrame, odometry: Odometry) -> pl.Series:
    """Odometer distance at any times [m], on the scale of `aligned`'s `odometer_m`; null beyond what is known.

    Carried on from the nearest epoch before (or the first one) with the scale in use there.
    """
    anchors = aligned.drop_nulls("odometer_m")
    if anchors.is_empty():
        return pl.Series("odometer_m", [None] * times.len(), dtype=pl.Float64)
    anchor_s = odometry.seconds(times_ns(anchors)) - floats(anchors, "latency_s")
    at_s = odometry.seconds(times.dt.timestamp("ns").to_numpy())
    near = (np.searchsorted(anchor_s, at_s, side="right") - 1).clip(0)
    way = odometry.distance_at_s(at_s) - odometry.distance_at_s(anchor_s[near])
    whole = odometry.doubt_at_s(at_s) == odometry.doubt_at_s(anchor_s[near])
    distance = floats(anchors, "odometer_m")[near] + floats(anchors, "odometer_scale")[near] * way
    known = np.where(odometry.known_at_s(at_s) & whole, distance, np.nan)
    return pl.Series("odometer_m", known, nan_to_null=True)


def _columns(
    t_ns: Ints, jitter_s: Floats, odometry: Odometry, in_use: Estimates, config: Configuration
) -> list[pl.Series]:
    """Each read at the epoch less the latency in use there."""
    at = odometry.seconds(t_ns) - in_use.latency_s
    known = odometry.known_at_s(at)
    rows = np.flatnonzero(known)
    step, driven = np.zeros((2, known.size))
    step[rows] = odometry.increments(t_ns[rows], in_use.scale[rows], in_use.latency_s[rows]).distance_m
    driven[rows] = odometry.driven(t_ns[rows], in_use.scale[rows], in_use.latency_s[rows])
    total, travelled = (np.where(known, np.cumsum(steps), np.nan) for steps in (step, driven))
    speed = np.where(known, in_use.scale * odometry.speed_at_s(at), np.nan)
    noise = odometry.noise_at_s(at)
    rows_m = np.minimum(odometry.known_row_sigma_m(at), config.scatter_limit_m)
    width_m = odometry.hysteresis_m(at)
    held = with_hysteresis(total, width_m)
    turning = np.where(width_m > 0.0, speed_of_positions(at, held, config.align.speed_window_s), speed)
    turning[at < odometry.t_s[0] + config.align.speed_window_s] = np.nan
    inside = (at >= odometry.t_s[0]) & (at <= odometry.t_s[-1])
    reason = first_reason(
        (~known & inside, NotEvaluated.INTERRUPTED), (~known, BEYOND_SPAN), (~noise.shown, NotEvaluated.NOISE_UNKNOWN)
    )
    return [
        pl.Series("odometer_m", total, nan_to_null=True),
        pl.Series("travelled_m", travelled, nan_to_null=True),
        reason.alias("odometer_reason"),
        pl.Series("odometer_doubt_m", odometry.doubt_at_s(at)),
        pl.Series("odometer_slips", odometry.slips_at_s(at) & inside),
        pl.Series("stamp_jitter_s", jitter_s),
        pl.Series("odometer_white_m2_per_s", odometry.white_m2_per_s_at(at)),
        pl.Series("odometer_rows_m", rows_m),
        pl.Series("odometer_period_s", noise.period_s),
        pl.Series("speed_mps", speed, nan_to_null=True),
        pl.Series("direction", _direction(turning, config.matching.deadband_mps)),
        pl.Series("odometer_scale", in_use.scale),
        pl.Series("scale_sigma", in_use.scale_sigma),
        pl.Series("latency_s", in_use.latency_s),
        pl.Series("latency_sigma_s", in_use.latency_sigma_s),
    ]


def _direction(speed_mps: Floats, deadband_mps: float) -> pl.Series:
    """+1 or -1 along growing path, held inside the dead band; the path grows the way that the run begins."""
    moving = np.where(np.abs(np.nan_to_num(speed_mps)) > deadband_mps, np.sign(np.nan_to_num(speed_mps)), 0.0)
    signs = pl.Series(moving).replace(0.0, None).forward_fill().fill_null(1.0)
    return signs.cast(pl.Int8)


def _without_odometer(positions: pl.DataFrame, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """Speed and direction from GNSS: velocity, else positions."""
    nothing = pl.lit(None, pl.Float64)
    t_s = times_ns(positions) * 1e-9
    path_m = np.where(flags(positions, "on_track"), floats(positions, "path_m"), np.nan)
    by_position = speed_of_positions(t_s - t_s[0], path_m, config.align.speed_window_s)
    by_doppler = floats(positions, "velocity_along_mps")
    speed = np.where(np.isfinite(by_doppler), by_doppler, by_position)
    latency = vehicle.gnss_latency_s
    return positions.with_columns(
        **dict.fromkeys(_OF_ODOMETER, nothing),
        odometer_reason=pl.lit(NO_ODOMETER),
        odometer_doubt_m=pl.lit(0.0),
        odometer_slips=pl.lit(value=False),
        speed_mps=pl.Series(speed, nan_to_null=True),
        direction=_direction(speed, config.matching.deadband_mps),
        latency_s=pl.lit(latency, pl.Float64),
        latency_sigma_s=pl.lit(None if latency is None else vehicle.gnss_latency_sigma_s or 0.0, pl.Float64),
    )


def speed_of_positions(t_s: Floats, path_m: Floats, window_s: float) -> Floats:
    """By positions at least `window_s` apart, causal [m/s]; NaN where there are none."""
    speed = np.full(t_s.size, np.nan)
    valid = np.flatnonzero(np.isfinite(path_m))
    if valid.size < 2:
        return speed
    at_s = t_s[valid]
    at_m = path_m[valid]
    before = np.maximum(np.searchsorted(at_s, at_s - window_s, side="right") - 1, 0)
    span_s = at_s - at_s[before]
    with np.errstate(invalid="ignore", divide="ignore"):
        speed[valid] = np.where(span_s > 0, (at_m - at_m[before]) / span_s, np.nan)
    return speed
