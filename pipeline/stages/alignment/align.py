"""Alignment: the odometer at each epoch's time of validity, and what a test along the track has to allow for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pipeline.stages.alignment.learning import Hold, ToLearn, learn
from pipeline.stages.alignment.odometer_filter import Estimates, stamp_jitter_s
from pipeline.stages.epochs.clock import periods_before_s
from pipeline.stages.epochs.verdicts import NO_ODOMETER, NUMBER, first_reason
from pipeline.stages.monitors.axes import Axis, along_axis
from pipeline.stages.odometry.driven import with_hysteresis
from pipeline.stages.odometry.odometry import Odometry
from schemas.arrays import Floats, Ints
from schemas.config import Configuration, Vehicle
from schemas.enums import NotEvaluated
from schemas.frozen import frozen
from schemas.stages import AlignedEpochs, MatchedEpochs

BEYOND_SPAN = NotEvaluated.BEYOND_SPAN


def align(
    positions: MatchedEpochs, odometry: Odometry | None, vehicle: Vehicle, config: Configuration
) -> AlignedEpochs:
    """The epochs of `alignment`, for whoever needs no more of it.

    Args:
        positions: matched epochs of one solution, arrays of shape (n,).
        odometry: the odometer, growing with the path of the positions; None without one.
        vehicle: scale and latency, as far as the file gives them.
        config: the configuration; used are `align`, `monitors`, `lds` and `matching`.

    Returns:
        The aligned epochs, arrays of shape (n,).

    Source:
        DOMAIN sections 3 and 4; DIAG eq. 1-3.
    """
    return alignment(positions, odometry, vehicle, config).epochs


class Alignment(NamedTuple):
    """Aligned epochs, and the axis along the track if it was made for their confidence interval."""

    epochs: AlignedEpochs
    along: Axis | None = None


def alignment(
    positions: MatchedEpochs, odometry: Odometry | None, vehicle: Vehicle, config: Configuration
) -> Alignment:
    """Positions of one solution with the odometer at each, and what a test along the track has to allow for.

    Args:
        positions: matched epochs of one solution, arrays of shape (n,).
        odometry: the odometer, growing with the path of the positions; None without one.
        vehicle: scale and latency, as far as the file gives them.
        config: the configuration; used are `align`, `monitors`, `lds` and `matching`.

    Returns:
        The aligned epochs, arrays of shape (n,), and what the bank may use again.

    Source:
        DOMAIN sections 3 and 4; DIAG eq. 1-3.
    """
    most_m = config.scatter_limit_m
    positions = replace(
        positions,
        digits_along_m=np.minimum(positions.digits_along_m, most_m),
        digits_cross_m=np.minimum(positions.digits_cross_m, most_m),
        digits_up_m=np.minimum(positions.digits_up_m, most_m),
    )
    allowed = _allowed(positions, config)
    if odometry is None:
        return Alignment(_without_odometer(positions, allowed, vehicle, config))
    # A position that has jumped aside is still compared: that is how the monitors see the jump.
    along_m = curve_corrected_path_m(positions)
    jitter_s = stamp_jitter_s(
        odometry.seconds(positions.t_ns), periods_before_s(positions.t_ns), config.align.clock_periods
    )
    to_learn = ToLearn(positions.t_ns, positions.on_track, along_m, allowed.along_m, positions.digits_along_m, jitter_s)
    in_use, holds = learn(to_learn, odometry, vehicle, config)
    aligned = _with_odometer(positions, allowed, along_m, jitter_s, odometry, in_use, config)
    if not odometry.independent or config.lds.ci_source != "sigma":
        return Alignment(aligned)
    along = along_axis(aligned, config)
    widened_m = np.sqrt(aligned.sigma_along_m**2 + stated_excess_m2(along, holds, aligned.height))
    return Alignment(replace(aligned, confidence_m=config.lds.ci_factor * widened_m), along)


def stated_excess_m2(axis: Axis, holds: Sequence[Hold], epochs: int) -> Floats:
    """Variance along the track beyond the stated one, as epochs before each show it (DOMAIN section 3).

    Measured in every run, whatever noise is given for the thresholds; nothing of a hold enters.
    """
    meter = axis.noise_meter(None)
    for alarm, back in holds:
        meter.freeze(int(np.searchsorted(axis.series.epoch, alarm)))
        if back < epochs:
            meter.restart(int(np.searchsorted(axis.series.epoch, back)))
    known = np.searchsorted(axis.series.epoch, np.arange(epochs), side="right") - 1
    if not axis.series.epoch.size:
        return np.zeros(epochs)
    return np.asarray(np.where(known < 0, 0.0, meter.stated_excess_m2()[known]))


@frozen
class _Allowed:
    """What every test allows for the position at each epoch [m]; shape (epochs,).

    `along_m`, `cross_m`, `up_m`: a + b sigma as `calibrate` fitted it; `position_m`: along the track, with the digits;
    `confidence_m`: half-width of the confidence interval.
    """

    along_m: Floats
    cross_m: Floats
    up_m: Floats
    position_m: Floats
    confidence_m: Floats


def _allowed(positions: MatchedEpochs, config: Configuration) -> _Allowed:
    """The confidence interval is K sigma along the track, as stated, or the receiver's HPL (DOMAIN section 4)."""
    along_m, cross_m, up_m = (
        config.monitors.sigma_intercept_m + config.monitors.sigma_slope * sigma_m
        for sigma_m in (positions.sigma_along_m, positions.sigma_cross_m, positions.sigma_up_m)
    )
    by_sigma = config.lds.ci_source == "sigma"
    return _Allowed(
        along_m,
        cross_m,
        up_m,
        position_m=np.sqrt(along_m**2 + positions.digits_along_m**2),
        confidence_m=config.lds.ci_factor * positions.sigma_along_m if by_sigma else positions.hpl_m,
    )


def curve_corrected_path_m(epochs: MatchedEpochs) -> Floats:
    """Path position less what a curve adds to the movement of a position off the track's axis [m]; NaN off the track.

    A point y to the left of a track with left curvature k moves dx / (1 - k y) along it while the train moves dx.
    """
    along = np.full(epochs.height, np.nan)
    rows = np.flatnonzero(epochs.near_track)
    path_m = epochs.path_m[rows]
    share = np.nan_to_num(epochs.curvature_per_m[rows] * epochs.cross_track_m[rows])
    along[rows] = path_m - np.cumsum(share * np.diff(path_m, prepend=path_m[:1]))
    return along


def odometer_at(at_ns: Ints, aligned: AlignedEpochs, odometry: Odometry) -> Floats:
    """Odometer distance at any times [m], on the scale of `aligned`'s `odometer_m`; NaN beyond what is known.

    Carried on from the nearest epoch before (or the first one) with the scale in use there.
    """
    anchors = np.flatnonzero(np.isfinite(aligned.odometer_m))
    if anchors.size == 0:
        return np.full(at_ns.size, np.nan)
    anchor_s = odometry.seconds(aligned.t_ns[anchors]) - aligned.latency_s[anchors]
    at_s = odometry.seconds(at_ns)
    near = (np.searchsorted(anchor_s, at_s, side="right") - 1).clip(0)
    at, anchor = odometry.read(at_s), odometry.read(anchor_s[near])
    moved_m = at.distance_m - anchor.distance_m
    whole = at.doubt_m == anchor.doubt_m
    distance = aligned.odometer_m[anchors[near]] + aligned.odometer_scale[anchors[near]] * moved_m
    return np.where(at.known & whole, distance, np.nan)


def _with_odometer(
    positions: MatchedEpochs,
    allowed: _Allowed,
    along_m: Floats,
    jitter_s: Floats,
    odometry: Odometry,
    in_use: Estimates,
    config: Configuration,
) -> AlignedEpochs:
    """Columns of the odometer, read at each epoch less the latency in use there."""
    t_ns = positions.t_ns
    at = odometry.seconds(t_ns) - in_use.latency_s
    read = odometry.read(at)
    known = read.known
    rows = np.flatnonzero(known)
    step, driven = np.zeros((2, known.size))
    step[rows] = odometry.increments(t_ns[rows], in_use.scale[rows], in_use.latency_s[rows]).distance_m
    driven[rows] = odometry.driven(t_ns[rows], in_use.scale[rows], in_use.latency_s[rows])
    total, travelled = (np.where(known, np.cumsum(steps), np.nan) for steps in (step, driven))
    speed = np.where(known, in_use.scale * read.speed_mps, np.nan)
    width_m = read.hysteresis_m
    held = with_hysteresis(total, width_m)
    turning = np.where(width_m > 0.0, speed_of_positions(at, held, config.align.speed_window_s), speed)
    turning[at < odometry.t_s[0] + config.align.speed_window_s] = np.nan
    reason = first_reason(
        (~known & read.inside, NotEvaluated.INTERRUPTED),
        (~known, BEYOND_SPAN),
        (~read.noise_shown, NotEvaluated.NOISE_UNKNOWN),
    )
    return AlignedEpochs(
        **positions.columns(),
        position_sigma_m=allowed.position_m,
        calibrated_along_m=allowed.along_m,
        calibrated_cross_m=allowed.cross_m,
        calibrated_up_m=allowed.up_m,
        confidence_m=allowed.confidence_m,
        along_m=along_m,
        odometer_m=total,
        travelled_m=travelled,
        odometer_reason=reason,
        odometer_slips=read.slips & read.inside,
        odometer_doubt_m=read.doubt_m,
        odometer_white_m2_per_s=read.white_m2_per_s,
        odometer_rows_m=np.minimum(read.row_sigma_m, config.scatter_limit_m),
        odometer_period_s=read.period_s,
        stamp_jitter_s=jitter_s,
        speed_mps=speed,
        direction=_direction(turning, config.matching.deadband_mps),
        odometer_scale=in_use.scale,
        scale_sigma=in_use.scale_sigma,
        latency_s=in_use.latency_s,
        latency_sigma_s=in_use.latency_sigma_s,
    )


def _direction(speed_mps: Floats, deadband_mps: float) -> Ints:
    """+1 or -1 along growing path, held inside the dead band; the path grows in the direction in which the run
    begins.
    """
    known_mps = np.nan_to_num(speed_mps)
    moving = np.abs(known_mps) > deadband_mps
    last = np.maximum.accumulate(np.where(moving, np.arange(moving.size), -1))
    return np.where(last >= 0, np.where(known_mps[last] > 0.0, 1, -1), 1)


def _without_odometer(
    positions: MatchedEpochs, allowed: _Allowed, vehicle: Vehicle, config: Configuration
) -> AlignedEpochs:
    """Speed and direction from GNSS: velocity, else positions."""
    unknown = np.full(positions.height, np.nan)
    t_s = positions.t_ns * 1e-9
    path_m = np.where(positions.on_track, positions.path_m, np.nan)
    by_position = speed_of_positions(t_s - t_s[0], path_m, config.align.speed_window_s)
    by_doppler = positions.velocity_along_mps
    speed = np.where(np.isfinite(by_doppler), by_doppler, by_position)
    latency = vehicle.gnss_latency_s
    latency_sigma = np.nan if latency is None else vehicle.gnss_latency_sigma_s or 0.0
    return AlignedEpochs(
        **positions.columns(),
        position_sigma_m=allowed.position_m,
        calibrated_along_m=allowed.along_m,
        calibrated_cross_m=allowed.cross_m,
        calibrated_up_m=allowed.up_m,
        confidence_m=allowed.confidence_m,
        along_m=unknown,
        odometer_m=unknown,
        travelled_m=unknown,
        odometer_reason=np.full(positions.height, NUMBER[NO_ODOMETER]),
        odometer_slips=np.zeros(positions.height, dtype=np.bool_),
        odometer_doubt_m=np.zeros(positions.height),
        odometer_white_m2_per_s=unknown,
        odometer_rows_m=unknown,
        odometer_period_s=unknown,
        stamp_jitter_s=unknown,
        speed_mps=speed,
        direction=_direction(speed, config.matching.deadband_mps),
        odometer_scale=unknown,
        scale_sigma=unknown,
        latency_s=np.full(positions.height, np.nan if latency is None else latency),
        latency_sigma_s=np.full(positions.height, latency_sigma),
    )


def speed_of_positions(t_s: Floats, path_m: Floats, window_s: float) -> Floats:
    """Speed by positions at least `window_s` apart, causal [m/s]; NaN where there are none."""
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
