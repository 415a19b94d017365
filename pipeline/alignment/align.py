"""Alignment: the odometer at each GNSS epoch's time of validity, scale and latency known or learned causally.

Adds to the matched epochs: `along_m, odometer_m, odometer_reason, odometer_stretch, speed_mps, direction,
odometer_scale, scale_sigma, latency_s, latency_sigma_s, stamp_jitter_s, odometer_white_m2_per_s, odometer_reading_m,
odometer_period_s`. A reason says why an epoch has no odometer.
"""

from __future__ import annotations

import numpy as np
import polars as pl

from pipeline.alignment.increments import EpochArrays, Learned, odometer_steps, reading_of, stamp_jitter_s
from pipeline.alignment.learning import learn
from pipeline.monitors.axis import calibrated
from pipeline.odometry.odometer import OdometerTrack, odometer_track, polarity
from pipeline.odometry.scatter import play_m, with_play
from schemas.arrays import Bools, Floats, floats
from schemas.config import Configuration, Vehicle

NO_ODOMETER = "no odometer"
BEYOND_SPAN = "outside the odometer's time span"
INTERRUPTED = "odometer interrupted or slipping"


def align(epochs: pl.DataFrame, odometer: pl.DataFrame | None, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """Matched epochs of one solution with the odometer's columns (see the module's head)."""
    if odometer is None:
        return _without_odometer(epochs, vehicle, config)
    sigma_mps = config.monitors.odometer_sigma_mps
    track = odometer_track(odometer, config.align.odometer_gap_s, sigma_mps)
    t_s = track.seconds(epochs["t"].dt.timestamp("ns").to_numpy())
    path_m = floats(epochs, "path_m")
    matched = epochs["fix_valid"].to_numpy() & epochs["on_track"].to_numpy() & np.isfinite(path_m)
    sign = polarity(track, t_s, np.where(matched, path_m, np.nan), config.matching.orientation_distance_m)
    track = track.oriented(sign)
    along_m = unrolled(epochs, matched)
    sigma_m = calibrated(floats(epochs, "sigma_along_m"), config.monitors)
    digits_m = floats(epochs, "digits_along_m")
    arrays = EpochArrays(t_s, along_m, np.hypot(sigma_m, digits_m), matched, stamp_jitter_s(t_s), digits_m)
    learned = learn(arrays, track, vehicle, config)
    return epochs.with_columns(
        *_columns(arrays, track, learned, config), pl.Series("along_m", along_m, nan_to_null=True)
    )


def unrolled(epochs: pl.DataFrame, matched: Bools) -> Floats:
    """Path position with the way taken out that a curve adds to a position beside the track [m]; NaN elsewhere.

    A point y left of a track that turns left by its curvature k moves dx / (1 - k y) along it while the train moves
    dx, whether y is an error of the position or of the survey. Both are known, so this is no noise of the monitor.
    """
    along = np.full(matched.size, np.nan)
    rows = np.flatnonzero(matched)
    path_m = floats(epochs, "path_m")[rows]
    beside = np.nan_to_num(floats(epochs, "curvature_per_m")[rows] * floats(epochs, "cross_track_m")[rows])
    along[rows] = path_m - np.cumsum(beside * np.diff(path_m, prepend=path_m[:1]))
    return along


def odometer_at(times: pl.Series, aligned: pl.DataFrame, odometer: pl.DataFrame, config: Configuration) -> pl.Series:
    """Odometer distance at any times [m], on the scale of `aligned`'s `odometer_m`; null beyond what is known.

    Carried on from the nearest epoch before (or the first one) with the scale in use there.
    """
    anchors = aligned.drop_nulls("odometer_m")
    if anchors.is_empty():
        return pl.Series("odometer_m", [None] * times.len(), dtype=pl.Float64)
    track = odometer_track(odometer, config.align.odometer_gap_s, config.monitors.odometer_sigma_mps)
    anchor_s = track.seconds(anchors["t"].dt.timestamp("ns").to_numpy()) - floats(anchors, "latency_s")
    travelled = floats(anchors, "odometer_m")
    forward = np.sum(np.diff(travelled) * np.diff(track.distance_at(anchor_s)))
    track = track.oriented(-1 if forward < 0 else 1)
    at_s = track.seconds(times.dt.timestamp("ns").to_numpy())
    near = (np.searchsorted(anchor_s, at_s, side="right") - 1).clip(0)
    way = track.distance_at(at_s) - track.distance_at(anchor_s[near])
    known = track.known_at(at_s) & (track.stretch_at(at_s) == track.stretch_at(anchor_s[near]))
    distance = np.where(known, travelled[near] + floats(anchors, "odometer_scale")[near] * way, np.nan)
    return pl.Series("odometer_m", distance, nan_to_null=True)


def _columns(arrays: EpochArrays, track: OdometerTrack, learned: Learned, config: Configuration) -> list[pl.Series]:
    at = arrays.t_s - learned.latency_s
    known = track.known_at(at)
    inside = (at >= track.t_s[0]) & (at <= track.t_s[-1])
    reason = (
        pl.when(pl.Series(known))
        .then(None)
        .when(pl.Series(inside))
        .then(pl.lit(INTERRUPTED))
        .otherwise(pl.lit(BEYOND_SPAN))
    )
    steps = odometer_steps(np.flatnonzero(known), arrays.t_s, track, learned)
    step = np.full(known.size, np.nan)
    step[known] = steps.distance_m
    speed = np.where(known, learned.scale * track.speed_at(at), np.nan)
    reading = reading_of(track, at, config)
    total = np.where(known, np.cumsum(np.nan_to_num(step)), np.nan)
    turning = speed if reading is None else speed_of_positions(at, with_play(total, play_m(reading.sigma_m)))
    return [
        pl.Series("odometer_m", total, nan_to_null=True),
        pl.select(reason.alias("odometer_reason")).to_series(),
        pl.Series("odometer_stretch", track.stretch_at(at)),
        pl.Series("stamp_jitter_s", np.full(known.size, arrays.jitter_s)),
        pl.Series("odometer_white_m2_per_s", np.full(known.size, track.white_rate_m2_per_s)),
        pl.Series("odometer_reading_m", np.zeros(known.size) if reading is None else reading.sigma_m),
        pl.Series("odometer_period_s", np.full(known.size, track.period_s)),
        pl.Series("speed_mps", speed, nan_to_null=True),
        pl.Series("direction", _direction(turning, config.matching.deadband_mps)),
        pl.Series("odometer_scale", learned.scale),
        pl.Series("scale_sigma", learned.scale_sigma),
        pl.Series("latency_s", learned.latency_s),
        pl.Series("latency_sigma_s", learned.latency_sigma_s),
    ]


def _direction(speed_mps: Floats, deadband_mps: float) -> pl.Series:
    """+1 or -1 along growing path, held inside the dead band and where the speed is not known."""
    moving = np.where(np.abs(np.nan_to_num(speed_mps)) > deadband_mps, np.sign(np.nan_to_num(speed_mps)), 0.0)
    signs = pl.Series(moving).replace(0.0, None).forward_fill().backward_fill().fill_null(1.0)
    return signs.cast(pl.Int8)


def _without_odometer(epochs: pl.DataFrame, vehicle: Vehicle, config: Configuration) -> pl.DataFrame:
    """No odometer: speed and direction from GNSS (velocity, else positions over the second before)."""
    nothing = pl.lit(None, pl.Float64)
    t_s = epochs["t"].dt.timestamp("ns").to_numpy() * 1e-9
    t_s = t_s - t_s[0]
    valid = epochs["fix_valid"].to_numpy() & epochs["on_track"].to_numpy()
    by_position = speed_of_positions(t_s, np.where(valid, floats(epochs, "path_m"), np.nan))
    by_doppler = floats(epochs, "velocity_along_mps")
    speed = np.where(np.isfinite(by_doppler), by_doppler, by_position)
    latency = vehicle.gnss_latency_s
    return epochs.with_columns(
        along_m=nothing,
        odometer_m=nothing,
        odometer_reason=pl.lit(NO_ODOMETER),
        odometer_stretch=pl.lit(0, pl.Int64),
        stamp_jitter_s=nothing,
        odometer_white_m2_per_s=nothing,
        odometer_reading_m=nothing,
        odometer_period_s=nothing,
        speed_mps=pl.Series(speed, nan_to_null=True),
        direction=_direction(speed, config.matching.deadband_mps),
        odometer_scale=nothing,
        scale_sigma=nothing,
        latency_s=pl.lit(latency, pl.Float64),
        latency_sigma_s=pl.lit(None if latency is None else vehicle.gnss_latency_sigma_s or 0.0, pl.Float64),
    )


def speed_of_positions(t_s: Floats, path_m: Floats, window_s: float = 1.0) -> Floats:
    """Speed [m/s] from positions at least `window_s` apart, causal; NaN where there are none."""
    speed = np.full(t_s.size, np.nan)
    valid = np.flatnonzero(np.isfinite(path_m))
    if valid.size < 2:
        return speed
    t, x = t_s[valid], path_m[valid]
    before = np.searchsorted(t, t - window_s, side="right") - 1
    before = np.maximum(before, 0)
    span = t - t[before]
    with np.errstate(invalid="ignore", divide="ignore"):
        speed[valid] = np.where(span > 0, (x - x[before]) / span, np.nan)
    return speed
